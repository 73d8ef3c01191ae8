"""Symmetric positive definite block-tridiagonal systems, batched: Cholesky by blocks."""

import torch
from torch import Tensor


def solve(diagonal: Tensor, upper: Tensor, b: Tensor) -> Tensor:
    """Solution `[..., n, s, C]` of `[D_0 U_0; U_0^T D_1 U_1; ...] x = b`.

    Arguments: the blocks `[..., n, s, s]` on the diagonal, those above it `[..., n-1, s, s]`, and `b [..., n, s, C]`.
    """
    s, last = diagonal.shape[-1], diagonal.shape[-3] - 1
    lower, reduced = [], []
    pivot, rhs = diagonal[..., 0, :, :], b[..., 0, :, :]
    for i in range(last + 1):
        L, _ = torch.linalg.cholesky_ex(pivot)
        right = torch.cat([upper[..., i, :, :], rhs], -1) if i < last else rhs
        Y = torch.linalg.solve_triangular(L, right, upper=False)
        lower.append(L)
        reduced.append(Y)
        if i < last:
            product = Y[..., :s].mT @ Y
            pivot, rhs = diagonal[..., i + 1, :, :] - product[..., :s], b[..., i + 1, :, :] - product[..., s:]
    x = [torch.linalg.solve_triangular(lower[-1].mT, reduced[-1], upper=True)]
    for L, Y in zip(lower[-2::-1], reduced[-2::-1], strict=True):
        x.append(torch.linalg.solve_triangular(L.mT, Y[..., s:] - Y[..., :s] @ x[-1], upper=True))
    return torch.stack(x[::-1], -3)
