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
    """As `block_tridiagonal.solve`; eliminated from both ends at once, two blocks a product."""
    s, n = diagonal.shape[-1], diagonal.shape[-3]
    D, U, b = (list(blocks.unbind(-3)) for blocks in (diagonal, upper, b))
    pair = lambda first, last: torch.stack([first, last], -3)  # noqa: E731
    reduced = []
    for i in range((n - 1) // 2):
        j = n - 1 - i
        coupled = pair(U[i], U[j - 1].mT)
        Y = _inverse_scaled(pair(D[i], D[j])) @ torch.cat([coupled, pair(b[i], b[j])], -1)
        for k, product in zip((i + 1, j - 1), (coupled.mT @ Y).unbind(-3), strict=True):
            D[k], b[k] = D[k] - product[..., :s], b[k] - product[..., s:]
        reduced.append(Y)
    k, x = (n - 1) // 2, [None] * n
    if n % 2 == 0:
        Y = _inverse_scaled(D[k]) @ torch.cat([U[k], b[k]], -1)
        product = U[k].mT @ Y
        x[k + 1] = _inverse_scaled(D[k + 1] - product[..., :s]) @ (b[k + 1] - product[..., s:])
        x[k] = Y[..., s:] - Y[..., :s] @ x[k + 1]
    else:
        x[k] = _inverse_scaled(D[k]) @ b[k]
    for i in reversed(range(k)):
        j = n - 1 - i
        x[i], x[j] = (reduced[i][..., s:] - reduced[i][..., :s] @ pair(x[i + 1], x[j - 1])).unbind(-3)
    return torch.stack(x, -3)


def _inverse_scaled(matrix: Tensor) -> Tensor:
    scale = matrix.diagonal(dim1=-2, dim2=-1).rsqrt()
    scale = scale[..., :, None] * scale[..., None, :]
    return inverse(matrix * scale) * scale
