"""Symmetric systems on a grid from products of seven-point stencils, solved by elimination over pairs of grid rows."""

from itertools import groupby
from math import prod
from operator import itemgetter
from types import ModuleType
from typing import NamedTuple

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from ..surface.stencil import STENCIL
from . import block_tridiagonal, matrix_products

NEAR = ((0, 0), (0, 1), (1, 0), (1, 1))  # from a vertex to itself and to its neighbours further on


class StencilSystem(nn.Module):
    """Three unknowns per inner vertex of an `m x n` grid, one block per two grid rows; the matrix is block tridiagonal.

    Vectors are fields `[3, N]` over the inner vertices, flattened. Sums are gathered, not scattered, three numbers at a time:
    where they come from is known beforehand.

    Args:
        grid: `(m, n)`.
        free: `[N]` bool, which inner vertices are free. Columns of the others must be zero.
    """

    order: Tensor
    block_of_row: Tensor
    product_sources: Tensor
    scatter_index: Tensor
    ends: Tensor
    one: Tensor
    fixed: Tensor

    def __init__(self, grid: tuple[int, int], free: Tensor):
        super().__init__()
        m, n = grid
        self.count, self.blocks, self.block_size = (m - 2) * (n - 2), (m - 1) // 2, 6 * (n - 2)
        groups = _offsets()
        offsets = [offset for group in groups for offset, _ in group]
        sources = [np.stack([_product_sources(grid, *joined) for joined in group], 1) for group in groups]
        self.sizes = [source.shape for source in sources]
        for name, index in (
            ("order", np.array(block_tridiagonal.inwards(self.blocks))),
            ("block_of_row", np.argsort(block_tridiagonal.inwards(self.blocks))),
            ("product_sources", np.concatenate([source.ravel() for source in sources])),
            ("scatter_index", _scatter_index(grid, offsets, free.cpu().numpy(), self.blocks).ravel()),
            ("ends", np.concatenate([_Inner.of(grid).beside(offset) for offset in offsets])),
        ):
            self.register_buffer(name, torch.from_numpy(index.astype(np.int32)))
        self.register_buffer("one", torch.eye(3, dtype=torch.float64))
        self.register_buffer("fixed", (~free).double()[:, None])

    def matrix(self, products: Tensor, near: Tensor, damping: float = 1e-6) -> tuple[Tensor, Tensor, Tensor]:
        """Blocks on the diagonal `[B, blocks, s, s]` and beside it `[B, blocks - 1, s, s]`, as `block_tridiagonal.factor` takes
        them, scaled from both sides to a diagonal of 1; by what, `[B, 1, 3 N]`.

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
        matrix = entries.index_select(1, self.scatter_index).flatten(1).unflatten(1, (-1, s, s))
        return *matrix.split([self.blocks, self.blocks - 1], 1), scale.mT.flatten(1)[:, None]

    def factor(self, matrix: tuple[Tensor, Tensor, Tensor]) -> tuple[Tensor, ...]:
        """What `substitute` needs, from what `matrix` gives."""
        diagonal, coupling, scale = matrix
        pivots, couplings = _elimination().factor(diagonal, coupling)
        return *pivots, *couplings, scale

    def substitute(self, factor: tuple[Tensor, ...], loads: Tensor) -> Tensor:
        """Solutions `[B, C, 3 N]` for `loads` of that shape."""
        *blocks, scale = factor
        pivots = len(blocks) // 2 + 1  # and a coupling between two
        x = _elimination().substitute((blocks[:pivots], blocks[pivots:]), self.in_blocks(scale * loads))
        return scale * self.from_blocks(x)

    def in_blocks(self, vector: Tensor) -> Tensor:
        """Vectors `[B, C, 3 N]` as blocks `[B, blocks, C, s]` in the order of their elimination."""
        unknowns = vector.unflatten(-1, (3, -1)).mT.flatten(-2)
        padded = F.pad(unknowns, (0, self.blocks * self.block_size - 3 * self.count))
        return padded.unflatten(-1, (self.blocks, self.block_size)).transpose(1, 2).index_select(1, self.order)

    def from_blocks(self, blocks: Tensor) -> Tensor:
        """`in_blocks` undone."""
        unknowns = blocks.index_select(1, self.block_of_row).transpose(1, 2).flatten(-2)[..., : 3 * self.count]
        return unknowns.unflatten(-1, (-1, 3)).mT.flatten(-2)


def _elimination() -> ModuleType:
    return matrix_products if torch.compiler.is_exporting() else block_tridiagonal


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


def _scatter_index(grid: tuple[int, int], offsets: list[tuple[int, int]], free: np.ndarray, blocks: int) -> np.ndarray:
    """Where three neighbouring entries of the blocks on the diagonal, then of those beside it, are, `[2 blocks - 1, s, s / 3]`:
    in the blocks' rows `[offsets, 3, N]`, their columns `[offsets, 3, N]`, a one's rows, one after another."""
    inner, N, s = _Inner.of(grid), len(free), 6 * (grid[1] - 2)
    number = np.full((5, 5), -1)
    for k, offset in enumerate(offsets):
        number[offset] = k  # negative indices wrap: the opposite offset has its own place
    unknown = np.arange(blocks * s).reshape(blocks, s)
    rows, columns = np.array([(k, k) for k in block_tridiagonal.inwards(blocks)] + block_tridiagonal.coupled(blocks)).T
    p, c = np.divmod(unknown[rows][:, :, None], 3)
    q = unknown[columns][:, None, ::3] // 3
    used = [(vertex < N) & free[vertex.clip(max=N - 1)] for vertex in (p, q)]
    i, j = (index[q.clip(max=N - 1)] - index[p.clip(max=N - 1)] for index in (inner.row, inner.column))
    close = used[0] & used[1] & (abs(i) <= 2) & (abs(j) <= 2)
    i, j = np.where(close, i, 0), np.where(close, j, 0)
    upper, lower = number[i, j], number[-i, -j]
    entry = np.where(upper >= 0, (3 * upper + c) * N + p, (3 * (len(offsets) + lower) + c) * N + q)
    zero, one = (3 * offsets.index((2, 2)) + 1) * N - 1, 6 * len(offsets) * N + c
    entry = np.where(close & ((upper >= 0) | (lower >= 0)), entry, zero)
    return np.where((p == q) & ~used[0], one, entry)
