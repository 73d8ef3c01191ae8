"""Symmetric systems on a grid from products of seven-point stencils, solved by elimination over grid rows."""

from itertools import groupby
from math import prod
from operator import itemgetter
from typing import NamedTuple

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from ..surface.stencil import STENCIL
from . import block_pentadiagonal
from .block_tridiagonal import inwards

NEAR = ((0, 0), (0, 1), (1, 0), (1, 1))  # from a vertex to itself and to its neighbours further on
REACH = 2  # lines, between two vertices of a stencil


class StencilSystem(nn.Module):
    """Three unknowns per inner vertex of an `m x n` grid, one block per grid row; the matrix is block pentadiagonal.

    Vectors are fields `[3, N]` over the inner vertices, flattened. Sums are gathered, not scattered, three numbers at a time:
    where they come from is known beforehand.

    Args:
        grid: `(m, n)`.
        free: `[N]` bool, which inner vertices are free. Columns of the others must be zero.
    """

    order: Tensor
    place_of_row: Tensor
    product_sources: Tensor
    band_sources: Tensor
    ends: Tensor
    one: Tensor
    fixed: Tensor

    def __init__(self, grid: tuple[int, int], free: Tensor):
        super().__init__()
        m, n = grid
        self.count, self.inner_grid = (m - 2) * (n - 2), (m - 2, n - 2)
        self.rows = max(3, m - 2 + (m + 1) % 2)  # an odd number
        self.columns = max(n - 2, 2 * REACH + 1)  # no fewer than a row of the matrix reaches
        self.parts = [3 * self.columns * len(part) for part in block_pentadiagonal.places(self.rows)]
        groups = _offsets()
        offsets = [offset for group in groups for offset, _ in group]
        sources = [np.stack([_product_sources(grid, *joined) for joined in group], 1) for group in groups]
        self.sizes = [source.shape for source in sources]
        for name, index in (
            ("order", np.array(inwards(self.rows))),
            ("place_of_row", np.argsort(inwards(self.rows))),
            ("product_sources", np.concatenate([source.ravel() for source in sources])),
            ("band_sources", _band_sources(grid, offsets, free.cpu().numpy(), self.rows, self.columns).ravel()),
            ("ends", np.concatenate([_Inner.of(grid).beside(offset) for offset in offsets])),
        ):
            self.register_buffer(name, torch.from_numpy(index.astype(np.int32)))
        self.register_buffer("one", torch.eye(3, dtype=torch.float64))
        self.register_buffer("fixed", (~free).double()[:, None])

    def matrix(self, products: Tensor, near: Tensor, damping: float | Tensor) -> tuple[Tensor, Tensor]:
        """The rows' bands `[B, 3 R, 15]` of the matrix, scaled from both sides to a diagonal of 1; by what, `[B, 1, 3 N]`.

        Arguments: `products [B, N, 21, 21]` of every stencil row's columns with each other; `near [B, 4, 3, N, 3]`, further
        blocks between the vertices and those at `NEAR` from them; `damping`, a share of the diagonal.
        """
        chunks = products.unflatten(-1, (-1, 3)).flatten(1, 3).index_select(1, self.product_sources)
        parts = chunks.split([prod(size) for size in self.sizes], 1)
        own, beside, *further = (part.unflatten(1, size).sum(1) for part, size in zip(parts, self.sizes, strict=True))
        own = (own + near[:, :1]) * (1 + damping * self.one[:, None])
        scale = (own.diagonal(dim1=2, dim2=4).squeeze(1) + self.fixed).rsqrt()
        there = scale.index_select(1, self.ends).unflatten(1, (-1, 1, self.count))
        blocks = torch.cat([own, beside + near[:, 1:], *further], 1) * scale.mT[:, None, :, :, None] * there
        rows = blocks.transpose(2, 3)
        constants = torch.stack([torch.zeros_like(self.one), self.one]).to(rows).flatten(1).expand(rows.shape[0], -1, -1)
        entries = torch.cat([rows.flatten(3).flatten(1, 2), rows.mT.flatten(3).flatten(1, 2), constants], 1)
        band = entries.index_select(1, self.band_sources).unflatten(2, (3, 3)).unflatten(1, (-1, 2 * REACH + 1))
        return band.transpose(2, 3).flatten(1, 2).flatten(2), scale.mT.flatten(1)[:, None]

    def dense(self, band: Tensor) -> Tensor:
        """Blocks `[B, K, s, s]` from bands `[B, K s, 15]`: their rows, between a vertex and those at most `REACH` columns off.

        Behind as many zeros as make a row of the matrix, and three more a vertex, each lies where it belongs, but for a shift.
        """
        size = 3 * self.columns
        rows = F.pad(band, (0, size - band.shape[-1])).unflatten(1, (-1, self.columns, 3)).flatten(3)
        skewed = F.pad(rows, (0, 3)).flatten(2)
        return skewed[..., 3 * REACH : 3 * (REACH - self.columns)].unflatten(2, (-1, size))

    def factor(self, matrix: tuple[Tensor, Tensor]) -> tuple[Tensor, ...]:
        """What `substitute` needs, from what `matrix` gives."""
        band, scale = matrix
        roots, couplings = block_pentadiagonal.factor(band.split(self.parts, 1), self.dense)
        return *roots, *couplings, scale

    def substitute(self, factor: tuple[Tensor, ...], loads: Tensor) -> Tensor:
        """Solutions `[B, C, 3 N]` for `loads` of that shape."""
        *blocks, scale = factor
        roots = len(blocks) // 2 + 1  # and a coupling between two
        x = block_pentadiagonal.substitute((blocks[:roots], blocks[roots:]), self.in_blocks(scale * loads))
        return scale * self.from_blocks(x)

    def in_blocks(self, vector: Tensor) -> Tensor:
        """Vectors `[B, C, 3 N]` as blocks `[B, rows, C, s]` in the order of their elimination."""
        m, n = self.inner_grid
        field = F.pad(vector.unflatten(-1, (3, m, n)), (0, self.columns - n, 0, self.rows - m))
        return field.permute(0, 3, 1, 4, 2).flatten(3).index_select(1, self.order)

    def from_blocks(self, blocks: Tensor) -> Tensor:
        """`in_blocks` undone."""
        m, n = self.inner_grid
        field = blocks.index_select(1, self.place_of_row).unflatten(-1, (-1, 3)).permute(0, 2, 4, 1, 3)
        return field[..., :m, :n].flatten(-3)


class _Inner(NamedTuple):
    """Rows and columns `[N]` of the inner vertices, and the number of a vertex at given ones, -1 outside."""

    row: np.ndarray
    column: np.ndarray
    size: tuple[int, int]

    @classmethod
    def of(cls, grid: tuple[int, int]) -> "_Inner":
        size = (grid[0] - 2, grid[1] - 2)
        row, column = np.indices(size)
        return cls(row.ravel(), column.ravel(), size)

    def at(self, row: np.ndarray, column: np.ndarray) -> np.ndarray:
        inside = (row >= 0) & (row < self.size[0]) & (column >= 0) & (column < self.size[1])
        return np.where(inside, row * self.size[1] + column, -1)

    def beside(self, offset: tuple[int, int]) -> np.ndarray:
        """The number of every vertex' neighbour at an offset; of some vertex where there is none."""
        return self.at(self.row + offset[0], self.column + offset[1]).clip(min=0)


def _offsets() -> list[list[tuple[tuple[int, int], list[tuple[int, int]]]]]:
    """Offsets between two vertices of a stencil, none beside its opposite, and the pairs of slots they join, by how many.

    The first group is a vertex's offset to itself, the second those to its neighbours: together `NEAR`.
    """
    pairs: dict[tuple[int, int], list[tuple[int, int]]] = {}
    for a, start in enumerate(STENCIL):
        for b, end in enumerate(STENCIL):
            pairs.setdefault((end[0] - start[0], end[1] - start[1]), []).append((a, b))
    upper = sorted((-len(found), offset, found) for offset, found in pairs.items() if offset >= (0, 0))
    return [[(offset, found) for _, offset, found in group] for _, group in groupby(upper, key=itemgetter(0))]


_ZERO = STENCIL.index((-1, -1))  # the first inner vertex's column for this neighbour, on the border, is zero


def _product_sources(grid: tuple[int, int], offset: tuple[int, int], pairs: list[tuple[int, int]]) -> np.ndarray:
    """Where in products `[N, 21, 7]` the rows of the block between a vertex and that at an `offset` from it have their parts:
    `[K, 3, N]`."""
    inner, component, slots = _Inner.of(grid), np.arange(3)[:, None], len(STENCIL)
    di, dj = offset
    sources = []
    for a, b in pairs:
        i, j = STENCIL[a]
        row, other = inner.at(inner.row - i, inner.column - j), inner.at(inner.row + di, inner.column + dj)
        source = (row * 3 * slots + 3 * a + component) * slots + b
        sources.append(np.where((row >= 0) & (other >= 0), source, 3 * _ZERO * slots + _ZERO))
    return np.stack(sources)


def _band_sources(
    grid: tuple[int, int], offsets: list[tuple[int, int]], free: np.ndarray, rows: int, columns: int
) -> np.ndarray:
    """Where the blocks between a vertex and those at most `REACH` columns from it are, `[places, columns, 5]`, in a matrix'
    places: among the vertices' blocks at the `offsets`, the transposed ones, a zero and a one."""
    inner, N, K = _Inner.of(grid), len(free), len(offsets)
    number = np.full((2 * REACH + 1,) * 2, -1)
    for k, offset in enumerate(offsets):
        number[offset] = k  # negative indices wrap: the opposite offset has its own place
    i, other = np.concatenate(block_pentadiagonal.places(rows)).T[:, :, None, None]
    j, di, dj = np.arange(columns)[:, None], other - i, np.arange(-REACH, REACH + 1)
    p, q = inner.at(i, j), inner.at(i + di, j + dj)
    used, itself = (p >= 0) & free[p], (i >= 0) & (di == 0) & (dj == 0)
    close = used & (q >= 0) & free[q] & (abs(di) <= REACH)
    di, dj = np.where(close, di, 0), np.where(close, dj, 0)
    upper, lower = number[di, dj], number[-di, -dj]
    entry = np.where(upper >= 0, upper * N + p, (K + lower) * N + q)
    return np.where(close & ((upper >= 0) | (lower >= 0)), entry, 2 * K * N + (itself & ~used))
