"""Batched solution of small dense systems by an elimination that torch.onnx can export."""

import torch
from torch import Tensor


def solve_positive(system: Tensor) -> Tensor:
    """Solve `matrix x = loads` for `x [n, k, ...]`, given `system = [matrix, loads] [n, n + k, ...]`.

    The method is Gauss-Jordan elimination without pivoting, so the matrix must be positive definite. The batch dimensions come
    last, so that each row is one long vector.

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
    """Solve `matrix x = loads [..., n, k]` with a positive definite `matrix [..., n, n]`: by LAPACK, or in exported models by
    `solve_positive`."""
    if torch.compiler.is_exporting():
        return solve_positive(torch.cat([matrix, loads], -1).movedim((-2, -1), (0, 1))).movedim((0, 1), (-2, -1))
    solution: Tensor = torch.linalg.solve_ex(matrix, loads).result
    return solution
