"""Triangles of a grid by its quadrilaterals, for sums of forces by slices: components first, quadrilaterals last."""

import torch
import torch.nn.functional as F
from torch import Tensor


def cell_edges(x: Tensor, grid: tuple[int, int]) -> Tensor:
    """The edges of every quadrilateral `a b c d` from `a` to `b`, `c` and `d`: of its triangles `a b c` and `a c d`.

    Args:
        x: vertices `[..., V, 3]`.
        grid: `m, n`.

    Returns:
        `[..., 3, 3, m-1, n-1]`, edges and then components.
    """
    g = x.mT.unflatten(-1, grid)
    ends = torch.stack([g[..., 1:, :-1], g[..., 1:, 1:], g[..., :-1, 1:]], -4)
    return ends - g[..., None, :, :-1, :-1]


def cell_metric(edges: Tensor) -> Tensor:
    """The metric of the two edges of each triangle, its entries 11, 12, 22: `[..., 3, 2, m-1, n-1]`."""
    square = (edges * edges).sum(-3)
    mixed = (edges[..., :2, :, :, :] * edges[..., 1:, :, :, :]).sum(-3)
    return torch.stack([square[..., :2, :, :], mixed, square[..., 1:, :, :]], -4)


def forces_of_stress(edges: Tensor, stress: Tensor) -> Tensor:
    """`sum S_ij e_j` at the end of every edge `e_i` of a triangle, and the opposite at its beginning, summed: `[..., V, 3]`.

    Arguments: `edges` of `cell_edges`; `stress`, `S` with entries 11, 12, 22, `[..., 3, 2, m-1, n-1]`.
    """
    first, second = edges[..., :2, :, :, :], edges[..., 1:, :, :, :]
    s11, s12, s22 = (s.unsqueeze(-3) for s in stress.unbind(-4))
    at_first, at_second = (s11 * first).addcmul(s12, second), (s12 * first).addcmul(s22, second)
    b, d = at_first[..., 0, :, :, :], at_second[..., 1, :, :, :]
    c = at_second[..., 0, :, :, :] + at_first[..., 1, :, :, :]
    total = F.pad(b, (0, 1, 1, 0)) + F.pad(c, (1, 0, 1, 0)) + F.pad(d, (1, 0, 0, 1)) - F.pad(b + c + d, (0, 1, 0, 1))
    return total.flatten(-2).mT
