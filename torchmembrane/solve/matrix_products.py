"""What `block_tridiagonal` does by matrix products alone, for runtimes that have no Cholesky factor: ONNX.

An inverse is split into 2 x 2 blocks down to `LEAF` rows, and there iterated, `X <- X (2 I - A X)` (Schulz 1933), with `X`
scaled in between so that the eigenvalues of `A X` lie evenly about 1: each step then divides their spread by four.
"""

import torch
from torch import Tensor

from .block_tridiagonal import Factor

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


def solve(diagonal: Tensor, upper: Tensor, b: Tensor) -> tuple[Tensor, Factor]:
    """As `block_tridiagonal.solve`; eliminated from both ends at once, two blocks a product. Diagonal best about 1."""
    n = diagonal.shape[-3]
    D, U, inverses, couplings = list(diagonal.split(1, -3)), upper.split(1, -3), [], []
    for i, j in _pairs(n):
        coupled = torch.cat([U[i], U[j - 1].mT], -3)
        inverses.append(inverse(torch.cat([D[i], D[j]], -3)))
        couplings.append(inverses[-1] @ coupled)
        for k, change in zip((i + 1, j - 1), (coupled.mT @ couplings[-1]).split(1, -3), strict=True):
            D[k] = D[k] - change
    for k in range((n - 1) // 2, n // 2 + 1):
        inverses.append(inverse(D[k]))
        if k < n // 2:
            couplings.append(inverses[-1] @ U[k])
            D[k + 1] = D[k + 1] - U[k].mT @ couplings[-1]
    return _substituted(inverses, couplings, b), (inverses, couplings)


def substitute(factor: tuple[Tensor, Tensor], b: Tensor) -> Tensor:
    """As `block_tridiagonal.substitute`."""
    n = b.shape[-3]
    sizes = [2] * len(_pairs(n)) + [1] * (2 - n % 2)
    return _substituted(factor[0].split(sizes, -3), factor[1].split(sizes[:-1], -3), b)


def _substituted(inverses, couplings, b: Tensor) -> Tensor:
    n = b.shape[-3]
    b, ends, k = list(b.split(1, -3)), [], (n - 1) // 2
    for (i, j), Y in zip(_pairs(n), couplings, strict=False):
        ends.append(torch.cat([b[i], b[j]], -3))
        for inward, change in zip((i + 1, j - 1), (Y.mT @ ends[-1]).split(1, -3), strict=True):
            b[inward] = b[inward] - change
    if n % 2 == 0:
        b[k + 1] = inverses[-1] @ (b[k + 1] - couplings[-1].mT @ b[k])
        b[k] = inverses[-2] @ b[k] - couplings[-1] @ b[k + 1]
    else:
        b[k] = inverses[-1] @ b[k]
    for i, j in reversed(_pairs(n)):
        x = inverses[i] @ ends[i] - couplings[i] @ torch.cat([b[i + 1], b[j - 1]], -3)
        b[i], b[j] = x.split(1, -3)
    return torch.cat(b, -3)


def _pairs(n: int) -> list[tuple[int, int]]:
    """Blocks that are eliminated together: the outermost, those next to them, ..."""
    return [(i, n - 1 - i) for i in range((n - 1) // 2)]
