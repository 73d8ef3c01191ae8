"""The flow around a dot predicts its motion; fits solve exactly."""

import numpy as np
import pytest
import torch

from torchmembrane.markers.dots.flow import FlowAverages
from torchmembrane.markers.dots.scales import RIDGE
from torchmembrane.markers.spacing import thin_out
from torchmembrane.solve.elimination import solve_dense, solve_positive

EDGE = -7.0
PIXELS = 10.0 * np.stack(np.meshgrid(np.arange(6), np.arange(5)), -1).reshape(-1, 2)
PIXELS = PIXELS + np.random.default_rng(0).normal(0, 1.5, PIXELS.shape)
ANCHORS = np.stack([np.arange(-20.0, 80.0, 5.0), np.full(20, EDGE)], -1)


@pytest.fixture(scope="module")
def sheared():
    """Averages around uneven dots beside a fixed edge; a flow that is affine and vanishes there, and its gradient."""
    averages = FlowAverages(PIXELS, np.concatenate([PIXELS, ANCHORS]))
    slope = torch.tensor([0.3, -0.2], dtype=torch.float64)
    gradient = torch.stack([torch.zeros(2, dtype=torch.float64), slope], 1)
    flow = slope[:, None] * torch.tensor(PIXELS[:, 1] - EDGE)
    return averages, flow[None], gradient[None, ..., None].expand(-1, -1, -1, len(PIXELS))


def test_an_affine_flow_is_predicted_from_the_neighbours_and_the_fixed_edge(sheared):
    averages, flow, gradient = sheared
    weight = torch.rand(1, flow.shape[-1], dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    predicted, support = averages.along(weight, flow, gradient)
    torch.testing.assert_close(predicted * (1 + 1e-3 / support), flow)


def test_the_gradient_of_an_affine_flow_is_found(sheared):
    averages, flow, gradient = sheared
    found = averages.gradient(torch.ones(1, flow.shape[-1], dtype=torch.float64), flow, gradient)
    torch.testing.assert_close(found, gradient, rtol=1e-3, atol=1e-3)


def test_the_gradient_is_that_of_the_least_squares_fit(sheared):
    """Of `|flow - f - J y|^2` over the neighbours, `y` their offset, plus `RIDGE h^2 |J - prior|^2`, by normal equations."""
    averages, flow, prior = sheared
    generator = torch.Generator().manual_seed(1)
    flow = flow + torch.randn(flow.shape, generator=generator, dtype=torch.float64)
    weight = torch.rand(1, flow.shape[-1], dtype=torch.float64, generator=generator)
    dot = 13
    kernel = averages.kernel[:, dot] * np.concatenate([weight[0].numpy(), np.ones(len(ANCHORS))])
    nodes = np.concatenate([PIXELS, ANCHORS])
    y = np.column_stack([np.ones(len(nodes)), (nodes - nodes[dot]) / averages.h[dot].item()])
    values = np.concatenate([flow[0].T.numpy(), np.zeros((len(ANCHORS), 2))])
    ridge, drawn = np.diag([1e-3, RIDGE, RIDGE]), np.zeros((3, 2))
    drawn[1:] = RIDGE * averages.h[dot].item() * prior[0, ..., dot].T.numpy()
    expected = np.linalg.solve(y.T * kernel @ y + ridge, y.T * kernel @ values + drawn)[1:].T / averages.h[dot].item()
    np.testing.assert_allclose(averages.gradient(weight, flow, prior)[0, ..., dot], expected, rtol=1e-9)


def test_no_weight_is_subnormal():
    """A product with subnormal numbers takes fifty times as long; dots so far apart have nothing to say of one another."""
    pixels = 12.0 * np.stack(np.meshgrid(np.arange(30), np.arange(3)), -1).reshape(-1, 2)
    for name, buffer in FlowAverages(pixels, pixels).float().named_buffers():
        size = buffer.abs()
        assert not ((size > 0) & (size < torch.finfo(torch.float32).tiny)).any(), name


def test_points_are_thinned_out_from_the_first_on():
    """The first stays; each other stays that is farther than the gap from all that stay before it, and no other."""
    line = np.stack([np.array([0.0, 1.0, 2.0, 3.5, 3.0]), np.zeros(5)], -1)
    assert thin_out(line, 1.2).tolist() == line[[0, 2, 3]].tolist()
    assert thin_out(line[::-1], 1.2).tolist() == line[[4, 1]].tolist()
    assert thin_out(line[:0], 1.2).shape == (0, 2)


def test_small_systems_are_solved_as_in_exported_models():
    root = torch.randn(5, 7, 7, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    matrix, loads = root @ root.mT + torch.eye(7), root[..., :3]
    solution = solve_dense(matrix, loads)
    torch.testing.assert_close(matrix @ solution, loads)
    torch.testing.assert_close(solve_positive(torch.cat([matrix, loads], -1).movedim(0, -1)).movedim(-1, 0), solution)
