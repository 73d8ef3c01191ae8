"""Symmetric positive definite block-tridiagonal systems, batched: Cholesky by blocks."""

import torch
from torch import Tensor


def factor(diagonal: Tensor, upper: Tensor) -> tuple[Tensor, Tensor]:
    """What `substitute` solves `[D_0 U_0; U_0^T D_1 U_1; ...] x = b` with: `[..., n, s, s]`, `[..., n-1, s, s]`.

    Arguments: the blocks `[..., n, s, s]` on the diagonal and those above it `[..., n-1, s, s]`.
    """
    pivot, lower, couplings = diagonal[..., 0, :, :], [], []
    for U, D in zip(upper.unbind(-3), diagonal[..., 1:, :, :].unbind(-3), strict=True):
        lower.append(torch.linalg.cholesky_ex(pivot).L)
        couplings.append(torch.linalg.solve_triangular(lower[-1], U, upper=False))
        pivot = D - couplings[-1].mT @ couplings[-1]
    lower.append(torch.linalg.cholesky_ex(pivot).L)
    return torch.stack(lower, -3), torch.stack(couplings, -3) if couplings else upper


def substitute(factor: tuple[Tensor, Tensor], b: Tensor) -> Tensor:
    """Solution `[..., n, s, C]` for `b` of that shape."""
    lower, couplings = (blocks.unbind(-3) for blocks in factor)
    first, *rest = b.unbind(-3)
    reduced = [torch.linalg.solve_triangular(lower[0], first, upper=False)]
    for L, Y, r in zip(lower[1:], couplings, rest, strict=True):
        reduced.append(torch.linalg.solve_triangular(L, r - Y.mT @ reduced[-1], upper=False))
    x = [torch.linalg.solve_triangular(lower[-1].mT, reduced[-1], upper=True)]
    for L, Y, r in zip(lower[-2::-1], couplings[::-1], reduced[-2::-1], strict=True):
        x.append(torch.linalg.solve_triangular(L.mT, r - Y @ x[-1], upper=True))
    return torch.stack(x[::-1], -3)
