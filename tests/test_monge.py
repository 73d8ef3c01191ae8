"""Appendix D: coefficients, expanded form, energy and misprints."""

import numpy as np
import pytest
import torch

from torchmembrane import MembraneError
from torchmembrane.estimators.base import Observation
from torchmembrane.estimators.minimum_energy.estimator import MinimumEnergy
from torchmembrane.estimators.paper.studies.monge import (
    MongeMinimumEnergy,
    adjugate,
    coefficients,
    metric,
)
from torchmembrane.mechanics.hyperelastic import ElasticEnergy
from torchmembrane.surface.shapes import ellipsoid_cap, heightfield, spherical_cap
from torchmembrane.surface.topology import corners, triangles_of


def random(*shape, seed=0):
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def trace(A, H, G):
    return torch.einsum("...ka,...kl,...lb,...ba->...", A, H, A, adjugate(G))


def printed(A, slope, corrected=True):
    """Eqs. 57-62 letter by letter, (60) and (62) as printed or corrected."""
    (a11, a12), (a21, a22), (sx, sy) = A[..., 0, :].unbind(-1), A[..., 1, :].unbind(-1), slope.unbind(-1)
    xx = a12**2 * (1 + sx**2) - 2 * a11 * a12 * sx * sy + a11**2 * (1 + sy**2)
    yy = a22**2 * (1 + sx**2) - 2 * a21 * a22 * sx * sy + a21**2 * (1 + sy**2)
    mixed = a22 + a22 * sx**2 - a21 * sx * sy
    other = a21 - a22 * sx * sy + a21 * sy**2
    square = a21**2 + a22**2 + a22**2 * sx**2 - 2 * a21 * a22 * sx * sy + a21**2 * sy**2
    xy = 2 * (a12 * mixed + a11 * other)
    first = a11**2 if corrected else a11
    x = 2 * (first * sx * (1 + sy**2) + a12 * (a12 * (sx + sx**3) + sy * mixed)
             + a11 * sy * (-(sx * (2 * a12 * sx + a22 * sy)) + a21 * (1 + sy**2)))  # fmt: skip
    y = 2 * (a12 * sx * mixed + a11 * sx * other + sy * square)
    tail = a12 * sx**2 + a22 * sx * sy - a21 * sy**2
    bracket = -2 * a11 * sx * sy * (a12 - a21 + tail) if corrected else -2 * a11 * sx * sy * (a12 - a21) + tail
    one = a12**2 * (1 + sx**2) ** 2 + 2 * a12 * sx * sy * mixed + a11**2 * (1 + sx**2) * (1 + sy**2)
    return xx, yy, xy, x, y, one + bracket + (1 + sy**2) * square


@pytest.mark.parametrize("batch", [(), (1,), (3, 1, 2)])
def test_the_quadratic_form_is_the_trace(batch):
    """Eqs. 55-62, also with H of the slopes at x' (eq. 10 prints those at x)."""
    A, rest, there, psi = (random(*batch, *shape, seed=k) for k, shape in enumerate([(2, 2), (2,), (2,), (2,)]))
    for slope in (rest, there):
        got = coefficients(A, rest, slope)(psi)
        torch.testing.assert_close(got, trace(A, metric(slope + psi), metric(rest)))
    torch.testing.assert_close(metric(rest) @ adjugate(metric(rest)), torch.linalg.det(metric(rest))[..., None, None]
                               * torch.eye(2, dtype=torch.float64).expand(*batch, 2, 2))  # fmt: skip


def test_the_paper_s_polynomials_with_60_and_62_corrected():
    A, slope = random(20, 2, 2), random(20, 2, seed=1)
    got = coefficients(A, slope)
    for mine, right, wrong in zip(got, printed(A, slope), printed(A, slope, corrected=False), strict=True):
        torch.testing.assert_close(mine, right)
        misprinted = mine is got.x or mine is got.one
        assert ((mine - wrong).abs().max() > 1e-3) == misprinted


def form_matrix(m, dx, dy):
    """Eq. 63, `[..., 4, 4]`: the form of coefficients `m` in `(psi_ij, psi_i,j+1, psi_i+1,j, 1)` for forward differences, `dx`
    along i and `dy` along j. As printed the linear terms stand above the diagonal only."""
    none = torch.zeros_like(m.one)
    xx, yy, half = m.xx / dx**2, m.yy / dy**2, m.xy / (2 * dx * dy)
    x, y = m.x / dx, m.y / dy
    rows = [
        [xx + 2 * half + yy, -yy - half, -xx - half, -x - y],
        [-yy - half, yy, half, y],
        [-xx - half, half, xx, x],
        [none, none, none, m.one],
    ]
    return torch.stack([torch.stack(row, -1) for row in rows], -2)


def test_the_expanded_matrix_is_the_form_of_forward_differences():
    """Eq. 63 with steps and signs; the printed first row, all plus, and last entry 0 give another number."""
    m, dx, dy = coefficients(random(5, 2, 2), random(5, 2, seed=1)), 0.7, 1.3
    psi = torch.cat([random(5, 3, seed=2), torch.ones(5, 1, dtype=torch.float64)], 1)
    slope = torch.stack([(psi[:, 2] - psi[:, 0]) / dx, (psi[:, 1] - psi[:, 0]) / dy], -1)
    M = form_matrix(m, dx, dy)
    torch.testing.assert_close(torch.einsum("ni,nij,nj->n", psi, M, psi), m(slope))
    plus = M.clone()
    plus[:, 0, 1:3], plus[:, 1:3, 0] = -M[:, 0, 1:3], -M[:, 1:3, 0]
    plus[:, 0, 3] = 0
    assert ((torch.einsum("ni,nij,nj->n", psi, plus, psi) - m(slope)).abs() > 1e-2).all()


def moved(membrane, size=0.05):
    x = membrane.rest / membrane.size
    return membrane.rest + size * membrane.size * torch.sin(5 * x[:, [1, 2, 0]]) * (~membrane.fixed)[:, None]


def pieces(x, grid):
    p = triangles_of(corners(x, grid))
    edges = p[..., 1:, :] - p[..., :1, :]
    return edges[..., :2], torch.linalg.solve(edges[..., :2], edges[..., 2:]).squeeze(-1)


def test_half_the_form_over_root_det_g_is_the_harmonic_energy():
    """Eqs. 11-13 with the 1/2 and, as adj G is det G times the inverse, `dx dy / sqrt(det G)` for the piece's weight."""
    cap = spherical_cap(12, 7, 5, (9, 9))
    elasticity, x = ElasticEnergy(cap, "harmonic", 1.1), moved(cap)
    plane, rest_slope = pieces(cap.rest, cap.grid)
    there, slope = pieces(x, cap.grid)
    A = torch.linalg.solve(plane, there).mT
    footprint = torch.linalg.det(plane).abs() / 2
    density = coefficients(A, rest_slope, torch.zeros_like(slope))(slope) / torch.linalg.det(metric(rest_slope)).sqrt()
    energy = elasticity.tension * (footprint * density).sum() / 2 - elasticity.tension * elasticity.area.sum()
    torch.testing.assert_close(energy, elasticity.energy(x))
    estimator = MongeMinimumEnergy(cap, elasticity, rays(cap))
    maps = estimator.maps(x)
    torch.testing.assert_close(maps.square().sum((-1, -2)), density)


def test_slopes_are_those_at_the_image_point():
    """A translation stores no energy with H at x' (eq. 42); with H at x, as eq. 10 prints it, it does."""
    s = lambda p: -0.05 * (p**2).sum(-1)  # noqa: E731
    slope = lambda p: -0.1 * p  # noqa: E731
    x, shift, one = random(50, 2), torch.tensor([0.8, -0.5], dtype=torch.float64), torch.eye(2, dtype=torch.float64)
    translated = lambda p: s(p - shift) - s(p)  # noqa: E731
    psi_slope = lambda p: slope(p - shift) - slope(p)  # noqa: E731
    step = 1e-6 * torch.tensor([1.0, 0.0], dtype=torch.float64)
    torch.testing.assert_close((translated(x + step) - translated(x - step)) / 2e-6, psi_slope(x)[:, 0], rtol=0, atol=1e-8)
    rest = 2 * torch.linalg.det(metric(slope(x)))
    there = x + shift
    torch.testing.assert_close(coefficients(one, slope(x), slope(there))(psi_slope(there)), rest)
    assert (coefficients(one, slope(x))(psi_slope(x)) - rest).abs().max() > 0.01


def rays(membrane, turn=0.0):
    direction = torch.nn.functional.normalize(membrane.rest, dim=-1)
    x = membrane.rest / membrane.size
    field = torch.sin(4 * x[:, [1, 2, 0]]) * (1 - (membrane.rest[:, :2] ** 2).sum(-1, keepdim=True) / 144)
    return torch.zeros_like(direction), torch.nn.functional.normalize(direction + turn * field, dim=-1)


def make(cap, **options):
    return MongeMinimumEnergy(cap, ElasticEnergy(cap, "harmonic", 1.2), rays(cap), **options)


def test_no_flow_no_displacement_and_the_volume_is_linear():
    cap = spherical_cap(12, 7, 15, (9, 9))
    estimator = make(cap)
    got = estimator(*rays(cap))
    assert (got.vertices - cap.rest).abs().max() < 1e-10 and abs(float(got.pressure - estimator.rest_pressure)) < 1e-10
    psi = random(len(cap.free_vertices))
    torch.testing.assert_close(cap.volume(estimator.surface(psi)) - cap.rest_volume, estimator.v @ psi)


def test_the_rim_stays_exactly_where_it_is():
    """Appendix B: whatever is observed at it; and no other ray's point is moved by it."""
    cap = spherical_cap(12, 7, 15, (9, 9))
    origins, seen = rays(cap, 0.03)
    askew = torch.where(cap.fixed[:, None], torch.nn.functional.normalize(seen + 0.05, dim=-1), seen)
    held, got = (make(cap, steps=2)(origins, directions).vertices for directions in (seen, askew))
    assert torch.equal(got[cap.fixed], cap.rest[cap.fixed]) and torch.equal(got, held)
    assert (got - cap.rest)[~cap.fixed].norm(dim=-1).median() > 0.1


def test_no_force_is_left_on_the_heights():
    """Repeated, eq. 22 ends at a stationary point of energy, rest load and smoother on the surfaces of this volume."""
    cap = spherical_cap(12, 7, 15, (9, 9))
    elasticity, estimator = ElasticEnergy(cap, "harmonic", 1.2), make(cap, steps=25)
    now = rays(cap, 0.01)
    psi, pressure, step = estimator.heights(*now)
    cell = estimator._cells(psi, *now)

    def energy(y):
        smooth, load = y @ estimator.smooth @ y / 2, estimator.rest_load @ y
        return elasticity.energy(estimator.material(y, cell, *now)) + smooth - load

    force = torch.func.grad(energy)(psi) - pressure * estimator.v
    scale = estimator.rest_pressure * estimator.v.mean()
    assert step < 1e-9 and psi.abs().max() > 0.1 and force.abs().max() < 1e-6 * scale and abs(float(estimator.v @ psi)) < 1e-9


def test_fixed_points_and_material_points_agree_as_the_grid_is_refined():
    gaps = []
    for n in (9, 13, 19):
        cap = spherical_cap(12, 5, 15, (n, n))
        elasticity = ElasticEnergy(cap, "harmonic", 1.2)
        observation = Observation(*rays(cap, 0.03), torch.ones(len(cap.rest)))
        material = MinimumEnergy(cap, elasticity, rays(cap))(observation).vertices
        fixed = make(cap, steps=5)(*rays(cap, 0.03)).vertices
        gaps.append(float((fixed - material).square().sum(-1).mean().sqrt()))
    size = float((material - cap.rest).square().sum(-1).mean().sqrt())
    assert gaps[0] > 1.2 * gaps[1] > 1.44 * gaps[2] and gaps[2] < 0.1 * size


def test_a_surface_with_vertical_sides_is_refused():
    finger = ellipsoid_cap((12, 9, 12), 2, (9, 9))
    with pytest.raises(MembraneError, match="use MinimumEnergy"):
        make(finger)
    flat = heightfield(np.linspace(-3, 3, 5), np.linspace(-2, 2, 5), np.full((5, 5), 5.0))
    assert (make(flat).rest_slope == 0).all()
