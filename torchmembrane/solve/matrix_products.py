"""The solves of `block_tridiagonal` by matrix products alone, for runtimes that have no Cholesky factor: ONNX.

An inverse is split into 2 x 2 blocks down to `LEAF` rows, and there iterated, `X <- X (2 I - A X)` (Schulz 1933), with `X`
scaled in between so that the eigenvalues of `A X` lie evenly about 1: each step then divides their spread by four.
"""

import torch
from torch import Tensor

LEAF = 48
LARGEST_CONDITION = 1e4  # of a leaf, Jacobi-scaled


def schulz_scales(condition: float, rounding: float) -> list[float]:
    """By what to scale `X` before every step, for eigenvalues of `A X` from `1 / condition` to 1 at first."""
    low, scales = 1 / condition, []
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


def solve(diagonal: Tensor, upper: Tensor, b: Tensor) -> Tensor:
    """As `block_tridiagonal.solve`."""
    s, last = diagonal.shape[-1], diagonal.shape[-3] - 1
    reduced = []
    pivot, rhs = diagonal[..., 0, :, :], b[..., 0, :, :]
    for i in range(last + 1):
        scale = pivot.diagonal(dim1=-2, dim2=-1).rsqrt()
        own = inverse(pivot * scale[..., :, None] * scale[..., None, :]) * scale[..., :, None] * scale[..., None, :]
        reduced.append(own @ (torch.cat([upper[..., i, :, :], rhs], -1) if i < last else rhs))
        if i < last:
            product = upper[..., i, :, :].mT @ reduced[-1]
            pivot, rhs = diagonal[..., i + 1, :, :] - product[..., :s], b[..., i + 1, :, :] - product[..., s:]
    x = [reduced[-1]]
    for Y in reduced[-2::-1]:
        x.append(Y[..., s:] - Y[..., :s] @ x[-1])
    return torch.stack(x[::-1], -3)
