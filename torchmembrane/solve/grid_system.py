"""Symmetric systems with one unknown per inner vertex of a grid and 5 x 5 stencils: elimination of pairs of grid rows."""

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from . import block_tridiagonal

UPPER = ((0, 0), (0, 1), (0, 2), *((i, j) for i in (1, 2) for j in range(-2, 3)))
"""Offsets from a vertex to itself and to the later vertices of its stencil; the entries for earlier ones follow by symmetry."""


class GridSystem(nn.Module):
    """Solver for `M x = b` on the `N = (m - 2) (n - 2)` inner vertices of an `m x n` grid, numbered row by row.

    Two grid rows form one block.

    Args:
        grid: `(m, n)`.
        free: which inner vertices are free, `[N]` bool; the unknowns of the others are zero.
    """

    order: Tensor
    block_of_row: Tensor
    block_rows: Tensor
    block_columns: Tensor
    scatter_index: Tensor
    free: Tensor

    def __init__(self, grid: tuple[int, int], free: Tensor):
        super().__init__()
        m, n = grid
        self.count, self.blocks, self.block_size = (m - 2) * (n - 2), (m - 1) // 2, 2 * (n - 2)
        order = block_tridiagonal.inwards(self.blocks)
        pairs = np.array([(k, k) for k in order] + block_tridiagonal.coupled(self.blocks))
        for name, index in (
            ("order", np.array(order)),
            ("block_of_row", np.argsort(order)),
            ("block_rows", pairs[:, 0]),
            ("block_columns", pairs[:, 1]),
            ("scatter_index", _scatter_index((m - 2, n - 2), free.cpu().numpy(), pairs).ravel()),
        ):
            self.register_buffer(name, torch.from_numpy(index.astype(np.int32)))
        self.register_buffer("free", free.double())

    def factor(self, stencil: Tensor) -> tuple[Tensor, ...]:
        """Factor `M` for `substitute`.

        Args:
            stencil: entries of `M` between every vertex and its neighbours at the offsets `UPPER`, `[B, 13, N]`. Entries for
                neighbours that are not inner vertices or not free are ignored.
        """
        scale = torch.where(self.free > 0, stencil[:, 0], 1.0).rsqrt()
        entries = torch.cat([stencil.flatten(1), torch.zeros_like(scale[:, :1]), torch.ones_like(scale[:, :1])], 1)
        s = self.block_size
        matrix = entries.index_select(1, self.scatter_index).unflatten(1, (-1, s, s))
        by_block = F.pad(scale, (0, self.blocks * s - self.count), value=1.0).unflatten(-1, (self.blocks, s))
        rows, columns = (by_block.index_select(1, index) for index in (self.block_rows, self.block_columns))
        matrix = rows[..., None] * matrix * columns[..., None, :]
        diagonal, beside = matrix.split([self.blocks, self.blocks - 1], 1)
        roots, couplings = block_tridiagonal.factor(diagonal, beside)
        return *roots, *couplings, scale

    def substitute(self, factor: tuple[Tensor, ...], loads: Tensor) -> Tensor:
        """Return the solutions `[B, C, N]` for `loads [B, C, N]`."""
        *blocks, scale = factor
        roots = len(blocks) // 2 + 1  # the others are couplings, one less than roots
        scale = (scale * self.free)[:, None]
        padded = F.pad(scale * loads, (0, self.blocks * self.block_size - self.count))
        in_blocks = padded.unflatten(-1, (self.blocks, self.block_size)).transpose(1, 2).index_select(1, self.order)
        x = block_tridiagonal.substitute((blocks[:roots], blocks[roots:]), in_blocks)
        return scale * x.index_select(1, self.block_of_row).transpose(1, 2).flatten(-2)[..., : self.count]


def _scatter_index(size: tuple[int, int], free: np.ndarray, pairs: np.ndarray) -> np.ndarray:
    """Return the indices `[P, s, s]` that gather the entries of the blocks `pairs [P, 2]` (block row, block column) from the
    flattened stencil `[13, N]`, which is followed by a zero and a one."""
    N, s = len(free), 2 * size[1]
    number = np.full((5, 5), -1)
    for k, offset in enumerate(UPPER):
        number[offset] = k  # negative indices wrap around, so the opposite offset has its own entry
    p, q = (s * pairs.T[:, :, None] + np.arange(s))[:, :, :, None]
    q = q.swapaxes(1, 2)
    used = [(vertex < N) & free[vertex.clip(max=N - 1)] for vertex in (p, q)]
    (pi, pj), (qi, qj) = (np.divmod(vertex, size[1]) for vertex in (p, q))
    i, j = qi - pi, qj - pj
    close = used[0] & used[1] & (abs(i) <= 2) & (abs(j) <= 2)
    i, j = np.where(close, i, 0), np.where(close, j, 0)
    upper, lower = number[i, j], number[-i, -j]
    entry = np.where(upper >= 0, upper * N + p, lower * N + q)
    return np.where(close, entry, np.where((p == q) & ~used[0], len(UPPER) * N + 1, len(UPPER) * N))
