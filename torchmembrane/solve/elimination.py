"""Small dense systems, many at once, by elimination that torch.onnx can write."""

import torch
from torch import Tensor


def solve_positive(system: Tensor) -> Tensor:
    """`x [n, k, ...]` with `matrix x = loads` from `system = [matrix, loads] [n, n + k, ...]`: Gauss-Jordan without pivoting.

    The matrix must be positive definite; the batch comes last, so that each row is one long vector.

    Example:
        >>> solve_positive(torch.tensor([[2.0, 0.0, 6.0], [0.0, 4.0, 2.0]])).tolist()
        [[3.0], [0.5]]
    """
    n = system.shape[0]
    unit = torch.eye(n, dtype=system.dtype, device=system.device).reshape(n, n, *(1,) * (system.ndim - 2))
    for i in range(n):
        column, rest = system.split([1, system.shape[1] - 1], 1)
        system = rest - (column - unit[:, i : i + 1]) * (rest[i : i + 1] / column[i : i + 1])
    return system


def solve_dense(matrix: Tensor, loads: Tensor) -> Tensor:
    """`x [..., n, k]` with `matrix x = loads`, of positive definite `matrix [..., n, n]`: by LAPACK, in exported models by
    `solve_positive`."""
    if torch.compiler.is_exporting():
        return solve_positive(torch.cat([matrix, loads], -1).movedim((-2, -1), (0, 1))).movedim((0, 1), (-2, -1))
    solution: Tensor = torch.linalg.solve_ex(matrix, loads).result
    return solution
