"""Compiled and tensor fits of ellipses agree.

What the compiled fit cannot do is left to the tensor operations.
"""

import copy
import pickle

import numpy as np
import pytest
import torch

from torchmembrane.machine_code import using
from torchmembrane.markers.dots.ellipse import draw_dots
from torchmembrane.markers.dots.fit import EllipseFit
from torchmembrane.markers.dots.pyramid import mean_pyramid

SIZE = 240, 200
RADII = [3.0, 6.0, 12.0]
"""px: each is fitted on a level of its own."""


def pattern():
    """Twenty ellipses on three levels; the first reach beyond the image."""
    centres = np.stack(np.meshgrid(np.arange(5), np.arange(4)), -1).reshape(-1, 2) * [48.0, 50.0] + [3.0, 22.0]
    turn = np.linspace(0, 3, len(centres))
    axes = np.stack([np.stack([np.cos(turn), -np.sin(turn)], -1), np.stack([np.sin(turn), np.cos(turn)], -1)], -2)
    radius = np.resize(RADII, len(centres))[:, None]
    return centres, axes @ (radius[..., None] * np.array([[1.1, 0.0], [0.0, 0.9]])) @ axes.swapaxes(1, 2)


def given(frames=2):
    """A fit, and what it is given: noisy images of the dots a little off, the ninth missing, false dark spots beside some."""
    centres, shapes = pattern()
    generator = torch.Generator().manual_seed(0)
    moved = centres + np.random.default_rng(0).normal(0, 0.6, centres.shape)
    spots, there = moved[1::3] + [0.0, 9.0], np.arange(len(moved)) != 8
    drawn = draw_dots(moved[there], 1.1 * shapes[there], SIZE) * draw_dots(
        spots, np.tile(2.0 * np.eye(2), (len(spots), 1, 1)), SIZE
    )
    images = drawn.float().repeat(frames, 1, 1, 1)
    levels = mean_pyramid(images + 0.02 * torch.randn(images.shape, generator=generator))
    centre = torch.as_tensor(centres).float().repeat(frames, 1, 1)
    shape = torch.as_tensor(shapes).float().repeat(frames, 1, 1, 1)
    return EllipseFit(centres, shapes, SIZE, 0.2).float(), levels, centre, shape, torch.full((frames,), 0.02)


def by_tensors(fit, *arguments):
    with using(False):
        return fit(*arguments)


@pytest.mark.parametrize("steps", [1, 3])
def test_a_fit_is_that_of_tensor_operations(steps):
    fit, *arguments = given()
    found, wanted = fit(*arguments, steps), by_tensors(fit, *arguments, steps)
    assert len(fit.levels) == 3 and float(wanted.explained.amax()) > 0.9 and float(wanted.contrast.amin()) < 0.1
    for name, tolerance in dict(centre=5e-4, growth=5e-4, explained=2e-4, contrast=2e-4, misfit=5e-3).items():
        torch.testing.assert_close(getattr(found, name), getattr(wanted, name), rtol=0, atol=tolerance)
    torch.testing.assert_close(found.covariance, wanted.covariance, rtol=1e-2, atol=1e-6)


def test_a_dot_without_a_place_spoils_no_other():
    fit, levels, centre, shape, noise = given(frames=1)
    lost = centre.clone()
    lost[0, 7] = torch.nan
    found, wanted = fit(levels, lost, shape, noise, 3), fit(levels, centre, shape, noise, 3)
    others = torch.arange(centre.shape[1]) != 7
    assert found.centre[0, 7].isnan().all()
    torch.testing.assert_close(found.centre[0, others], wanted.centre[0, others], rtol=0, atol=0)


def test_gradients_and_double_precision_are_left_to_tensors():
    fit, levels, centre, shape, noise = given(frames=1)
    traced = [level.requires_grad_() for level in levels]
    fit(traced, centre, shape, noise, 2).centre.sum().backward()
    assert float(levels[0].grad.abs().max()) > 0
    with torch.no_grad():
        assert fit.double()(levels, centre, shape, noise, 2).centre.dtype == torch.float64


@pytest.mark.parametrize("copied", [copy.deepcopy, lambda fit: pickle.loads(pickle.dumps(fit))])
def test_a_copy_has_its_own_constants(copied):
    fit, *arguments = given(frames=1)
    fit(*arguments, 2)
    other = copied(fit)
    other.ridge = 1e3 * other.ridge
    found, wanted = other(*arguments, 2), by_tensors(other, *arguments, 2)
    torch.testing.assert_close(found.centre, wanted.centre, rtol=0, atol=2e-4)
    assert float((found.centre - fit(*arguments, 2).centre).abs().max()) > 1e-2


def test_a_frame_of_nan_changes_no_other():
    fit, levels, *others = given(frames=3)
    wanted = fit(levels, *others, 2)
    found = fit([torch.cat([level[:1], torch.full_like(level[1:2], torch.nan), level[2:]]) for level in levels], *others, 2)
    for name in wanted._fields:
        assert getattr(found, name)[1].isnan().all(), name
        torch.testing.assert_close(getattr(found, name)[::2], getattr(wanted, name)[::2], rtol=0, atol=0)
