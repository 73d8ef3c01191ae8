"""Symmetric systems on a grid from products of seven-point stencils, solved by elimination over pairs of grid rows."""

from itertools import groupby
from operator import itemgetter
from typing import NamedTuple

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from ..stencil import STENCIL
from . import block_tridiagonal, matrix_products

NEAR = ((0, 0), (0, 1), (1, 0), (1, 1))  # from a vertex to itself and to its neighbours further on
COLUMNS = 3 * len(STENCIL)


class StencilSystem(nn.Module):
    """Three unknowns an inner vertex of an `m x n` grid, those of two grid rows a block; the matrix is block tridiagonal.

    Arguments: `free [N]` bool, the inner vertices that move; `columns`, of the rows over inner vertices `[B, N, ..., columns]`
    that `matrix` takes: their stencil's 21, then others. Columns of vertices that do not move must be zero.
    Sums are gathered, not scattered: where an entry comes from is known beforehand.
    """

    def __init__(self, grid: tuple[int, int], free: Tensor, columns: int):
        super().__init__()
        m, n = grid
        self.count, self.blocks, self.block_size = (m - 2) * (n - 2), (m - 1) // 2, 6 * (n - 2)
        groups = _ways()
        sources = [np.stack([_product_sources(grid, way, columns) for way in group], 1) for group in groups]
        self.sizes = [source.shape for source in sources]
        for name, index in (
            ("row_sources", _row_sources(grid).ravel()),
            ("product_sources", np.concatenate([source.ravel() for source in sources])),
            ("places", _places(grid, [way for group in groups for way, _ in group], free.cpu().numpy(), self.blocks).ravel()),
        ):
            self.register_buffer(name, torch.from_numpy(index.astype(np.int32)))
        self.register_buffer("on_diagonal", torch.eye(3, dtype=torch.float64).reshape(9, 1))

    def vector(self, rows: Tensor) -> Tensor:
        """Sum of stencil rows `[..., N, 21]`, in the system's order `[..., unknowns]`."""
        flat = rows.flatten(-2)
        gathered = flat.flatten(0, -2).index_select(1, self.row_sources)
        return self.padded(gathered.unflatten(-1, (len(STENCIL), -1)).sum(-2).unflatten(0, flat.shape[:-1]))

    def padded(self, unknowns: Tensor) -> Tensor:
        """Unknowns of the inner vertices `[..., 3 N]` in the system's order `[..., unknowns]`."""
        return F.pad(unknowns, (0, self.blocks * self.block_size - 3 * self.count))

    def field(self, vector: Tensor) -> Tensor:
        """The inner vertices' field `[..., N, 3]` of a vector in the system's order."""
        return vector[..., : 3 * self.count].unflatten(-1, (self.count, 3))

    def matrix(self, products: Tensor, near: Tensor, damping: float = 1e-6) -> tuple[Tensor, Tensor]:
        """Blocks on the diagonal `[B, blocks, s, s]` and above it `[B, blocks - 1, s, s]`.

        Arguments: `products [B, N, columns, columns]` of every row's columns with each other; `near [B, 4, 9, N]`, further
        blocks between the vertices and those at `NEAR` from them; `damping`, a share of the diagonal.
        """
        gathered = products.flatten(1).index_select(1, self.product_sources).split([np.prod(size) for size in self.sizes], 1)
        entries = [part.unflatten(1, size).sum(1) for part, size in zip(gathered, self.sizes, strict=True)]
        entries[0] = (entries[0] + near[:, :1]) * (1 + damping * self.on_diagonal)
        entries[1] = entries[1] + near[:, 1:]
        one = torch.ones_like(near[:, 0, 0, :1])
        s = self.block_size
        blocks = torch.cat([*(entry.flatten(1) for entry in entries), one], 1).index_select(1, self.places)
        return blocks.unflatten(1, (-1, s, s)).split([self.blocks, self.blocks - 1], 1)

    def solve(self, matrix: tuple[Tensor, Tensor], loads: Tensor) -> Tensor:
        """Solutions `[B, unknowns, C]` for `loads` of that shape."""
        elimination = matrix_products if torch.compiler.is_exporting() else block_tridiagonal
        return elimination.solve(*matrix, loads.unflatten(1, (self.blocks, self.block_size))).flatten(1, 2)


class _Inner(NamedTuple):
    """Rows and columns `[N]` of the inner vertices, and the number of a vertex at given ones, -1 outside."""

    row: np.ndarray
    column: np.ndarray
    size: tuple[int, int]

    @classmethod
    def of(cls, grid):
        size = (grid[0] - 2, grid[1] - 2)
        return cls(*(index.ravel() for index in np.indices(size)), size)

    def at(self, row, column):
        inside = (row >= 0) & (row < self.size[0]) & (column >= 0) & (column < self.size[1])
        return np.where(inside, row * self.size[1] + column, -1)


def _ways() -> list[list[tuple[tuple[int, int], list[tuple[int, int]]]]]:
    """Ways between two vertices of a stencil, none beside its reverse, and the pairs of slots they join, grouped by how many.

    The first group is a vertex's way to itself, the second those to its neighbours: together `NEAR`.
    """
    pairs = {}
    for a, start in enumerate(STENCIL):
        for b, end in enumerate(STENCIL):
            pairs.setdefault((end[0] - start[0], end[1] - start[1]), []).append((a, b))
    forth = sorted((-len(found), way, found) for way, found in pairs.items() if way >= (0, 0))
    return [[(way, found) for _, way, found in group] for _, group in groupby(forth, key=itemgetter(0))]


_ZERO = STENCIL.index((-1, -1))  # the first inner vertex's column for this neighbour, on the border, is zero


def _row_sources(grid) -> np.ndarray:
    """For every slot, where in rows `[N, 21]` a vertex `[N]` and component `[3]` is the slot's neighbour: `[7, N, 3]`."""
    inner, component = _Inner.of(grid), np.arange(3)
    sources = []
    for slot, (i, j) in enumerate(STENCIL):
        row = inner.at(inner.row - i, inner.column - j)[:, None]
        sources.append(np.where(row >= 0, row * COLUMNS + 3 * slot + component, 3 * _ZERO))
    return np.stack(sources)


def _product_sources(grid, way, columns) -> np.ndarray:
    """Where in products `[N, columns, columns]` the block between a vertex and that on its `way` has its parts: `[K, 9, N]`."""
    inner, (first, second) = _Inner.of(grid), np.divmod(np.arange(9)[:, None], 3)
    (di, dj), pairs = way
    sources = []
    for a, b in pairs:
        i, j = STENCIL[a]
        row, other = inner.at(inner.row - i, inner.column - j), inner.at(inner.row + di, inner.column + dj)
        place = (row * columns + 3 * a + first) * columns + 3 * b + second
        sources.append(np.where((row >= 0) & (other >= 0), place, 3 * _ZERO * (columns + 1)))
    return np.stack(sources)


def _places(grid, ways, free, blocks) -> np.ndarray:
    """Where in the entries `[ways, 9, N]`, then a one, every entry of the matrix is: `[2 blocks - 1, s, s]`."""
    inner, N, s = _Inner.of(grid), len(free), 6 * (grid[1] - 2)
    number = np.full((5, 5), -1)
    for k, way in enumerate(ways):
        number[way] = k  # negative indices wrap: the way back has its own place
    unknown = np.arange(blocks * s).reshape(blocks, s)
    row = np.concatenate([unknown, unknown[:-1]])[:, :, None]
    column = np.concatenate([unknown, unknown[1:]])[:, None, :]
    (p, c), (q, d) = np.divmod(row, 3), np.divmod(column, 3)
    used = [(vertex < N) & free[vertex.clip(max=N - 1)] for vertex in (p, q)]
    i, j = (index[q.clip(max=N - 1)] - index[p.clip(max=N - 1)] for index in (inner.row, inner.column))
    close = used[0] & used[1] & (abs(i) <= 2) & (abs(j) <= 2)
    i, j = np.where(close, i, 0), np.where(close, j, 0)
    forth, back = number[i, j], number[-i, -j]
    entry = np.where(forth >= 0, (forth * 9 + 3 * c + d) * N + p, (back * 9 + 3 * d + c) * N + q)
    zero, one = (ways.index((2, 2)) * 9 + 1) * N - 1, len(ways) * 9 * N
    entry = np.where(close & ((forth >= 0) | (back >= 0)), entry, zero)
    return np.where((row == column) & ~used[0], one, entry)
