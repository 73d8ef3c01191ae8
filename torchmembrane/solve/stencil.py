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
FEW = 12  # planes: more are convolved faster by what begins later


def stencil_kernels() -> Tensor:
    """Kernels for `apply_stencil` that pick the vertex itself and its six neighbours.

    Returns:
        `[7, 3, 3]`, in the order of `STENCIL`.

    Example:
        >>> stencil_kernels()[1].tolist()
        [[0.0, 0.0, 0.0], [0.0, 0.0, 0.0], [0.0, 1.0, 0.0]]
    """
    picks = torch.zeros(len(STENCIL), 3, 3, dtype=torch.float64)
    for pick, (i, j) in zip(picks, STENCIL, strict=True):
        pick[1 + i, 1 + j] = 1.0
    return picks


def one_ring_edges() -> Tensor:
    """Kernels for `apply_stencil`: the edges from a vertex to its six neighbours, and the chords from the neighbour after each
    to that before it.

    Returns:
        `[12, 3, 3]`, the edges before the chords.

    Example:
        >>> field = torch.arange(9, dtype=torch.float64)[:, None]
        >>> apply_stencil(field, one_ring_edges(), (3, 3), border=False).unflatten(-1, (2, 6))[0].tolist()
        [[3.0, 4.0, 1.0, -3.0, -4.0, -1.0], [-5.0, 2.0, 7.0, 5.0, -2.0, -7.0]]
    """
    own, ring = stencil_kernels()[:1], stencil_kernels()[1:]
    return torch.cat([ring - own, ring.roll(1, 0) - ring.roll(-1, 0)])


def apply_stencil(field: Tensor, kernels: Tensor, grid: tuple[int, int], border: bool = True) -> Tensor:
    """Combinations of the values around every vertex, zero beyond the border.

    One convolution, many times faster in exported models than differences of slices.

    Args:
        field: `[..., V, C]`.
        kernels: `[W, 3, 3]`.
        grid: `m, n` with `V = m n`.
        border: False for the `N` inner vertices only.

    Returns:
        Components first: `[..., C, W V]`, or without the border `[..., C, W N]`.

    Example:
        >>> apply_stencil(torch.arange(9.0)[:, None], stencil_kernels().float(), (3, 3), border=False).tolist()
        [[4.0, 7.0, 8.0, 5.0, 1.0, 0.0, 3.0]]
    """
    *batch, V, C = field.shape
    count = V if border else (grid[0] - 2) * (grid[1] - 2)
    planes = field.transpose(-2, -1).reshape(-1, 1, *grid)
    return convolved(planes, kernels[:, None], int(border)).reshape(*batch, C, len(kernels) * count)


def convolved(planes: Tensor, kernels: Tensor, padding: int = 0) -> Tensor:
    """`F.conv2d`. For a few small planes on a processor without gradients, torch's native kernel is called, because oneDNN's,
    the default, needs 40 microseconds before it starts. In exported models, which have no convolution in double precision, that
    is a product.

    Args:
        planes: `[P, C, m, n]`.
        kernels: `[W, C, h, w]`.
        padding: with zeros.

    Example:
        >>> convolved(torch.ones(1, 1, 3, 3), torch.ones(1, 1, 2, 2)).tolist()
        [[[[4.0, 4.0], [4.0, 4.0]]]]
    """
    if torch.compiler.is_exporting() and planes.dtype == torch.float64:
        return convolved_by_product(F.pad(planes, (padding,) * 4), kernels)
    if len(planes) > FEW or planes.device.type != "cpu" or torch.is_grad_enabled() or torch.compiler.is_compiling():
        return F.conv2d(planes, kernels, padding=padding)
    at_once: Tensor = torch.ops.aten.thnn_conv2d(planes, kernels, kernels.shape[2:], None, [1, 1], [padding] * 2)
    return at_once


def convolved_by_product(planes: Tensor, kernels: Tensor) -> Tensor:
    """`F.conv2d`, without padding, by a product of matrices.

    Args:
        planes: `[P, C, m, n]`.
        kernels: `[W, C, h, w]`.
    """
    (m, n), (h, w) = planes.shape[2:], kernels.shape[2:]
    rows, columns = m - h + 1, n - w + 1
    windows = torch.cat([planes[..., i : i + rows, j : j + columns] for i in range(h) for j in range(w)], 1)
    product: Tensor = (kernels.permute(0, 2, 3, 1).flatten(1) @ windows.flatten(2)).unflatten(-1, (rows, columns))
    return product


def inner(field: Tensor, grid: tuple[int, int]) -> Tensor:
    """A vertex field at the inner vertices.

    Args:
        field: `[..., V, C]`.
        grid: `m, n`.

    Returns:
        `[..., N, C]`, `N = (m - 2) (n - 2)`.

    Example:
        >>> inner(torch.arange(12)[:, None], (3, 4))[:, 0].tolist()
        [5, 6]
    """
    within: Tensor = field.unflatten(-2, grid)[..., 1:-1, 1:-1, :]
    return within.flatten(-3, -2)


def pad_border(field: Tensor, grid: tuple[int, int]) -> Tensor:
    """A field of the inner vertices extended to all vertices by zeros on the border: the adjoint of `inner`.

    Args:
        field: `[..., N, C]`.
        grid: `m, n`.

    Returns:
        `[..., V, C]`.

    Example:
        >>> pad_border(torch.tensor([[5], [6]]), (3, 4))[:, 0].tolist()
        [0, 0, 0, 0, 0, 5, 6, 0, 0, 0, 0, 0]
    """
    m, n = grid
    return F.pad(field.unflatten(-2, (m - 2, n - 2)), (0, 0, 1, 1, 1, 1)).flatten(-3, -2)
