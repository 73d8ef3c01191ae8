"""Laws of the solvers, against dense algebra."""

import numpy as np
import pytest
import torch

from torchmembrane.errors import MembraneError
from torchmembrane.solve import block_tridiagonal
from torchmembrane.solve.anderson import DEPTH, accelerated, first
from torchmembrane.solve.conjugate_gradient import conjugate_gradient
from torchmembrane.solve.implicit import differentiable, differentiable_fixed_point, refined
from torchmembrane.solve.inverse_root import LARGEST_CONDITION, LEAF, RIDGE, Steps, by_cholesky, by_products, quintics
from torchmembrane.solve.kkt import constrained_minimum


def spd(n, batch=(), seed=0):
    generator = torch.Generator().manual_seed(seed)
    A = torch.randn(*batch, n, n, generator=generator, dtype=torch.float64)
    return A @ A.mT / n + torch.eye(n, dtype=torch.float64)


def test_conjugate_gradients_solve_in_as_many_steps_as_unknowns():
    A, b = spd(8, (3,)), torch.randn(3, 2, 8, dtype=torch.float64)
    x = conjugate_gradient(lambda y: y @ A, lambda y: y, b, steps=8)
    torch.testing.assert_close(x @ A, b)


def test_a_low_rank_change_needs_its_rank_of_preconditioned_steps():
    A, u = spd(30), torch.randn(30, 3, dtype=torch.float64)
    inverse, changed, b = torch.linalg.inv(A), A + u @ u.T, torch.randn(1, 30, dtype=torch.float64)
    x = conjugate_gradient(lambda y: y @ changed, lambda y: y @ inverse, b, steps=4)
    torch.testing.assert_close(x @ changed, b)


def test_steps_after_convergence_and_zero_loads_stay_finite():
    A, b = spd(5), torch.zeros(2, 5, dtype=torch.float64)
    b[1] = 1
    x = conjugate_gradient(lambda y: y @ A, lambda y: y, b, steps=40)
    assert (x[0] == 0).all()
    torch.testing.assert_close(x @ A, b)


def test_refinement_squares_the_relative_error_of_a_solution():
    A, b = spd(6), torch.randn(6, dtype=torch.float64)
    error = 1e-3 * torch.randn(6, 6, dtype=torch.float64)
    inverse, exact = torch.linalg.inv(A), torch.linalg.solve(A, b)
    found = refined(lambda r: (r @ inverse) - (r @ inverse) @ error, lambda y: y @ A, b)
    torch.testing.assert_close(exact - found, exact @ error @ error, rtol=1e-6, atol=0)


def test_gradients_of_a_solution_are_the_dense_solution_s_and_there_are_no_second_ones():
    A, b = spd(6, (3,)).requires_grad_(), torch.randn(3, 2, 6, dtype=torch.float64, requires_grad=True)
    inverse, weights = torch.linalg.inv(A.detach()), torch.arange(12, dtype=torch.float64).reshape(2, 6)
    x = differentiable(lambda r: r @ inverse, lambda y: y @ A, b)
    dense = torch.linalg.solve(A, b.mT).mT
    torch.testing.assert_close(x, dense)
    expected = torch.autograd.grad((weights * dense**2).sum(), (A, b))
    got = torch.autograd.grad((weights * x**2).sum(), (A, b), create_graph=True)
    torch.testing.assert_close((got[0] + got[0].mT) / 2, (expected[0] + expected[0].mT) / 2)
    torch.testing.assert_close(got[1], expected[1])
    for loss in (lambda x: (x**2).sum(), lambda x: x.sum()):  # the gradient of the second holds no x
        x = differentiable(lambda r: r @ inverse, lambda y: y @ A, b)
        first = torch.autograd.grad(loss(x), (A, b), create_graph=True)
        for gradient in first:
            for of in (A, b):
                with pytest.raises(MembraneError, match="second derivatives .* differentiated once; expected first ones"):
                    torch.autograd.grad(gradient.square().sum(), of, retain_graph=True)


def test_transforms_of_functions_give_the_gradients_of_a_solution():
    A, b = spd(6), torch.randn(6, dtype=torch.float64)

    def solution(A, b):
        inverse = torch.linalg.inv(A.detach())
        return differentiable(lambda r: r @ inverse, lambda y: y @ A, b)

    weights = torch.arange(6, dtype=torch.float64)
    dense = torch.func.grad(lambda b: (weights * torch.linalg.solve(A, b) ** 2).sum())(b)
    torch.testing.assert_close(torch.func.grad(lambda b: (weights * solution(A, b) ** 2).sum())(b), dense)
    torch.testing.assert_close(torch.func.jacrev(lambda b: solution(A, b))(b), torch.linalg.inv(A))
    (of_matrix,) = torch.func.vjp(lambda A: solution(A, b), A)[1](weights)
    (expected,) = torch.func.vjp(lambda A: torch.linalg.solve(A, b), A)[1](weights)
    torch.testing.assert_close(of_matrix + of_matrix.mT, expected + expected.mT)


def fixed_point(largest, batch=3, n=12):
    """A linear iteration `x -> x A + c`, not symmetric, with such a largest eigenvalue, and its fixed point `[B, N]`."""
    generator = torch.Generator().manual_seed(0)
    V = torch.randn(n, n, generator=generator, dtype=torch.float64) + 2 * torch.eye(n, dtype=torch.float64)
    A = V @ torch.diag(largest * 0.6 ** torch.arange(n, dtype=torch.float64)) @ torch.linalg.inv(V)
    c = torch.randn(batch, n, generator=generator, dtype=torch.float64)
    return A, c, c @ torch.linalg.inv(torch.eye(n, dtype=torch.float64) - A)


@pytest.mark.parametrize("largest", [0.5, 0.95, -1.3])
def test_gradients_of_a_fixed_point_are_the_dense_ones_whatever_its_steps_do(largest):
    """Fast, slow, and a point from which the steps move away."""
    A, c, x = fixed_point(largest)
    A, c = A.requires_grad_(), c.requires_grad_()
    weights = torch.arange(36, dtype=torch.float64).reshape(3, 12)
    found = differentiable_fixed_point(lambda x: x @ A + c, x)
    assert torch.equal(found, x)
    exact = c @ torch.linalg.inv(torch.eye(12, dtype=torch.float64) - A)
    expected = torch.autograd.grad((weights * exact**2).sum(), (A, c))
    got = torch.autograd.grad((weights * found**2).sum(), (A, c), create_graph=True)
    torch.testing.assert_close(got, expected, rtol=1e-6, atol=1e-6 * expected[0].abs().max().item())
    with pytest.raises(MembraneError, match="second derivatives .* differentiated once; expected first ones"):
        torch.autograd.grad(got[1].square().sum(), c)


def test_transforms_of_functions_give_the_gradients_of_a_fixed_point():
    A, c, x = fixed_point(0.5, batch=1)

    def found(c):
        return differentiable_fixed_point(lambda x: x @ A + c, x)[0]

    expected = torch.linalg.inv(torch.eye(12, dtype=torch.float64) - A).mT[:, None]
    torch.testing.assert_close(torch.func.jacrev(found)(c), expected)
    torch.testing.assert_close(torch.func.grad(lambda c: found(c)[2])(c), expected[2])


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


def _grid_system(blocks, size, dtype, equations=None, ridge=1e-2):
    """A positive definite block-tridiagonal matrix with a diagonal of about 1, in the order of elimination, and loads."""
    generator = torch.Generator().manual_seed(0)
    rows = torch.randn(2, blocks, equations or 2 * size, 2 * size, dtype=torch.float64, generator=generator) / (2 * size) ** 0.5
    gram = rows.mT @ rows
    diagonal = gram[..., :size, :size].clone() + ridge * torch.eye(size, dtype=torch.float64)
    diagonal[:, 1:] += gram[:, :-1, size:, size:]
    b = torch.randn(2, blocks, 3, size, dtype=torch.float64, generator=generator)
    upper = gram[:, :-1, :size, size:]
    coupling = [upper[:, i] if i < j else upper[:, j].mT for i, j in block_tridiagonal.coupled(blocks)]
    coupling = torch.stack(coupling, 1) if coupling else upper
    return diagonal[:, block_tridiagonal.inwards(blocks)].to(dtype), coupling.to(dtype), b.to(dtype)


@pytest.mark.parametrize("blocks", range(1, 7))
def test_elimination_from_both_ends_solves_the_dense_system(blocks):
    size = 4
    diagonal, coupling, b = _grid_system(blocks, size, torch.float64)
    M = torch.zeros(2, blocks, size, blocks, size, dtype=torch.float64)
    order = block_tridiagonal.inwards(blocks)
    for k, i in enumerate(order):
        M[:, i, :, i] = diagonal[:, k]
    for k, (i, j) in enumerate(block_tridiagonal.coupled(blocks)):
        M[:, i, :, j], M[:, j, :, i] = coupling[:, k], coupling[:, k].mT
    x = block_tridiagonal.substitute(block_tridiagonal.factor(diagonal, coupling), b)
    dense = lambda rows: rows[:, np.argsort(order)].transpose(1, 2).flatten(2)  # noqa: E731
    torch.testing.assert_close(dense(x) @ M.flatten(3).flatten(1, 2), dense(b))


@pytest.mark.parametrize("dtype, bound", [(torch.float64, 1e-9), (torch.float32, 2e-4)])
@pytest.mark.parametrize("blocks, size", [(1, 9), (2, 9), (3, 9), (4, 42), (7, 90)])
def test_elimination_by_products_agrees_with_cholesky(monkeypatch, blocks, size, dtype, bound):
    *matrix, b = _grid_system(blocks, size, dtype)
    exact = (part.double() for part in matrix)
    theirs = block_tridiagonal.substitute(block_tridiagonal.factor(*exact), b.double())
    monkeypatch.setattr(block_tridiagonal, "inverse_root", by_products)
    ours = block_tridiagonal.substitute(block_tridiagonal.factor(*matrix), b)
    assert (ours - theirs).norm() / theirs.norm() < bound


@pytest.mark.parametrize("root", [by_cholesky, by_products])
@pytest.mark.parametrize("size", [3, 47, 96, 190])
def test_the_square_of_an_inverse_root_is_the_inverse(root, size):
    generator = torch.Generator().manual_seed(size)
    q, _ = torch.linalg.qr(torch.randn(2, size, size, dtype=torch.float64, generator=generator))
    matrix = q @ torch.diag(torch.logspace(-5, 0, size, dtype=torch.float64)) @ q.mT
    one = torch.eye(size, dtype=torch.float64)
    assert (root(matrix).mT @ root(matrix) @ matrix - one).abs().max() < 1e-9


@pytest.mark.parametrize("root", [by_cholesky, by_products])
def test_what_is_left_of_an_ill_conditioned_system_stays_positive_in_float32(monkeypatch, root):
    """Of fewer equations than unknowns and a ridge of 3e-5: through inverses instead of their roots it would not."""
    monkeypatch.setattr(block_tridiagonal, "inverse_root", root)
    *matrix, b = _grid_system(6, 42, torch.float64, equations=38, ridge=3e-5)
    exact = block_tridiagonal.substitute(block_tridiagonal.factor(*matrix), b)
    single = block_tridiagonal.substitute(block_tridiagonal.factor(*(part.float() for part in matrix)), b.float())
    assert (single - exact).norm() < 0.1 * exact.norm()


def test_an_eigenvalue_that_rounding_left_below_zero_breaks_no_iterated_root():
    generator = torch.Generator().manual_seed(0)
    q, _ = torch.linalg.qr(torch.randn(40, 40, dtype=torch.float64, generator=generator))
    eigenvalues = torch.logspace(-3, 0, 40, dtype=torch.float64)
    eigenvalues[0] = -2e-6
    matrix = (q * eigenvalues) @ q.T
    root = by_products(matrix.float()).double()
    assert root.norm() < 1e4
    others = torch.linalg.eigvalsh(root @ matrix @ root.T)[1:]
    torch.testing.assert_close(others, torch.ones_like(others), rtol=0, atol=1e-3)


@pytest.mark.parametrize("below", [1.1, 2.0, 50.0])
def test_a_leaf_that_rounding_left_far_from_positive_gets_the_root_of_a_diagonal_above_it(below):
    """Beside one that is positive, which keeps its own."""
    generator = torch.Generator().manual_seed(0)
    Q = torch.linalg.qr(torch.randn(46, 46, generator=generator, dtype=torch.float64)).Q
    eigenvalues = torch.logspace(-3, 0, 46, dtype=torch.float64)
    positive = Q @ torch.diag(eigenvalues) @ Q.T
    eigenvalues[0] = -below * RIDGE * positive.abs().sum(-1).max()
    matrix = torch.stack([positive, Q @ torch.diag(eigenvalues) @ Q.T])
    alone, (kept, found) = by_products(positive.float()), by_products(matrix.float()).double()
    torch.testing.assert_close(kept, alone.double())
    assert found.isfinite().all()
    bound = torch.linalg.inv(found.T @ found)
    if below >= 2:  # a little below, the ridge may do
        assert torch.linalg.eigvalsh(bound - matrix[1]).min() > -1e-6


@pytest.mark.parametrize("low", [0.3, 3e-3, 1e-5])
def test_a_quintic_is_as_far_from_one_at_four_places_from_either_side_in_turn_and_nowhere_further(low):
    """Which makes it the nearest to 1 of its kind (Chebyshev): two that alternate so cannot differ."""
    x = np.concatenate([np.geomspace(low, 1, 20001), np.linspace(low, 1, 20001)])
    x.sort()
    a, b, c = quintics(low, 0.99999)[0]
    off = 1 - (a * x + b * x**3 + c * x**5)
    extrema = off[[0, *(np.flatnonzero(np.diff(np.sign(np.diff(off))) != 0) + 1), -1]]
    alternating = [extrema[0], *(after for before, after in zip(extrema[:-1], extrema[1:], strict=True) if after * before < 0)]
    assert len(alternating) == 4
    np.testing.assert_allclose(np.abs(alternating), np.abs(off).max(), rtol=1e-6)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_composed_quintics_take_all_roots_of_eigenvalues_to_one(dtype):
    low, rounding = LARGEST_CONDITION[dtype] ** -0.5, 10 * torch.finfo(dtype).eps
    x = np.geomspace(low, 1, 10001)
    steps = quintics(low, rounding)
    for a, b, c in steps:
        x = a * x + b * x**3 + c * x**5
    assert np.abs(x - 1).max() < max(rounding, 1e-13)
    assert len(steps) == {torch.float32: 6, torch.float64: 11}[dtype]


def test_steps_without_products_by_numbers_are_the_composed_quintics():
    """Of one eigenvalue `y`: `r` with `r^2 y = x^2`, `x` what the quintics make of `y^1/2`."""
    folded, eigenvalue = Steps.to(1e4, 1e-6), 3e-3
    x = eigenvalue**0.5
    for a, b, c in quintics(1e-2, 1e-6):
        x = a * x + b * x**3 + c * x**5
    A, R = folded.first * eigenvalue, 1.0
    for shift, offset in zip(folded.shifts, folded.offsets, strict=True):
        R *= (R * A * R - shift) ** 2 + offset
    assert (folded.last * R) ** 2 * eigenvalue == pytest.approx(x**2, rel=1e-12)
    assert folded.last * R == pytest.approx(eigenvalue**-0.5, rel=1e-5)


def test_a_matrix_split_into_halves_has_a_ridge_only_in_the_leaf_that_needs_one():
    matrix = torch.eye(2 * LEAF, dtype=torch.float64)
    matrix[-1, -1] = -1e-9
    root = by_cholesky(matrix)
    assert (root.diagonal()[:LEAF] == 1).all()
    assert root[-1, -1] == pytest.approx((RIDGE - 1e-9) ** -0.5)


def test_what_rounding_has_left_without_a_factor_gets_a_ridge_and_nothing_else_does():
    one = torch.eye(3, dtype=torch.float64)
    barely_indefinite = torch.diag(torch.tensor([2.0, 1.0, -1e-6], dtype=torch.float64))
    roots = by_cholesky(torch.stack([one, barely_indefinite]))
    assert (roots[0] == one).all()
    torch.testing.assert_close(roots[1].mT @ roots[1] @ (barely_indefinite + 2 * RIDGE * one), one)
    compiled = torch.compile(by_cholesky, fullgraph=True, backend="eager")
    assert (compiled(torch.stack([one, barely_indefinite])) == roots).all()


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
