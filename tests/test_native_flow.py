"""Compiled and tensor steps of the matching agree."""

import numpy as np
import pytest
import torch

from torchmembrane.machine_code import using
from torchmembrane.markers.dots.flow import FlowAverages
from torchmembrane.markers.dots.match import DotMatcher

COUNT, FRAMES, PITCH = 30, 3, 20.0
GENERATOR = np.random.default_rng(0)
PIXELS = PITCH * np.stack(np.meshgrid(np.arange(6.0), np.arange(5.0)), -1).reshape(-1, 2) + GENERATOR.normal(0, 2, (COUNT, 2))


def field(*shape, size=1.0):
    return torch.as_tensor(size * GENERATOR.normal(size=(FRAMES, *shape, COUNT))).float()


def weights():
    """Of dots, a third of them lost."""
    return torch.as_tensor(GENERATOR.random((FRAMES, COUNT)) * (GENERATOR.random((FRAMES, COUNT)) > 0.3)).float()


def both(function, *given):
    """By machine code and by tensor operations."""
    found = function(*given)
    with using(False):
        return found, function(*given)


@pytest.mark.parametrize("anchored", [False, True])
def test_gradient_and_flow_are_those_of_tensor_operations(anchored):
    anchors = np.array([[-20.0, 10.0], [130.0, 40.0]]) if anchored else np.zeros((0, 2))
    averages = FlowAverages(PIXELS, np.concatenate([PIXELS, anchors])).float()
    weight, flow, strain = weights(), field(2, size=5.0), field(2, 2, size=0.1)
    torch.testing.assert_close(*both(averages.gradient, weight, flow, strain), rtol=1e-4, atol=1e-4)
    found, wanted = both(averages.along, weight, flow, strain)
    torch.testing.assert_close(found, wanted, rtol=1e-4, atol=1e-3)


def test_choices_are_those_of_tensor_operations():
    """Of blobs near the dots and false ones; two dots want the same, and one has no support."""
    match = DotMatcher(PIXELS, np.zeros(COUNT), 0.45, np.ones(COUNT, bool)).float()
    false = GENERATOR.uniform(0, 100, (FRAMES, 12, 2))
    near = PIXELS + GENERATOR.normal(0, 4, (FRAMES, COUNT, 2))
    blobs = torch.as_tensor(np.concatenate([near[:, 2:], false], 1)).float()
    log_radius, valid = torch.as_tensor(GENERATOR.normal(0, 0.3, blobs.shape[:2])).float(), torch.ones(blobs.shape[:2])
    strain = torch.as_tensor(GENERATOR.normal(0, 0.1, (FRAMES, 2, 2, blobs.shape[1]))).float() + torch.eye(2)[..., None]
    scene = match.scene(strain, blobs, log_radius, valid)
    support = torch.as_tensor(GENERATOR.uniform(0.5, 4, (FRAMES, COUNT))).float()
    found, wanted = both(match.choose, field(2, size=2.0), support, *scene)
    assert ((wanted[0] > 0.3).sum() > COUNT) and ((wanted[0] < 0.02).sum() > 5)
    for one, other in zip(found, wanted, strict=True):
        torch.testing.assert_close(one, other, rtol=1e-3, atol=1e-3)


def test_what_records_gradients_is_left_to_tensors():
    averages = FlowAverages(PIXELS, PIXELS).float()
    flow = field(2).requires_grad_()
    averages.gradient(weights(), flow, field(2, 2)).sum().backward()
    assert float(flow.grad.abs().max()) > 0


def test_a_frame_of_nan_changes_no_other_and_no_frame_gives_none():
    averages = FlowAverages(PIXELS, PIXELS).float()
    given = weights(), field(2, size=5.0), field(2, 2, size=0.1)
    spoiled = [torch.cat([value[:1], torch.full_like(value[1:2], torch.nan), value[2:]]) for value in given]
    for function in (averages.gradient, lambda *values: averages.along(*values)[0]):
        assert function(*spoiled)[1].isnan().any()
        torch.testing.assert_close(function(*spoiled)[::2], function(*given)[::2], rtol=0, atol=0)
        assert len(function(*(value[:0] for value in given))) == 0
