"""Both eliminations of a grid's system equal the dense solution."""

import pytest
import torch

from torchmembrane.solve import block_tridiagonal
from torchmembrane.solve.grid_system import UPPER, GridSystem
from torchmembrane.solve.inverse_root import by_cholesky, by_products


def problem(grid, hole=False, batch=2):
    """A stencil that is diagonally dominant, its dense matrix, and which inner vertices are free."""
    m, n = grid[0] - 2, grid[1] - 2
    generator = torch.Generator().manual_seed(m * n)
    stencil = torch.rand(batch, len(UPPER), m * n, generator=generator, dtype=torch.float64) - 0.5
    stencil[:, 0] = 15.0 + stencil[:, 0]
    dense = torch.zeros(batch, m * n, m * n, dtype=torch.float64)
    for k, (di, dj) in enumerate(UPPER):
        for i in range(m):
            for j in range(n):
                if i + di < m and 0 <= j + dj < n:
                    p, q = i * n + j, (i + di) * n + j + dj
                    dense[:, p, q] = dense[:, q, p] = stencil[:, k, p]
    free = torch.ones(m * n, dtype=torch.bool)
    if hole:
        free[[m * n // 2, 1]] = False
    return stencil, dense, free


@pytest.mark.parametrize("root", [by_cholesky, by_products])
@pytest.mark.parametrize(("grid", "hole"), [((7, 6), False), ((8, 6), True), ((5, 9), True), ((4, 5), False), ((3, 4), False)])
def test_solutions_are_those_of_the_dense_system(monkeypatch, root, grid, hole):
    monkeypatch.setattr(block_tridiagonal, "inverse_root", root)
    stencil, dense, free = problem(grid, hole)
    system = GridSystem(grid, free)
    loads = torch.randn(2, 3, dense.shape[-1], generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    x = system.substitute(system.factor(stencil), loads)
    expected = torch.linalg.solve(dense[:, free][:, :, free], loads[..., free].mT).mT
    torch.testing.assert_close(x[..., free], expected)
    assert (x[..., ~free] == 0).all()
