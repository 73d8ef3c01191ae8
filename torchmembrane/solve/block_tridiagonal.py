"""Symmetric positive definite block-tridiagonal systems, batched: Cholesky by blocks."""

from typing import NamedTuple

import torch
from torch import Tensor


class BlockFactor(NamedTuple):
    """`L_i` and `L_i^-1 U_i` of `M = [D_0 U_0; U_0^T D_1 U_1; ...]`, each a list of `[..., s, s]`."""

    lower: list[Tensor]
    upper: list[Tensor]


def factor(diagonal: Tensor, upper: Tensor) -> BlockFactor:
    """Cholesky factor of the matrix with diagonal blocks `[..., n, s, s]` and blocks above them `[..., n-1, s, s]`."""
    lower, coupled = [], []
    pivot = diagonal[..., 0, :, :]
    for i in range(diagonal.shape[-3]):
        L, _ = torch.linalg.cholesky_ex(pivot)
        lower.append(L)
        if i + 1 < diagonal.shape[-3]:
            Y = torch.linalg.solve_triangular(L, upper[..., i, :, :], upper=False)
            coupled.append(Y)
            pivot = diagonal[..., i + 1, :, :] - Y.mT @ Y
    return BlockFactor(lower, coupled)


def solve(factored: BlockFactor, b: Tensor) -> Tensor:
    """`M^-1 b` for `b [..., n, s, C]`."""
    forward = []
    for i, L in enumerate(factored.lower):
        rhs = b[..., i, :, :] - (factored.upper[i - 1].mT @ forward[-1] if i else 0.0)
        forward.append(torch.linalg.solve_triangular(L, rhs, upper=False))
    x = []
    for i in reversed(range(len(factored.lower))):
        rhs = forward[i] - (factored.upper[i] @ x[-1] if x else 0.0)
        x.append(torch.linalg.solve_triangular(factored.lower[i].mT, rhs, upper=True))
    return torch.stack(x[::-1], -3)
