"""Weight and curvature are derivatives of each robust loss."""

import pytest
import torch

from torchmembrane.estimators.force_balance.robust import Cauchy, GemanMcClure, PseudoHuber

LOSSES = [GemanMcClure(0.7), Cauchy(0.7), PseudoHuber(0.7)]
RESIDUALS = torch.linspace(1e-3, 5.0, 60, dtype=torch.float64)


@pytest.mark.parametrize("robust", LOSSES, ids=lambda robust: type(robust).__name__)
def test_the_weight_is_the_losss_derivative_over_the_residual(robust):
    r = RESIDUALS.clone().requires_grad_()
    (derivative,) = torch.autograd.grad(robust.loss(r**2).sum(), r)
    torch.testing.assert_close(robust.weight(r.detach() ** 2), derivative / r.detach())


@pytest.mark.parametrize("robust", LOSSES, ids=lambda robust: type(robust).__name__)
def test_near_zero_the_loss_is_the_parabola_of_its_weight(robust):
    r2 = torch.tensor(1e-8, dtype=torch.float64)
    torch.testing.assert_close(robust.loss(r2), robust.weight(0 * r2) * r2 / 2, rtol=1e-6, atol=0)


@pytest.mark.parametrize("robust", LOSSES, ids=lambda robust: type(robust).__name__)
def test_the_parabola_that_touches_lies_above_the_loss(robust):
    """What makes every reweighted step a descent: `loss(r) <= loss(s) + weight(s) (r^2 - s^2) / 2`."""
    r2, s2 = RESIDUALS[:, None] ** 2, RESIDUALS**2
    assert (robust.loss(r2) <= robust.loss(s2) + robust.weight(s2) * (r2 - s2) / 2 + 1e-12).all()


def test_geman_mcclures_curvature_is_its_second_derivative_where_that_is_positive():
    robust = GemanMcClure(0.7)
    second = torch.func.vmap(torch.func.grad(torch.func.grad(lambda r: robust.loss(r**2))))(RESIDUALS)
    assert (second < 0).any() and (second > 0).any()
    torch.testing.assert_close(robust.curvature(RESIDUALS**2), second.clamp_min(0))
