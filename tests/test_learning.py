"""The page on learning runs: a head, prestretch, rest shape."""

import re
from dataclasses import replace
from pathlib import Path

import pytest
import torch

import torchmembrane as tm

ROOT = Path(__file__).parents[1]
PAGE = (ROOT / "docs" / "learning.md").read_text()


@pytest.fixture(scope="module")
def learned():
    names: dict = {}
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(ROOT)
        exec(compile("\n".join(re.findall(r"```python\n(.*?)```", PAGE, re.S)), "learning.md", "exec"), names)
    return names


def test_the_head_learns_which_grasps_are_stable_through_the_reconstruction(learned):
    model, losses = learned["model"], learned["losses"]
    assert losses[-1] < 0.6 * losses[0] and model.shift.grad.abs().max() > 0
    logit, _ = model(learned["pixels"])
    assert ((logit > 0) == learned["stable"]).float().mean() >= 5 / 6


def test_the_prestretch_is_found_and_its_gradient_is_the_finite_difference(learned, monkeypatch):
    found, right = learned["prestretch"], learned["sensor"].material.prestretch
    assert found.item() == pytest.approx(right, abs=0.02) and f"end at {found.item():.2f}" in " ".join(PAGE.split())
    exact = tm.Reconstructor(learned["reconstructor"].sensor, dtype=torch.float64)
    for name, value in dict(reconstructor=exact, seen=learned["seen"].double(), known=learned["known"].double()).items():
        monkeypatch.setitem(learned, name, value)
    grid, at = exact.estimator, torch.tensor(1.25, dtype=torch.float64, requires_grad=True)
    while grid is not None:  # until a frame has settled, differences are those of its last steps
        steps, grid.steps = grid.gauss_newton, 400
        steps.settings = grid.equations.loss.settings = replace(steps.settings, settled_step_tol=2e-6)
        grid = grid.coarse
    (slope,) = torch.autograd.grad(learned["mismatch"](at), at)
    with torch.no_grad():
        below, above = (learned["mismatch"](torch.tensor(1.25 + step, dtype=torch.float64)) for step in (-1e-4, 1e-4))
    assert slope.item() == pytest.approx((above - below).item() / 2e-4, rel=0.01)


def test_the_rest_shape_is_found_and_forces_are_the_better_for_it(learned):
    mismatches, bulge, (before, after) = learned["mismatches"], learned["bulge"], learned["errors"]
    assert mismatches[-1] < 0.01 * mismatches[0] and abs(bulge - 1) < 0.08 / 20
    page = " ".join(PAGE.split())
    assert f"{bulge:.3f} of the true height" in page and f"from {before:.0%} to {after:.0%}".replace("%", " %") in page
    truth = learned["force_error"](learned["tm"].Reconstructor(learned["sensor"]))
    assert after < 0.5 * before and after == pytest.approx(truth, abs=0.005)
