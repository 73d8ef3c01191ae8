"""Two layouts of the matrix of a `StencilSystem`, assembled from the vertices' 3 x 3 blocks: blocks of grid rows, or a band."""

from typing import NamedTuple

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from . import band, block_pentadiagonal
from .block_tridiagonal import inwards

NEAR = ((0, 0), (0, 1), (1, 0), (1, 1))  # from a vertex to itself and to its later neighbours
OFFSETS = (*NEAR, (0, 2), (1, -1), (1, 2), (2, 0), (2, 1), (2, 2))
"""Offsets between two vertices of a stencil; of two opposite offsets only one is listed."""
REACH = 2  # largest offset between two vertices of a stencil, grid lines
WIDTH = 3 * (2 * REACH + 1) + 2
"""Stored entries per matrix row and neighbouring grid row. They are aligned with the diagonal, so those of a vertex's second
and third rows start one and two places further to the left."""
LEFT = 3 * REACH + 2
"""Stored entries to the left of the diagonal."""


class RowBlocks(nn.Module):
    """Layout with one block per grid row: a block-pentadiagonal matrix.

    Args:
        grid: `(m, n)`.
        free: which inner vertices are free, `[N]` bool.
    """

    order: Tensor
    place_of_row: Tensor
    sources: Tensor

    def __init__(self, grid: tuple[int, int], free: Tensor):
        super().__init__()
        m, n = self.inner_grid = grid[0] - 2, grid[1] - 2
        self.rows = max(3, m + (m + 1) % 2)  # an odd number
        self.columns = enough_columns(n)
        places = block_pentadiagonal.places(self.rows)
        self.parts = [3 * self.columns * len(part) for part in places]
        sources = _sources(self.inner_grid, free.cpu().numpy(), np.concatenate(places), self.columns)
        for name, index in (
            ("order", np.array(inwards(self.rows))),
            ("place_of_row", np.argsort(inwards(self.rows))),
            ("sources", sources.ravel()),
        ):
            self.register_buffer(name, torch.from_numpy(index.astype(np.int32)))

    def factor(self, entries: Tensor) -> block_pentadiagonal.Factor:
        """Factor the matrix for `substitute`; `entries [B, 90 N + 2]` are the scaled vertex blocks, a zero and a one."""
        matrix = entries.index_select(1, self.sources).unflatten(1, (-1, WIDTH))
        return block_pentadiagonal.factor(matrix.split(self.parts, 1), self.dense)

    def dense(self, rows: Tensor) -> Tensor:
        """Return dense blocks `[B K, s, s]` from stored rows `[B, K s, 17]`, which reach `REACH` columns to either side.

        Every row is padded with zeros to `s + 1` entries. In the flattened array, each entry then lies at its place in the
        dense block, except for a common shift.
        """
        size = 3 * self.columns
        whole = F.pad(rows, (0, size + 1 - WIDTH)).reshape(-1, size * (size + 1))
        return whole[:, LEFT : LEFT - size].unflatten(1, (size, size))

    def substitute(self, factor: block_pentadiagonal.Factor, loads: Tensor) -> Tensor:
        """Return the solutions `[B, C, 3 N]` for `loads [B, C, 3 N]`."""
        return self.from_blocks(block_pentadiagonal.substitute(factor, self.in_blocks(loads)))

    def in_blocks(self, vector: Tensor) -> Tensor:
        """Arrange vectors `[B, C, 3 N]` as blocks `[B, rows, C, s]` in the order of elimination."""
        m, n = self.inner_grid
        field = F.pad(vector.unflatten(-1, (3, m, n)), (0, self.columns - n, 0, self.rows - m))
        by_vertex = field.flatten(3).transpose(2, 3)  # axis by axis: onnxruntime is slow at several
        by_row = by_vertex.reshape(*by_vertex.shape[:2], self.rows, -1).transpose(1, 2)
        return by_row.index_select(1, self.order)

    def from_blocks(self, blocks: Tensor) -> Tensor:
        """Arrange blocks as vectors again: the inverse of `in_blocks`."""
        m, n = self.inner_grid
        by_row = blocks.index_select(1, self.place_of_row).transpose(1, 2)
        field = by_row.reshape(*by_row.shape[:2], -1, 3).transpose(2, 3).unflatten(-1, (self.rows, self.columns))
        return field[..., :m, :n].flatten(-3)


class Band(nn.Module):
    """Layout as a band matrix, with the unknowns ordered vertex by vertex and grid row by grid row.

    Args:
        grid: `(m, n)`.
        free: which inner vertices are free, `[N]` bool.
    """

    sources: Tensor

    def __init__(self, grid: tuple[int, int], free: Tensor):
        super().__init__()
        m, n = self.inner_grid = grid[0] - 2, grid[1] - 2
        self.columns = enough_columns(n)
        places = np.array([(i, i + further) for i in range(m) for further in range(REACH + 1)])
        sources = _sources(self.inner_grid, free.cpu().numpy(), places, self.columns).reshape(m, REACH + 1, -1, WIDTH)
        sources = sources.swapaxes(1, 2).reshape(3 * m * self.columns, -1)[:, LEFT:]
        self.register_buffer("sources", torch.from_numpy(sources.astype(np.int32)).flatten())
        self.starts = [0, 3 * self.columns - LEFT, 6 * self.columns - LEFT]
        self.widths = [WIDTH - LEFT, WIDTH, WIDTH]

    def factor(self, entries: Tensor) -> Tensor:
        """Factor the matrix, as `RowBlocks.factor` does."""
        rows = entries.index_select(1, self.sources).unflatten(1, (-1, sum(self.widths)))
        return band.factor(rows.split(self.widths, 2), self.starts)

    def substitute(self, factor: Tensor, loads: Tensor) -> Tensor:
        """Return the solutions `[B, C, 3 N]` for `loads [B, C, 3 N]`."""
        m, n = self.inner_grid
        field = F.pad(loads.unflatten(-1, (3, m, n)), (0, self.columns - n))
        solved = band.solve(factor, field.movedim(2, -1).flatten(2))
        return solved.unflatten(-1, (m, self.columns, 3))[:, :, :, :n].movedim(-1, 2).flatten(2)


def enough_columns(n: int) -> int:
    """Return the number of columns to compute with: at least as many as a stored row of the matrix spans."""
    return max(n, 2 * REACH + 2)


class Inner(NamedTuple):
    """Rows and columns `[N]` of the inner vertices; `at` gives the index of the vertex in a row and column, -1 outside."""

    row: np.ndarray
    column: np.ndarray
    size: tuple[int, int]

    @classmethod
    def from_size(cls, size: tuple[int, int]) -> "Inner":
        row, column = np.indices(size)
        return cls(row.ravel(), column.ravel(), size)

    def at(self, row: np.ndarray, column: np.ndarray) -> np.ndarray:
        inside = (row >= 0) & (row < self.size[0]) & (column >= 0) & (column < self.size[1])
        return np.where(inside, row * self.size[1] + column, -1)


def _sources(inner_grid: tuple[int, int], free: np.ndarray, places: np.ndarray, columns: int) -> np.ndarray:
    """Return the indices `[places, columns, 3, WIDTH]` that gather the stored matrix rows from the flattened vertex blocks
    `[3, 3, 10, N]`, which are followed by a zero and a one.

    Each of the `places [places, 2]` is a pair of grid rows. A stored row has the entries between an unknown of a vertex in the
    first grid row and those of the vertices at most `REACH` columns away in the second. Places with a row of -1 are zero.
    """
    inner, N, K = Inner.from_size(inner_grid), len(free), len(OFFSETS)
    number = np.full((2 * REACH + 1,) * 2, -1)
    for k, offset in enumerate(OFFSETS):
        number[offset] = k  # negative indices wrap around, so the opposite offset has its own entry
    i, other = (at[:, None, None, None, None] for at in places.T)
    j, a, b = np.arange(columns)[:, None, None, None], np.arange(3)[:, None, None], np.arange(3)
    di, dj = other - i, np.arange(-REACH, REACH + 1)[:, None]
    p, q = inner.at(i, j), inner.at(i + di, j + dj)
    close = (p >= 0) & free[p] & (q >= 0) & free[q] & (abs(di) <= REACH)
    di, dj_close = np.where(close, di, 0), np.where(close, dj, 0)
    upper, lower = number[di, dj_close], number[-di, -dj_close]
    entry = np.where(upper >= 0, ((3 * a + b) * K + upper) * N + p, ((3 * b + a) * K + lower) * N + q)
    zero, is_own = 9 * K * N, (i >= 0) & (other == i) & (dj == 0) & (a == b)
    entry = np.where(is_own, zero + 1, np.where(close & ((upper >= 0) | (lower >= 0)), entry, zero))
    sources = np.full((*entry.shape[:3], WIDTH), zero)
    for row in range(3):
        sources[:, :, row, 2 - row : WIDTH - row] = entry[:, :, row].reshape(*entry.shape[:2], -1)
    return sources
