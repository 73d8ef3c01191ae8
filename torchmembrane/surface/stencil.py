"""The seven-point stencil of a grid of triangles: every vertex inside the border and the six around it.

Fields over all `V` vertices are `[..., V, C]`; over the `N = (m - 2) (n - 2)` inner ones, row by row, `[..., N, C]` or,
components first, `[..., C, N]`. The six, the one-ring, are in turn: `k`, `ONE_RING[i]` and `ONE_RING[i + 1]` are a triangle.
Convolutions, slices and pads: no index arithmetic.
"""

import torch
import torch.nn.functional as F
from torch import Tensor

ONE_RING = ((1, 0), (1, 1), (0, 1), (-1, 0), (-1, -1), (0, -1))
STENCIL = ((0, 0), *ONE_RING)


def stencil_kernels() -> Tensor:
    """Kernels for `apply_stencil` that pick the vertex itself and its six neighbours, `[7, 3, 3]`."""
    picks = torch.zeros(len(STENCIL), 3, 3, dtype=torch.float64)
    for pick, (i, j) in zip(picks, STENCIL, strict=True):
        pick[1 + i, 1 + j] = 1.0
    return picks


def one_ring_edges() -> Tensor:
    """Kernels for `apply_stencil`: the edges from a vertex in the six triangles around it, all first ones before all second."""
    own, ring = stencil_kernels()[:1], stencil_kernels()[1:]
    return torch.cat([ring - own, ring.roll(-1, 0) - own])


def apply_stencil(field: Tensor, kernels: Tensor, grid: tuple[int, int], border=True) -> Tensor:
    """Combinations of the values around every vertex, zero beyond the border: `[..., V, C]` to `[..., C, W V]`.

    `kernels [W, 3, 3]`; without `border` around the inner vertices only, `[..., C, W N]`. One convolution, many times faster in
    exported models than differences of slices.
    """
    *batch, V, C = field.shape
    count = V if border else (grid[0] - 2) * (grid[1] - 2)
    planes = field.transpose(-2, -1).reshape(-1, 1, *grid)
    return F.conv2d(planes, kernels[:, None], padding=int(border)).reshape(*batch, C, len(kernels) * count)


def inner(field: Tensor, grid: tuple[int, int]) -> Tensor:
    """A vertex field `[..., V, C]` at the inner vertices, `[..., N, C]`."""
    return field.unflatten(-2, grid)[..., 1:-1, 1:-1, :].flatten(-3, -2)


def pad_border(field: Tensor, grid: tuple[int, int]) -> Tensor:
    """Adjoint of `inner`: zero on the border."""
    m, n = grid
    return F.pad(field.unflatten(-2, (m - 2, n - 2)), (0, 0, 1, 1, 1, 1)).flatten(-3, -2)
