"""Symmetric systems on a grid from products of seven-point stencils, solved by elimination over grid rows."""

from typing import NamedTuple

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from ..surface.stencil import STENCIL
from . import block_pentadiagonal
from .block_tridiagonal import inwards

NEAR = ((0, 0), (0, 1), (1, 0), (1, 1))  # from a vertex to itself and to its neighbours further on
OFFSETS = (*NEAR, (0, 2), (1, -1), (1, 2), (2, 0), (2, 1), (2, 2))
"""Between two vertices of a stencil, none beside its opposite."""
REACH = 2  # lines, between two vertices of a stencil
SLOTS = sorted(range(len(STENCIL)), key=STENCIL.__getitem__)
"""Of a stencil, in the order of the vertices: from one to a later one leads an offset, never its opposite."""
WIDTH = 3 * (2 * REACH + 1) + 2
"""Entries of a row of the matrix between two grid rows, each a place further to the left in the three rows of a vertex."""
LEFT = 3 * REACH + 2
"""Entries of a vertex's first row before the diagonal."""


class StencilSystem(nn.Module):
    """Three unknowns per inner vertex of an `m x n` grid, one block per grid row; the matrix is block pentadiagonal.

    Vectors are fields `[3, N]` over the inner vertices, flattened.

    Args:
        grid: `(m, n)`.
        free: `[N]` bool, which inner vertices are free. Columns of the others must be zero.
    """

    order: Tensor
    place_of_row: Tensor
    slots: Tensor
    band_sources: Tensor
    ends: Tensor
    offsets_of_pairs: Tensor
    fixed: Tensor

    def __init__(self, grid: tuple[int, int], free: Tensor):
        super().__init__()
        m, n = grid
        self.grid, self.inner_grid = grid, (m - 2, n - 2)
        self.rows = max(3, m - 2 + (m + 1) % 2)  # an odd number
        self.columns = max(n - 2, 2 * REACH + 2)  # no fewer than a row of the matrix reaches
        self.parts = [3 * self.columns * len(part) for part in block_pentadiagonal.places(self.rows)]
        for name, index in (
            ("order", np.array(inwards(self.rows))),
            ("place_of_row", np.argsort(inwards(self.rows))),
            ("slots", np.array(SLOTS)),
            ("band_sources", _band_sources(grid, free.cpu().numpy(), self.rows, self.columns).ravel()),
            ("ends", _ends(grid).ravel()),
        ):
            self.register_buffer(name, torch.from_numpy(index.astype(np.int32)))
        self.register_buffer("offsets_of_pairs", _offsets_of_pairs())
        self.register_buffer("fixed", (~free).double())

    def matrix(self, stencils: Tensor, weights: Tensor, near: Tensor, damping: float | Tensor) -> tuple[Tensor, Tensor]:
        """The rows' bands of `A^T W A` and further blocks, scaled from both sides to a diagonal of 1; by what, `[B, 1, 3 N]`.

        Args:
            stencils: `A [B, 3, 3, 7, N]`, of every vertex's three numbers, in the three of every vertex of its stencil.
            weights: `W [B, 3, 3, N]`, symmetric.
            near: `[B, 3, 3, 4, N]`, the further blocks, between the vertices and those at `NEAR` from them.
            damping: a share of the diagonal that is added.
        """
        blocks = self._blocks(stencils, weights)
        blocks = torch.cat([blocks[:, :, :, : len(NEAR)] + near, blocks[:, :, :, len(NEAR) :]], 3)
        scale = (blocks[:, :, :, 0].diagonal(dim1=1, dim2=2).mT * (1 + damping) + self.fixed).rsqrt()
        there = scale.flatten(1).index_select(1, self.ends).reshape(-1, 1, 3, *blocks.shape[3:])
        scaled = (blocks * scale[:, :, None, None] * there).flatten(1)
        constants = torch.stack([torch.zeros_like(scaled[:, 0]), torch.ones_like(scaled[:, 0])], 1)
        band = torch.cat([scaled, constants], 1).index_select(1, self.band_sources)
        return band.unflatten(1, (-1, WIDTH)), scale.flatten(1)[:, None]

    def _blocks(self, stencils: Tensor, weights: Tensor) -> Tensor:
        """Blocks of `A^T W A`, `[B, 3, 3, 10, N]`, between the vertices and those at `OFFSETS` from them.

        Both vertices are in the stencil of a third one. Grid rows between two zeros, two rows of zeros around all: so what
        belongs with the stencil of a vertex at an offset is as far behind as that has places.
        """
        n, (rows, _) = self.grid[1], self.inner_grid
        A = stencils.index_select(3, self.slots)
        WA = (weights[:, :, :, None, None] * A[:, None]).sum(2)
        left, right = (F.pad(part.unflatten(-1, self.inner_grid), (1, 1, 2, 2)).flatten(-2) for part in (A, WA))
        products = []
        for k, slot in enumerate(SLOTS):
            i, j = STENCIL[slot]
            here, later = (2 - i) * n - j, len(SLOTS) - k
            x1, x2, x3 = left.narrow(4, here, rows * n).narrow(3, k, 1)[:, :, :, None].unbind(1)
            y1, y2, y3 = right.narrow(4, here, rows * n).narrow(3, k, later)[:, :, None].unbind(1)
            products.append(torch.addcmul(torch.addcmul(x1 * y1, x2, y2), x3, y3))
        inside = (self.offsets_of_pairs @ torch.cat(products, 3)).unflatten(-1, (rows, n))
        return inside[..., 1:-1].flatten(-2)

    def dense(self, band: Tensor) -> Tensor:
        """Blocks `[B K, s, s]` from bands `[B, K s, 17]`: their rows, between a vertex and those at most `REACH` columns off.

        Behind as many zeros as make a row of the matrix and one more, each lies where it belongs, but for a shift.
        """
        size = 3 * self.columns
        rows = F.pad(band, (0, size + 1 - WIDTH)).reshape(-1, size * (size + 1))
        return rows[:, LEFT : LEFT - size].unflatten(1, (size, size))

    def factor(self, matrix: tuple[Tensor, Tensor]) -> tuple[Tensor, ...]:
        """What `substitute` needs, from what `matrix` gives."""
        band, scale = matrix
        roots, near, far = block_pentadiagonal.factor(band.split(self.parts, 1), self.dense)
        return *roots, *near, *far, scale

    def substitute(self, factor: tuple[Tensor, ...], loads: Tensor) -> Tensor:
        """Solutions `[B, C, 3 N]` for `loads` of that shape."""
        *blocks, scale = factor
        turns = len(blocks) // 3
        found = block_pentadiagonal.Factor(blocks[: turns + 1], blocks[turns + 1 : -turns], blocks[-turns:])
        x = block_pentadiagonal.substitute(found, self.in_blocks(scale * loads))
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


def _ends(grid: tuple[int, int]) -> np.ndarray:
    """The numbers of every vertex' neighbours at `OFFSETS`, of some vertex where there is none, in fields `[3, N]`: `[3, 10,
    N]`."""
    inner = _Inner.of(grid)
    beside = np.stack([inner.at(inner.row + i, inner.column + j) for i, j in OFFSETS]).clip(min=0)
    return beside + len(inner.row) * np.arange(3)[:, None, None]


def _offsets_of_pairs() -> Tensor:
    """`[10, 28]`: 1 where an offset is that between a pair of a stencil's vertices, the first by `SLOTS`, then the second."""
    pairs = [(STENCIL[a], STENCIL[b]) for k, a in enumerate(SLOTS) for b in SLOTS[k:]]
    return torch.tensor([[float((q[0] - p[0], q[1] - p[1]) == offset) for p, q in pairs] for offset in OFFSETS]).double()


def _band_sources(grid: tuple[int, int], free: np.ndarray, rows: int, columns: int) -> np.ndarray:
    """Where the entries of a matrix' places are, between the numbers of a vertex and those of the ones at most `REACH` columns
    from it, `[places, columns, 3, WIDTH]`: among the vertices' blocks `[3, 3, 10, N]`, a zero and a one."""
    inner, N, K = _Inner.of(grid), len(free), len(OFFSETS)
    number = np.full((2 * REACH + 1,) * 2, -1)
    for k, offset in enumerate(OFFSETS):
        number[offset] = k  # negative indices wrap: the opposite offset has its own place
    i, other = (at[:, None, None, None, None] for at in np.concatenate(block_pentadiagonal.places(rows)).T)
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
