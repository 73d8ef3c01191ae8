"""Bicubic interpolation is exact for cubics and of fourth order."""

import numpy as np
import pytest
import torch

from torchmembrane.surface.bicubic import Refinement, bicubic_shares
from torchmembrane.surface.projection import SurfacePoints
from torchmembrane.surface.topology import corners, triangles_of

GRID = (9, 7)


def points_of(grid, count=200, seed=0):
    """Points in random triangles, and where they are in the grid's coordinates."""
    rng, index = np.random.default_rng(seed), torch.arange(grid[0] * grid[1])[:, None]
    triangles = triangles_of(corners(index, grid)).reshape(-1, 3).numpy()
    vertices = triangles[rng.integers(len(triangles), size=count)]
    weights = rng.dirichlet(np.ones(3), count)
    place = (weights[..., None] * np.stack(np.divmod(vertices, grid[1]), -1)).sum(1)
    return SurfacePoints(vertices, weights, np.zeros(count)), place


def border_of(grid):
    fixed = torch.ones(grid, dtype=torch.bool)
    fixed[1:-1, 1:-1] = False
    return fixed.ravel()


def field(power_i, power_j, place):
    return place[..., 0] ** power_i * place[..., 1] ** power_j


@pytest.mark.parametrize("powers", [(0, 0), (1, 0), (0, 2), (2, 2), (3, 0), (1, 3), (3, 3)])
def test_cubics_are_exact_within_and_quadratics_at_the_border(powers):
    points, place = points_of(GRID)
    vertices = np.stack(np.divmod(np.arange(GRID[0] * GRID[1]), GRID[1]), -1).astype(float)
    got = bicubic_shares(points, GRID, border_of(GRID)) @ field(*powers, vertices)
    exact = field(*powers, place)
    within = ((place > 1) & (place < np.array(GRID) - 2)).all(1)
    assert within.sum() > 20 and (~within).sum() > 20
    np.testing.assert_allclose(got[within], exact[within], rtol=1e-12, atol=1e-10)
    if max(powers) <= 2:
        np.testing.assert_allclose(got, exact, rtol=1e-12, atol=1e-10)


def test_errors_fall_with_the_fourth_power_of_the_lines_distance():
    """Of a smooth field; a linear triangle's fall with the second."""
    errors = []
    for lines in (9, 17, 33):
        points, place = points_of((lines, lines))
        vertices = np.stack(np.divmod(np.arange(lines**2), lines), -1)

        def smooth(p, lines=lines):
            u = p / (lines - 1)
            return np.sin(3 * u[..., 0]) * np.cos(2 * u[..., 1] + 0.3)

        got = bicubic_shares(points, (lines, lines), border_of((lines, lines))) @ smooth(vertices)
        within = ((place > 1) & (place < lines - 2)).all(1)
        errors.append(np.sqrt(np.mean((got - smooth(place))[within] ** 2)))
    rates = np.log2(np.array(errors[:-1]) / errors[1:])
    assert (rates > 3.6).all(), rates


def test_beside_what_is_fixed_within_points_are_linear_in_their_triangle():
    """A wall within the border may kink the field: no cubic goes across it."""
    points, place = points_of(GRID)
    fixed = border_of(GRID).reshape(GRID)
    fixed[4, 3] = True
    shares = bicubic_shares(points, GRID, fixed.ravel())
    linear = np.zeros_like(shares)
    np.add.at(linear, (np.arange(len(place))[:, None], points.vertices), points.weights)
    near = (abs(place - [4, 3]) < 1).all(1)
    far = (abs(place - [4, 3]) > 2).any(1)
    assert near.sum() > 5 and far.sum() > 5
    np.testing.assert_array_equal(shares[near], linear[near])
    assert (abs(shares[far] - linear[far]).max(1) > 1e-3).all()
    np.testing.assert_allclose(shares.sum(1), 1, atol=1e-12)


def test_a_refined_field_keeps_its_values_and_is_what_it_was_where_it_is_linear():
    finer = tuple(2 * count - 1 for count in GRID)
    refinement = Refinement(GRID, finer)
    values = torch.randn(2, GRID[0] * GRID[1], 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    refined = refinement(values).unflatten(1, finer)
    torch.testing.assert_close(refined[:, ::2, ::2].flatten(1, 2), values)
    places = [
        torch.stack(torch.meshgrid(*(torch.linspace(0, 1, n, dtype=torch.float64) for n in grid), indexing="ij"), -1)
        for grid in (GRID, finer)
    ]
    linear, expected = (1 + place @ torch.tensor([[2.0], [-3.0]]).double() for place in places)
    within = refinement(linear.flatten(0, 1)[None]).unflatten(1, finer)[0, 2:-2, 2:-2]
    torch.testing.assert_close(within, expected[2:-2, 2:-2])
