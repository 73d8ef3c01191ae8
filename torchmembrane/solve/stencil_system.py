"""Symmetric systems on a grid from products of seven-point stencils, solved by elimination over pairs of grid rows."""

from itertools import groupby
from math import prod
from operator import itemgetter
from typing import NamedTuple

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from ..stencil import STENCIL
from . import block_tridiagonal, matrix_products

NEAR = ((0, 0), (0, 1), (1, 0), (1, 1))  # from a vertex to itself and to its neighbours further on


class StencilSystem(nn.Module):
    """Three unknowns an inner vertex of an `m x n` grid, those of two grid rows a block; the matrix is block tridiagonal.

    Arguments: the grid and `free [N]` bool, the inner vertices that move. Columns of those that do not must be zero.
    Sums are gathered, not scattered, three numbers at a time: where they come from is known beforehand.
    """

    def __init__(self, grid: tuple[int, int], free: Tensor):
        super().__init__()
        m, n = grid
        self.count, self.blocks, self.block_size = (m - 2) * (n - 2), (m - 1) // 2, 6 * (n - 2)
        groups = _ways()
        ways = [way for group in groups for way, _ in group]
        sources = [np.stack([_product_sources(grid, way) for way in group], 1) for group in groups]
        self.sizes = [source.shape for source in sources]
        for name, index in (
            ("neighbours", _neighbours(grid).ravel()),
            ("row_sources", _row_sources(grid).ravel()),
            ("product_sources", np.concatenate([source.ravel() for source in sources])),
            ("places", _places(grid, ways, free.cpu().numpy(), self.blocks).ravel()),
            ("ends", np.concatenate([_Inner.of(grid).beside(way) for way in ways])),
        ):
            self.register_buffer(name, torch.from_numpy(index.astype(np.int32)))
        self.register_buffer("one", torch.eye(3, dtype=torch.float64))
        self.register_buffer("fixed", (~free).double()[:, None])

    def vector(self, rows: Tensor) -> Tensor:
        """Sum of stencil rows `[B, N, 21, C]`, in the system's order `[B, unknowns, C]`."""
        chunks = rows.unflatten(2, (len(STENCIL), 3)).flatten(1, 2).flatten(2).index_select(1, self.row_sources)
        sums = chunks.unflatten(1, (len(STENCIL), -1)).sum(1)
        return self.padded(sums.unflatten(2, (3, -1)).flatten(1, 2))

    def rows(self, vector: Tensor) -> Tensor:
        """Values `[B, N, 21, C]` around the inner vertices of a vector `[B, unknowns, C]`: `vector`'s adjoint where free."""
        return self.field(vector).index_select(1, self.neighbours).unflatten(1, (-1, len(STENCIL))).flatten(2, 3)

    def padded(self, unknowns: Tensor) -> Tensor:
        """Unknowns of the inner vertices `[B, 3 N, C]` in the system's order `[B, unknowns, C]`."""
        return F.pad(unknowns, (0, 0, 0, self.blocks * self.block_size - 3 * self.count))

    def field(self, vector: Tensor) -> Tensor:
        """The inner vertices' field `[B, N, 3, ...]` of a vector `[B, unknowns, ...]` in the system's order."""
        return vector[:, : 3 * self.count].unflatten(1, (self.count, 3))

    def matrix(self, products: Tensor, near: Tensor, damping: float = 1e-6) -> tuple[Tensor, Tensor, Tensor]:
        """Blocks on the diagonal `[B, blocks, s, s]` and above it `[B, blocks - 1, s, s]`, scaled from both sides to a diagonal
        of 1; by what, `[B, unknowns, 1]`.

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
        one = self.one.to(blocks).expand(blocks.shape[0], 3, 3)
        entries = torch.cat([blocks.flatten(1, 3), blocks.transpose(2, 4).flatten(1, 3), one], 1)
        s = self.block_size
        matrix = entries.index_select(1, self.places).flatten(1).unflatten(1, (-1, s, s))
        return *matrix.split([self.blocks, self.blocks - 1], 1), self.padded(scale.flatten(1)[..., None])

    def solve(
        self, matrix: tuple[Tensor, Tensor, Tensor], loads: Tensor, keep=False
    ) -> tuple[Tensor, tuple[Tensor, ...] | None]:
        """Solutions `[B, unknowns, C]` for `loads` of that shape; with `keep` also what `substitute` needs to find others."""
        diagonal, upper, scale = matrix
        x, factor = _elimination().solve(diagonal, upper, self._in_blocks(scale * loads))
        return scale * x.flatten(1, 2), (*(torch.cat(blocks, 1) for blocks in factor), scale) if keep else None

    def substitute(self, factor: tuple[Tensor, ...], loads: Tensor) -> Tensor:
        """Solutions for other loads, with what `solve` kept."""
        *elimination, scale = factor
        return scale * _elimination().substitute(elimination, self._in_blocks(scale * loads)).flatten(1, 2)

    def _in_blocks(self, vector: Tensor) -> Tensor:
        return vector.unflatten(1, (self.blocks, self.block_size))


def _elimination():
    return matrix_products if torch.compiler.is_exporting() else block_tridiagonal


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

    def beside(self, way):
        """The number of every vertex' neighbour on its way; of some vertex where there is none."""
        return self.at(self.row + way[0], self.column + way[1]).clip(min=0)


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


def _neighbours(grid) -> np.ndarray:
    """The inner vertices `[N, 7]` around each."""
    return np.stack([_Inner.of(grid).beside(way) for way in STENCIL], 1)


def _row_sources(grid) -> np.ndarray:
    """For every slot, where in rows `[N, 7]` a vertex `[N]` is the slot's neighbour: `[7, N]`."""
    inner, sources = _Inner.of(grid), []
    for slot, (i, j) in enumerate(STENCIL):
        row = inner.at(inner.row - i, inner.column - j)
        sources.append(np.where(row >= 0, row * len(STENCIL) + slot, _ZERO))
    return np.stack(sources)


def _product_sources(grid, way) -> np.ndarray:
    """Where in products `[N, 21, 7]` the rows of the block between a vertex and that on its `way` have their parts:
    `[K, 3, N]`."""
    inner, component, slots = _Inner.of(grid), np.arange(3)[:, None], len(STENCIL)
    (di, dj), pairs = way
    sources = []
    for a, b in pairs:
        i, j = STENCIL[a]
        row, other = inner.at(inner.row - i, inner.column - j), inner.at(inner.row + di, inner.column + dj)
        place = (row * 3 * slots + 3 * a + component) * slots + b
        sources.append(np.where((row >= 0) & (other >= 0), place, 3 * _ZERO * slots + _ZERO))
    return np.stack(sources)


def _places(grid, ways, free, blocks) -> np.ndarray:
    """Where three neighbouring entries of the matrix are, `[2 blocks - 1, s, s / 3]`: in the blocks' rows `[ways, 3, N]`, their
    columns `[ways, 3, N]`, a one's rows, one after another."""
    inner, N, s = _Inner.of(grid), len(free), 6 * (grid[1] - 2)
    number = np.full((5, 5), -1)
    for k, way in enumerate(ways):
        number[way] = k  # negative indices wrap: the way back has its own place
    unknown = np.arange(blocks * s).reshape(blocks, s)
    p, c = np.divmod(np.concatenate([unknown, unknown[:-1]])[:, :, None], 3)
    q = np.concatenate([unknown, unknown[1:]])[:, None, ::3] // 3
    used = [(vertex < N) & free[vertex.clip(max=N - 1)] for vertex in (p, q)]
    i, j = (index[q.clip(max=N - 1)] - index[p.clip(max=N - 1)] for index in (inner.row, inner.column))
    close = used[0] & used[1] & (abs(i) <= 2) & (abs(j) <= 2)
    i, j = np.where(close, i, 0), np.where(close, j, 0)
    forth, back = number[i, j], number[-i, -j]
    entry = np.where(forth >= 0, (3 * forth + c) * N + p, (3 * (len(ways) + back) + c) * N + q)
    zero, one = (3 * ways.index((2, 2)) + 1) * N - 1, 6 * len(ways) * N + c
    entry = np.where(close & ((forth >= 0) | (back >= 0)), entry, zero)
    return np.where((p == q) & ~used[0], one, entry)
