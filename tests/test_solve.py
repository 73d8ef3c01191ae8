"""Laws of the solvers, against dense algebra."""

import pytest
import torch

from torchmembrane.solve import block_tridiagonal, matrix_products
from torchmembrane.solve.anderson import DEPTH, accelerated, first
from torchmembrane.solve.conjugate_gradient import conjugate_gradient
from torchmembrane.solve.kkt import constrained_minimum


def spd(n, batch=(), seed=0):
    generator = torch.Generator().manual_seed(seed)
    A = torch.randn(*batch, n, n, generator=generator, dtype=torch.float64)
    return A @ A.mT / n + torch.eye(n, dtype=torch.float64)


def test_conjugate_gradients_solve_in_as_many_steps_as_unknowns():
    A, b = spd(8, (3,)), torch.randn(3, 8, 2, dtype=torch.float64)
    x = conjugate_gradient(lambda y: A @ y, lambda y: y, b, steps=8)
    torch.testing.assert_close(A @ x, b)


def test_a_low_rank_change_needs_its_rank_of_preconditioned_steps():
    A, u = spd(30), torch.randn(30, 3, dtype=torch.float64)
    inverse, changed, b = torch.linalg.inv(A), A + u @ u.T, torch.randn(30, 1, dtype=torch.float64)
    x = conjugate_gradient(lambda y: changed @ y, lambda y: inverse @ y, b, steps=4)
    torch.testing.assert_close(changed @ x, b)


def test_steps_after_convergence_and_zero_loads_stay_finite():
    A, b = spd(5), torch.zeros(5, 2, dtype=torch.float64)
    b[:, 1] = 1
    x = conjugate_gradient(lambda y: A @ y, lambda y: y, b, steps=40)
    assert (x[:, 0] == 0).all()
    torch.testing.assert_close(A @ x, b)


@pytest.mark.parametrize("compliance", [0.0, 0.7])
def test_two_solves_equal_the_dense_kkt_system(compliance):
    """Eqs. 22, 25-27 for C = 0; with compliance the last row reads `v.y - C lambda = c`."""
    K, g, v = spd(9, (4,)), torch.randn(4, 9, dtype=torch.float64), torch.randn(4, 9, dtype=torch.float64)
    c = torch.randn(4, dtype=torch.float64)
    inverse = torch.linalg.inv(K)
    got = constrained_minimum((inverse @ g[..., None])[..., 0], (inverse @ v[..., None])[..., 0], v, c, compliance)
    kkt = torch.zeros(4, 10, 10, dtype=torch.float64)
    kkt[:, :9, :9], kkt[:, :9, 9], kkt[:, 9, :9], kkt[:, 9, 9] = K, v, v, -compliance
    want = torch.linalg.solve(kkt, torch.cat([g, c[:, None]], 1))
    torch.testing.assert_close(got.y, want[:, :9])
    torch.testing.assert_close(got.multiplier, want[:, 9])


def _grid_system(blocks, size, dtype, seed=0):
    """A positive definite block-tridiagonal system with a diagonal of about 1 and a right-hand side."""
    generator = torch.Generator().manual_seed(seed)
    rows = torch.randn(2, blocks, 2 * size, 2 * size, dtype=torch.float64, generator=generator) / (2 * size) ** 0.5
    gram = rows.mT @ rows
    diagonal = gram[..., :size, :size].clone() + 1e-2 * torch.eye(size, dtype=torch.float64)
    diagonal[:, 1:] += gram[:, :-1, size:, size:]
    b = torch.randn(2, blocks, size, 3, dtype=torch.float64, generator=generator)
    return diagonal.to(dtype), gram[:, :-1, :size, size:].to(dtype), b.to(dtype)


def test_block_cholesky_solves_the_dense_system():
    M, b = spd(12, (2,)), torch.randn(2, 12, 3, dtype=torch.float64)
    M[:, :4, 8:] = M[:, 8:, :4] = 0
    diagonal = torch.stack([M[:, 4 * i : 4 * i + 4, 4 * i : 4 * i + 4] for i in range(3)], 1)
    upper = torch.stack([M[:, 4 * i : 4 * i + 4, 4 * i + 4 : 4 * i + 8] for i in range(2)], 1)
    x, factor = block_tridiagonal.solve(diagonal, upper, b.unflatten(1, (3, 4)))
    torch.testing.assert_close(M @ x.flatten(1, 2), b)
    again = block_tridiagonal.substitute([torch.cat(blocks, 1) for blocks in factor], b.unflatten(1, (3, 4)))
    torch.testing.assert_close(again, x)


@pytest.mark.parametrize("dtype, bound", [(torch.float64, 1e-9), (torch.float32, 2e-4)])
@pytest.mark.parametrize("blocks, size", [(1, 9), (2, 9), (3, 9), (4, 42), (7, 90)])
def test_elimination_by_products_agrees_with_cholesky(blocks, size, dtype, bound):
    diagonal, upper, b = _grid_system(blocks, size, dtype)
    ours, factor = matrix_products.solve(diagonal, upper, b)
    theirs, _ = block_tridiagonal.solve(diagonal.double(), upper.double(), b.double())
    assert (ours - theirs).norm() / theirs.norm() < bound
    if blocks > 1:
        assert torch.equal(matrix_products.substitute([torch.cat(part, 1) for part in factor], b), ours)


@pytest.mark.parametrize("size", [3, 47, 96])
def test_inverse_by_products(size):
    generator = torch.Generator().manual_seed(size)
    q, _ = torch.linalg.qr(torch.randn(2, size, size, dtype=torch.float64, generator=generator))
    matrix = q @ torch.diag(torch.logspace(-3, 0, size, dtype=torch.float64)) @ q.mT
    one = torch.eye(size, dtype=torch.float64)
    assert (matrix_products.inverse(matrix) @ matrix - one).abs().max() < 1e-9


def test_anderson_solves_a_linear_fixed_point_in_two_unknowns_at_the_third_evaluation():
    """Though `x <- x + move(x)` alone diverges; and where nothing moves it stays."""
    A = torch.tensor([[2.5, 0.4], [-0.3, 0.2]], dtype=torch.float64)
    solution = torch.tensor([[1.0, -2.0], [3.0, 0.5], [0.0, 0.0]], dtype=torch.float64)
    move = lambda x: (solution - x) @ A.T  # noqa: E731
    state = first(torch.zeros_like(solution), move(torch.zeros_like(solution)))
    for _ in range(2):
        state = accelerated(state[0], move(state[0]), *state[1:])
    torch.testing.assert_close(state[0], solution, rtol=0, atol=1e-9)
    assert (state[0][2] == 0).all()


def test_anderson_solves_as_many_linear_unknowns_as_it_keeps_changes_one_evaluation_later():
    rates = torch.linspace(0.2, 3.0, DEPTH, dtype=torch.float64)
    turn, _ = torch.linalg.qr(spd(DEPTH))
    move = lambda x: (1 - x) @ (turn * rates) @ turn.mT  # noqa: E731
    state = first(torch.zeros(2, DEPTH, dtype=torch.float64), move(torch.zeros(2, DEPTH, dtype=torch.float64)))
    for _ in range(DEPTH):
        state = accelerated(state[0], move(state[0]), *state[1:])
    torch.testing.assert_close(state[0], torch.ones_like(state[0]), rtol=0, atol=1e-6)
