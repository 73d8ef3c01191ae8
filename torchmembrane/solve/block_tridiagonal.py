"""Symmetric positive definite block-tridiagonal systems, batched: Cholesky by blocks."""

import torch
from torch import Tensor

Factor = tuple[list[Tensor], list[Tensor]]
"""Of the pivots and of what couples them, blocks `[..., k, s, s]` in the order of their elimination."""


def solve(diagonal: Tensor, upper: Tensor, b: Tensor) -> tuple[Tensor, Factor]:
    """Solution `[..., n, s, C]` of `[D_0 U_0; U_0^T D_1 U_1; ...] x = b`, and what `substitute` needs to solve for others.

    Arguments: the blocks `[..., n, s, s]` on the diagonal, those above it `[..., n-1, s, s]`, and `b [..., n, s, C]`.
    """
    s, D, U, b = diagonal.shape[-1], diagonal.split(1, -3), upper.split(1, -3), b.split(1, -3)
    pivot, rhs, lower, couplings, reduced = D[0], b[0], [], [], []
    for i in range(len(D)):
        lower.append(torch.linalg.cholesky_ex(pivot).L)
        right = torch.cat([U[i], rhs], -1) if i + 1 < len(D) else rhs
        Y = torch.linalg.solve_triangular(lower[-1], right, upper=False)
        reduced.append(Y[..., -rhs.shape[-1] :])
        if i + 1 < len(D):
            couplings.append(Y[..., :s])
            product = couplings[-1].mT @ Y
            pivot, rhs = D[i + 1] - product[..., :s], b[i + 1] - product[..., s:]
    return _back(lower, couplings, reduced), (lower, couplings)


def substitute(factor: tuple[Tensor, Tensor], b: Tensor) -> Tensor:
    """Solution for another `b`; `factor`: that of `solve`, its blocks one after another."""
    (lower, couplings), rest = (blocks.split(1, -3) for blocks in factor), b.split(1, -3)
    reduced = [torch.linalg.solve_triangular(lower[0], rest[0], upper=False)]
    for L, Y, r in zip(lower[1:], couplings, rest[1:], strict=True):
        reduced.append(torch.linalg.solve_triangular(L, r - Y.mT @ reduced[-1], upper=False))
    return _back(lower, couplings, reduced)


def _back(lower, couplings, reduced) -> Tensor:
    x = [torch.linalg.solve_triangular(lower[-1].mT, reduced[-1], upper=True)]
    for L, Y, r in zip(lower[-2::-1], couplings[::-1], reduced[-2::-1], strict=True):
        x.append(torch.linalg.solve_triangular(L.mT, r - Y @ x[-1], upper=True))
    return torch.cat(x[::-1], -3)
