"""What `block_tridiagonal` does by matrix products alone, for runtimes that have no Cholesky factor: ONNX.

An inverse is split into 2 x 2 blocks down to `LEAF` rows, and there iterated, `X <- X (2 I - A X)` (Schulz 1933), with `X`
scaled in between so that the eigenvalues of `A X` lie evenly about 1: each step then divides their spread by four.
"""

import torch
from torch import Tensor

from .block_tridiagonal import Factor, further_in, parts, subtract_further_in

LEAF = 48
LARGEST_CONDITION = 1e4  # of a leaf, Jacobi-scaled


def schulz_scales(condition: float, rounding: float) -> list[float]:
    """By what to scale `X` before every step, for eigenvalues of `A X` from `1 / condition` to 1 at first."""
    low = 1 / condition
    scales: list[float] = []
    while not scales or 1 - low > rounding:
        scales.append(2 / (1 + low))
        low = 1 - (1 - scales[-1] * low) ** 2
    return [*scales, 1.0]


def inverse(matrix: Tensor) -> Tensor:
    """Inverse of symmetric positive definite `[..., n, n]`, best with a diagonal of about 1.

    Wrong when a leaf's condition exceeds `LARGEST_CONDITION`: its smallest eigenvalues are then too small in the inverse.
    """
    n = matrix.shape[-1]
    if n > LEAF:
        k = n // 2
        A, B, C = matrix[..., :k, :k], matrix[..., :k, k:], matrix[..., k:, k:]
        P = inverse(A)
        PB = P @ B
        Q = inverse(C - B.mT @ PB)
        R = PB @ Q
        return torch.cat([torch.cat([P + R @ PB.mT, -R], -1), torch.cat([-R.mT, Q], -1)], -2)
    two = 2 * torch.eye(n, dtype=matrix.dtype, device=matrix.device)
    largest = matrix.abs().sum(-1).amax(-1)[..., None, None]
    first, *scales = schulz_scales(LARGEST_CONDITION, torch.finfo(matrix.dtype).eps)
    X = (first / largest) * (two - (first / largest) * matrix)
    for scale in scales:
        X = scale * X
        X = X @ (two - matrix @ X)
    return (X + X.mT) / 2


def factor(diagonal: Tensor, coupling: Tensor) -> Factor:
    """As `block_tridiagonal.factor`. Diagonal best about 1."""
    sizes = parts(diagonal.shape[-3])
    pivots, couplings = list(diagonal.split(sizes, -3)), list(coupling.split(sizes[:-1], -3))
    for k in range(len(sizes)):
        pivots[k] = inverse(pivots[k])
        if k < len(couplings):
            coupled, couplings[k] = couplings[k], pivots[k] @ couplings[k]
            subtract_further_in(pivots, k, coupled.mT @ couplings[k])
    return pivots, couplings


def substitute(factor: Factor, b: Tensor) -> Tensor:
    """As `block_tridiagonal.substitute`."""
    pivots, couplings = factor
    x = list(b.split(parts(b.shape[-3]), -3))
    for k, Y in enumerate(couplings):
        subtract_further_in(x, k, x[k] @ Y)
    x[-1] = x[-1] @ pivots[-1]
    for k in reversed(range(len(couplings))):
        x[k] = x[k] @ pivots[k] - further_in(x, k) @ couplings[k].mT
    return torch.cat(x, -3)
