"""Symmetric systems on a grid, summed from small dense patches, solved by elimination over pairs of grid rows."""

import torch
from torch import Tensor, nn

from . import block_tridiagonal, matrix_products


class PatchIndex(nn.Module):
    """Where the entries of patches over the vertices `[N, k]` go in the vector and the matrix of a `PatchSystem`."""

    def __init__(self, system: "PatchSystem", vertices: Tensor):
        super().__init__()
        s, blocks = system.block_size, system.blocks
        place = system.place[vertices]
        unknown = torch.where(place[..., None] >= 0, 3 * place[..., None] + torch.arange(3), s * blocks).flatten(-2)
        row, column = unknown[..., :, None], unknown[..., None, :]
        block_row, block_column = row // s, column // s
        inside = (row < s * blocks) & (column < s * blocks)
        diagonal = inside & (block_row == block_column)
        above = inside & (block_column == block_row + 1)
        position = (block_row * s + row % s) * s + column % s
        nowhere = (2 * blocks - 1) * s * s
        flat = torch.where(diagonal, position, torch.where(above, blocks * s * s + position, nowhere))
        self.register_buffer("vector", unknown.flatten())
        self.register_buffer("matrix", flat.flatten())


class PatchSystem(nn.Module):
    """Three unknowns a free vertex of an `m x n` grid; patches may reach two grid rows apart.

    Arguments: `grid (m, n)`, `fixed [V]` bool (the border at least). Unknowns of two grid rows make a block; the matrix is
    block tridiagonal. Patches' entries at fixed vertices are dropped.
    """

    def __init__(self, grid: tuple[int, int], fixed: Tensor):
        super().__init__()
        m, n = grid
        self.blocks, self.block_size = (m - 1) // 2, 6 * (n - 2)
        inner = torch.zeros(m, n, dtype=torch.bool)
        inner[1:-1, 1:-1] = True
        free = inner.flatten() & ~fixed
        place = torch.full((m * n,), -1)
        place[inner.flatten()] = torch.arange((m - 2) * (n - 2))
        self.register_buffer("place", torch.where(free, place, -1))
        self.register_buffer("free", free.nonzero().flatten())
        unknowns = (3 * self.place[self.free][:, None] + torch.arange(3)).flatten()
        idle = torch.ones(self.blocks * self.block_size, dtype=torch.float64)
        idle[unknowns] = 0
        self.register_buffer("unknowns", unknowns)
        self.register_buffer("idle", idle.reshape(self.blocks, self.block_size))

    def matrix(self, parts: list[tuple[PatchIndex, Tensor]]) -> Tensor:
        """Sum of patches `[B, N, 3k, 3k]`: the blocks on and above the diagonal, flat, `[B, ...]`."""
        s, batch = self.block_size, parts[0][1]
        total = batch.new_zeros(batch.shape[0], (2 * self.blocks - 1) * s * s + 1)
        for index, patches in parts:
            total = total.index_add(1, index.matrix, patches.flatten(1))
        return total

    def vector(self, parts: list[tuple[PatchIndex, Tensor]]) -> Tensor:
        """Sum of patch vectors `[B, N, 3k]`, in the system's order `[B, unknowns]`."""
        batch = parts[0][1]
        total = batch.new_zeros(batch.shape[0], self.blocks * self.block_size + 1)
        for index, patches in parts:
            total = total.index_add(1, index.vector, patches.flatten(1))
        return total[:, :-1]

    def columns(self, index: PatchIndex, patches: Tensor) -> Tensor:
        """Every row of the patch vectors `[B, N, C, 3k]` as a load of its own, `[B, unknowns, N C]`."""
        places = index.vector.reshape(patches.shape[1], 1, -1).expand(patches.shape)
        total = patches.new_zeros(*patches.shape[:-1], self.blocks * self.block_size + 1)
        return total.scatter_add(-1, places, patches)[..., :-1].flatten(1, 2).mT

    def from_vertices(self, field: Tensor) -> Tensor:
        """A vertex field `[B, V, 3]` in the system's order."""
        total = field.new_zeros(field.shape[0], self.blocks * self.block_size)
        return total.index_copy(1, self.unknowns, field[:, self.free].flatten(1))

    def to_vertices(self, vector: Tensor) -> Tensor:
        """The vertex field `[B, V, 3]` of a vector in the system's order; zero where fixed."""
        field = vector.new_zeros(vector.shape[0], len(self.place), 3)
        return field.index_copy(1, self.free, vector[:, self.unknowns].unflatten(1, (-1, 3)))

    def solve(self, matrix: Tensor, loads: Tensor, damping: float = 1e-6) -> Tensor:
        """Solutions `[B, unknowns, C]` for `loads` of that shape; the Jacobi-scaled matrix gets `damping` on its diagonal."""
        s, blocks = self.block_size, self.blocks
        diagonal = matrix[:, : blocks * s * s].reshape(-1, blocks, s, s) + torch.diag_embed(self.idle)
        above = matrix[:, blocks * s * s : -1].reshape(-1, blocks - 1, s, s)
        scale = diagonal.diagonal(dim1=-2, dim2=-1).clamp_min(torch.finfo(matrix.dtype).tiny).rsqrt()
        diagonal = diagonal * scale[..., :, None] * scale[..., None, :]
        diagonal = diagonal + damping * torch.eye(s, dtype=matrix.dtype, device=matrix.device)
        above = above * scale[:, :-1, :, None] * scale[:, 1:, None, :]
        flat_scale = scale.flatten(1)[..., None]
        scaled = (loads * flat_scale).unflatten(1, (blocks, s))
        elimination = matrix_products if torch.compiler.is_exporting() else block_tridiagonal
        return elimination.solve(elimination.factor(diagonal, above), scaled).flatten(1, 2) * flat_scale
