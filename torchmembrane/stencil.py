"""The seven-point stencil of a grid of triangles: every vertex inside the border and the six around it.

Fields over the inner vertices are `[..., N, C]`, `N = (m - 2) (n - 2)`, row by row. The six are in turn, so that `k`, `RING[i]`
and `RING[i + 1]` are a triangle. Slices and pads, as in `membrane`: no index arithmetic.
"""

import torch
import torch.nn.functional as F
from torch import Tensor

RING = ((1, 0), (1, 1), (0, 1), (-1, 0), (-1, -1), (0, -1))
STENCIL = ((0, 0), *RING)


def taps() -> Tensor:
    """Weights for `combined` that pick the vertex itself and its six neighbours, `[7, 3, 3]`."""
    picks = torch.zeros(len(STENCIL), 3, 3, dtype=torch.float64)
    for pick, (i, j) in zip(picks, STENCIL, strict=True):
        pick[1 + i, 1 + j] = 1.0
    return picks


def combined(field: Tensor, weights: Tensor, grid: tuple[int, int]) -> Tensor:
    """Combinations of the values around every vertex, zero beyond the border: `[..., V, C]` to `[..., C, W V]`.

    `weights [W, 3, 3]`. One convolution, many times faster in exported models than differences of slices.
    """
    *batch, V, C = field.shape
    planes = field.mT.reshape(-1, 1, *grid)
    return F.conv2d(planes, weights[:, None], padding=1).reshape(*batch, C, len(weights) * V)


def inner(field: Tensor, grid: tuple[int, int]) -> Tensor:
    """A vertex field `[..., V, C]` at the inner vertices, `[..., N, C]`."""
    return field.unflatten(-2, grid)[..., 1:-1, 1:-1, :].flatten(-3, -2)


def bordered(field: Tensor, grid: tuple[int, int]) -> Tensor:
    """Adjoint of `inner`: zero on the border."""
    m, n = grid
    return F.pad(field.unflatten(-2, (m - 2, n - 2)), (0, 0, 1, 1, 1, 1)).flatten(-3, -2)


def ring(field: Tensor, grid: tuple[int, int]) -> Tensor:
    """Values at the six neighbours of the inner vertices: `[..., V, C]` to `[..., 6, C, N]`, vertices last for what follows."""
    m, n = grid
    g = field.transpose(-2, -1).unflatten(-1, grid)
    return torch.stack([g[..., 1 + i : m - 1 + i, 1 + j : n - 1 + j] for i, j in RING], -4).flatten(-2)


def pairs_to_ring(pairs: Tensor) -> Tensor:
    """Sum over triangles of their blocks between vertices (0, 1), (0, 2), (1, 2), at the six neighbours of the inner vertices.

    `[..., 3, 3, 3, 2, m-1, n-1]` (pair, block, triangle of a quadrilateral), vertices as in `TRIANGLE_CORNERS`, to
    `[..., 6, 3, 3, N]`: the blocks between vertex and neighbour. Those between neighbour and vertex are their transposes.
    """
    (ab, ac, bc), (ca, ad, cd) = (triangle.unbind(-5) for triangle in pairs.unbind(-3))
    down = ab[..., 1:] + _transposed(cd[..., :-1])
    diagonal = ac + ca
    right = ad[..., 1:, :] + bc[..., :-1, :]
    forth = [down[..., 1:, :], diagonal[..., 1:, 1:], right[..., 1:]]
    back = [down[..., :-1, :], diagonal[..., :-1, :-1], right[..., :-1]]
    return torch.stack([*forth, *(_transposed(block) for block in back)], -5).flatten(-2)


def _transposed(blocks: Tensor) -> Tensor:
    return blocks.transpose(-4, -3)
