"""Symmetric systems on a grid whose matrices are products of seven-point stencils."""

from typing import Any, NamedTuple

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from . import band
from .stencil import STENCIL
from .stencil_layouts import OFFSETS, Band, Inner, RowBlocks

SLOTS = sorted(range(len(STENCIL)), key=STENCIL.__getitem__)
"""Indices into `STENCIL` in the order of the vertices' numbers, so that the offset to a later one is in `OFFSETS`."""

PAIRS = [(a, b) for k, a in enumerate(SLOTS) for b in SLOTS[k:]]
"""Pairs of a stencil's vertices: each with itself and with the later ones."""


class Matrix(NamedTuple):
    """A matrix that is scaled from both sides to a diagonal of 1.

    Attributes:
        entries: blocks between the vertices and their neighbours at `OFFSETS`, followed by a zero and a one, `[B, 90 N + 2]`.
        scale: scale factors, `[B, 1, 3 N]`.
    """

    entries: Tensor
    scale: Tensor


class Factor(NamedTuple):
    """A factored matrix: its layout, the layout's factor for `substitute`, and the matrix's scale factors."""

    way: Band | RowBlocks
    kept: Any
    scale: Tensor


class StencilSystem(nn.Module):
    """Solver of systems with three unknowns per inner vertex of an `m x n` grid: LAPACK if possible, else block elimination.

    Vectors are fields `[3, N]` over the inner vertices, flattened.

    Args:
        grid: `(m, n)`.
        free: which inner vertices are free, `[N]` bool. Matrix columns of the others must be zero.
    """

    slots: Tensor
    ends: Tensor
    offsets_of_pairs: Tensor
    fixed: Tensor

    def __init__(self, grid: tuple[int, int], free: Tensor):
        super().__init__()
        self.grid, self.inner_grid = grid, (grid[0] - 2, grid[1] - 2)
        self.band, self.row_blocks = Band(grid, free), RowBlocks(grid, free)
        self.register_buffer("slots", torch.tensor(SLOTS, dtype=torch.int32))
        self.register_buffer("ends", torch.from_numpy(_ends(self.inner_grid).ravel().astype(np.int32)))
        self.register_buffer("offsets_of_pairs", _offsets_of_pairs())
        self.register_buffer("fixed", (~free).double())

    def matrix(self, stencils: Tensor, weights: Tensor, near: Tensor, damping: float | Tensor) -> Matrix:
        """Assemble `A^T W A` plus further blocks.

        Args:
            stencils: `A [B, 3, 3, 7, N]`, derivatives of three values per vertex in the unknowns of its stencil's vertices.
            weights: symmetric weights `W [B, 3, 3, N]`.
            near: further blocks between the vertices and their neighbours at the first `K` of `OFFSETS`, `[B, 3, 3, K, N]`.
            damping: relative increase of the diagonal.
        """
        blocks = self._blocks(stencils, weights)
        close = near.shape[3]
        blocks = torch.cat([blocks[:, :, :, :close] + near, blocks[:, :, :, close:]], 3)
        diagonal = blocks[:, :, :, 0].flatten(1, 2)[:, ::4]
        scale = (diagonal * (1 + damping) + self.fixed).rsqrt()
        there = scale.flatten(1).index_select(1, self.ends).reshape(-1, 1, 3, *blocks.shape[3:])
        scaled = (blocks * scale[:, :, None, None] * there).flatten(1)
        constants = torch.stack([torch.zeros_like(scaled[:, 0]), torch.ones_like(scaled[:, 0])], 1)
        return Matrix(torch.cat([scaled, constants], 1), scale.flatten(1)[:, None])

    def _blocks(self, stencils: Tensor, weights: Tensor) -> Tensor:
        """Return the blocks of `A^T W A` between the vertices and their neighbours at `OFFSETS`, `[B, 3, 3, 10, N]`.

        A block is a sum over all stencils that contain both vertices. Fields are padded by a column of zeros at each side and
        two rows of zeros above and below. In the flattened field, a vertex at the offset `(i, j)` of a stencil is then always
        `i n + j` entries after the stencil's centre.
        """
        n, (rows, _) = self.grid[1], self.inner_grid
        A = stencils.index_select(3, self.slots)
        WA = (weights[:, :, :, None, None] * A[:, None]).sum(2)
        left, right = (F.pad(part.unflatten(-1, self.inner_grid), (1, 1, 2, 2)).flatten(-2) for part in (A, WA))
        products = []
        for k, slot in enumerate(SLOTS):
            i, j = STENCIL[slot]
            here, later = (2 - i) * n - j, len(SLOTS) - k
            x1, x2, x3 = left.narrow(3, k, 1).narrow(4, here, rows * n)[:, :, :, None].unbind(1)
            y1, y2, y3 = right.narrow(3, k, later).narrow(4, here, rows * n)[:, :, None].unbind(1)
            products.append(torch.addcmul(torch.addcmul(x1 * y1, x2, y2), x3, y3))
        inside = (self.offsets_of_pairs @ torch.cat(products, 3)).unflatten(-1, (rows, n))
        return inside[..., 1:-1].flatten(-2)

    def factor(self, matrix: Matrix) -> Factor:
        """Factor the matrix for `substitute`."""
        way = self.band if band.is_supported(matrix.entries) else self.row_blocks
        return Factor(way, way.factor(matrix.entries), matrix.scale)

    def substitute(self, factor: Factor, loads: Tensor) -> Tensor:
        """Return the solutions `[B, C, 3 N]` for `loads [B, C, 3 N]`."""
        way, kept, scale = factor
        return scale * way.substitute(kept, scale * loads)


def _ends(inner_grid: tuple[int, int]) -> np.ndarray:
    """Return the indices `[3, 10, N]`, in a flattened field `[3, N]`, of every vertex's neighbours at `OFFSETS`; those of an
    arbitrary vertex where there is no neighbour."""
    inner = Inner.from_size(inner_grid)
    beside = np.stack([inner.at(inner.row + i, inner.column + j) for i, j in OFFSETS]).clip(min=0)
    return beside + len(inner.row) * np.arange(3)[:, None, None]


def _offsets_of_pairs() -> Tensor:
    """Return a matrix `[10, 28]` that is 1 where an offset of `OFFSETS` leads from the first to the second vertex of a pair of
    `PAIRS`."""
    pairs = [(STENCIL[a], STENCIL[b]) for a, b in PAIRS]
    return torch.tensor([[float((q[0] - p[0], q[1] - p[1]) == offset) for p, q in pairs] for offset in OFFSETS]).double()
