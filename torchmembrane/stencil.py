"""The seven-point stencil of a grid of triangles: every vertex inside the border and the six around it.

Fields over the inner vertices are `[..., N, C]`, `N = (m - 2) (n - 2)`, row by row. The six are in turn, so that `k`, `RING[i]`
and `RING[i + 1]` are a triangle. Slices and pads, as in `membrane`: no index arithmetic.
"""

import torch
import torch.nn.functional as F
from torch import Tensor

RING = ((1, 0), (1, 1), (0, 1), (-1, 0), (-1, -1), (0, -1))
STENCIL = ((0, 0), *RING)


def inner(field: Tensor, grid: tuple[int, int]) -> Tensor:
    """A vertex field `[..., V, C]` at the inner vertices, `[..., N, C]`."""
    return field.unflatten(-2, grid)[..., 1:-1, 1:-1, :].flatten(-3, -2)


def bordered(field: Tensor, grid: tuple[int, int]) -> Tensor:
    """Adjoint of `inner`: zero on the border."""
    m, n = grid
    return F.pad(field.unflatten(-2, (m - 2, n - 2)), (0, 0, 1, 1, 1, 1)).flatten(-3, -2)


def ring(field: Tensor, grid: tuple[int, int]) -> Tensor:
    """Values at the six neighbours of the inner vertices: `[..., V, C]` to `[..., N, 6, C]`."""
    m, n = grid
    g = field.unflatten(-2, grid)
    return torch.stack([g[..., 1 + i : m - 1 + i, 1 + j : n - 1 + j, :] for i, j in RING], -2).flatten(-4, -3)


def pairs_to_ring(pairs: Tensor) -> Tensor:
    """Sum over triangles of their blocks between vertices (0, 1), (0, 2), (1, 2), at the six neighbours of the inner vertices.

    `[..., m-1, n-1, 2, 3, 3, 3]`, vertices as in `TRIANGLE_CORNERS`, to `[..., N, 6, 3, 3]`: the block between vertex and
    neighbour. That between neighbour and vertex is its transpose.
    """
    (ab, ac, bc), (ca, ad, cd) = (triangle.unbind(-3) for triangle in pairs.unbind(-4))
    down = ab[..., 1:, :, :] + cd[..., :-1, :, :].mT
    diagonal = ac + ca
    right = ad[..., 1:, :, :, :] + bc[..., :-1, :, :, :]
    forth = [down[..., 1:, :, :, :], diagonal[..., 1:, 1:, :, :], right[..., 1:, :, :]]
    back = [down[..., :-1, :, :, :], diagonal[..., :-1, :-1, :, :], right[..., :-1, :, :]]
    return torch.stack([*forth, *(block.mT for block in back)], -3).flatten(-5, -4)
