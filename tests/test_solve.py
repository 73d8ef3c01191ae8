"""Laws of the solvers, against dense algebra."""

import pytest
import torch

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
