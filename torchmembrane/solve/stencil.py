"""The seven-point stencil of a triangulated grid: a vertex inside the border and its six neighbours, the one-ring.

Fields over all `V` vertices are `[..., V, C]`; fields over the `N = (m - 2) (n - 2)` inner vertices, numbered row by row, are
`[..., N, C]` or, with components first, `[..., C, N]`. The neighbours are listed in cyclic order: a vertex, `ONE_RING[i]` and
`ONE_RING[i + 1]` form a triangle. All operations are convolutions, slices and pads, without index arithmetic.
"""

import torch
import torch.nn.functional as F
from torch import Tensor

ONE_RING = ((1, 0), (1, 1), (0, 1), (-1, 0), (-1, -1), (0, -1))
STENCIL = ((0, 0), *ONE_RING)
FEW = 12  # planes; for more of them oneDNN's convolution is faster, although it starts later


def stencil_kernels() -> Tensor:
    """Return kernels for `apply_stencil` that pick the vertex itself and its six neighbours.

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
    """Return kernels for `apply_stencil` that give edges and chords of the one-ring.

    The edges lead from a vertex to its six neighbours. The chord of a neighbour leads from the neighbour after it to the one
    before it.

    Returns:
        `[12, 3, 3]`, first the edges, then the chords.

    Example:
        >>> field = torch.arange(9, dtype=torch.float64)[:, None]
        >>> apply_stencil(field, one_ring_edges(), (3, 3), border=False).unflatten(-1, (2, 6))[0].tolist()
        [[3.0, 4.0, 1.0, -3.0, -4.0, -1.0], [-5.0, 2.0, 7.0, 5.0, -2.0, -7.0]]
    """
    own, ring = stencil_kernels()[:1], stencil_kernels()[1:]
    return torch.cat([ring - own, ring.roll(1, 0) - ring.roll(-1, 0)])


def apply_stencil(field: Tensor, kernels: Tensor, grid: tuple[int, int], border: bool = True) -> Tensor:
    """Return weighted sums of the values around every vertex; values beyond the border are zero.

    This is one convolution, which in exported models is many times faster than differences of slices.

    Args:
        field: vertex field, `[..., V, C]`.
        kernels: weights of the sums, `[W, 3, 3]`.
        grid: `m, n` with `V = m n`.
        border: whether to include the border; False for the `N` inner vertices only.

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
    """Compute `F.conv2d` by the fastest implementation.

    For a few small planes on the CPU and without gradients this is torch's native kernel, because the default, oneDNN's, needs
    40 microseconds to start. In exported models in double precision, where ONNX has no convolution, it is a matrix product.

    Args:
        planes: input planes, `[P, C, m, n]`.
        kernels: `[W, C, h, w]`.
        padding: number of zeros added at each side.

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
    """Compute `F.conv2d` without padding by a matrix product.

    Args:
        planes: input planes, `[P, C, m, n]`.
        kernels: `[W, C, h, w]`.
    """
    (m, n), (h, w) = planes.shape[2:], kernels.shape[2:]
    rows, columns = m - h + 1, n - w + 1
    windows = torch.cat([planes[..., i : i + rows, j : j + columns] for i in range(h) for j in range(w)], 1)
    product: Tensor = (kernels.permute(0, 2, 3, 1).flatten(1) @ windows.flatten(2)).unflatten(-1, (rows, columns))
    return product


def inner(field: Tensor, grid: tuple[int, int]) -> Tensor:
    """Return the values of a vertex field at the inner vertices.

    Args:
        field: vertex field, `[..., V, C]`.
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
    """Extend a field of the inner vertices to all vertices by zeros on the border: the adjoint of `inner`.

    Args:
        field: field over the inner vertices, `[..., N, C]`.
        grid: `m, n`.

    Returns:
        `[..., V, C]`.

    Example:
        >>> pad_border(torch.tensor([[5], [6]]), (3, 4))[:, 0].tolist()
        [0, 0, 0, 0, 0, 5, 6, 0, 0, 0, 0, 0]
    """
    m, n = grid
    return F.pad(field.unflatten(-2, (m - 2, n - 2)), (0, 0, 1, 1, 1, 1)).flatten(-3, -2)
