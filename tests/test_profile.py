"""The one-dimensional membrane agrees with three twins."""

import numpy as np
import pytest
import torch
from scipy.integrate import quad, solve_bvp
from scipy.optimize import minimize

from torchmembrane import MembraneError
from torchmembrane.estimators.paper.studies.pressed_strip import Disc, PressedStrip
from torchmembrane.estimators.paper.studies.profile import (
    ForceBalanceProfile,
    MinimumEnergyProfile,
    Obstacle,
    flat_contact,
)
from torchmembrane.estimators.paper.studies.strip import Strip, area, around

R = 15.0
SOFT = Strip("neo_hookean", 1.2)
CYLINDER = [Disc.pressed(R, 90, 4.0, 5.0)]
TWO_POINTS = [Disc.pressed(R, 60, 2.0, 0.0), Disc.pressed(R, 120, 2.0, 0.0)]
OFF_CENTRE = [Disc.pressed(R, 65, 3.0, 4.0)]


@pytest.mark.parametrize("centre", [50.0, 38.0])
def test_flat_contact_is_the_obstacle_problem(centre):
    """Eqs. 30-31: tangent where the contact ends, no area, and of least energy among all that stay below the body."""
    body, depth, span = Obstacle.disc(centre, 30.0), 4.0, 100.0
    state = flat_contact(body, span, depth)
    c1, c2 = state.contact
    ends, h = np.array([c1, c2]), 1e-5
    slope = lambda side: (state.height(ends + side * h) - state.height(ends)) / (side * h)  # noqa: E731
    np.testing.assert_allclose(slope(np.array([-1, 1])), [body.slope(c) for c in ends], atol=1e-6)
    assert abs(quad(lambda v: state.height(np.array([v]))[0], 0, span, points=[c1, c2])[0]) < 1e-9 * span * depth
    errors = []
    for n in (50, 100):
        x = np.linspace(0, span, n + 1)[1:-1]
        near = np.abs(x - centre) < 29
        roof = np.array([body.height(v) if close else np.inf for v, close in zip(x, near, strict=True)]) - depth
        energy = lambda u, n=n: 0.5 * np.sum(np.diff(np.pad(u, 1)) ** 2) * n / span  # noqa: E731
        grad = lambda u, n=n: -np.diff(np.pad(u, 1), 2) * n / span  # noqa: E731
        no_area = dict(type="eq", fun=np.sum, jac=np.ones_like)
        got = minimize(energy, np.minimum(roof, 0.0), jac=grad, bounds=[(None, r) for r in roof], constraints=no_area,
                       method="SLSQP", options=dict(maxiter=500, ftol=1e-14))  # fmt: skip
        assert got.success
        errors.append(np.abs(got.x - state.height(x)).max())
    assert errors[1] < 0.4 * errors[0] and errors[1] < 0.02


@pytest.mark.parametrize("discs", [CYLINDER, TWO_POINTS, OFF_CENTRE])
def test_pressed_strip_is_in_equilibrium(discs):
    state = PressedStrip(R, discs)
    x = torch.from_numpy(state.positions(np.linspace(0, 180, 2001)))
    rest = around(R, torch.linspace(0, torch.pi, 2001, dtype=torch.float64))
    assert abs(float(area(x)) / (np.pi * R**2 / 2) - 1) < 1e-5
    gap = (x[:, None] - torch.tensor([disc.centre for disc in discs])).norm(dim=-1) - torch.tensor([d.radius for d in discs])
    assert gap.min() > -1e-9 and gap.amin(0).max() < 1e-2
    p = state.pressure(SOFT)
    force = torch.func.grad(lambda y: SOFT.energy(y, rest))(x) - p * torch.func.grad(area)(x)
    free = gap.amin(1) > 0.05
    free[[0, -1]] = False
    scale = p * R * np.pi / 2000
    assert force[free].norm(dim=-1).max() < 2e-3 * scale
    touched = force[~free][1:-1].sum(0).numpy()
    np.testing.assert_allclose(touched, state.forces(SOFT).sum(0), rtol=0.01, atol=1e-3)
    edges = (x[1:] - x[:-1]).norm(dim=-1)
    assert (edges / edges.median() - 1).abs().max() < (0.02 if discs is not TWO_POINTS else 0.6)


def test_what_no_strip_can_do_is_refused():
    with pytest.raises(MembraneError, match="does not touch"):
        PressedStrip(R, [Disc.pressed(R, 90, 4.0, 5.0), Disc.pressed(R, 40, -3.0, 2.0)])
    with pytest.raises(MembraneError, match="press less deep"):
        PressedStrip(R, [Disc.pressed(R, 90, 14.0, 5.0)])
    with pytest.raises(MembraneError, match="expected depth > 0"):
        flat_contact(Obstacle.disc(50, 20), 100.0, -1.0)
    with pytest.raises(MembraneError, match="expected model harmonic or neo_hookean"):
        Strip("rubber")


def bent(angle):
    return angle + 0.12 * np.sin(2 * angle) + 0.05 * np.sin(angle)


def slope_of_bent(angle):
    return 1 + 0.24 * np.cos(2 * angle) + 0.05 * np.cos(angle)


def test_energy_of_the_polygon_is_the_corrected_integral():
    """Eqs. 35-36 with `g'^2 [...]` and 1 / r; the printed `phi'^2 [...]` with r^(-3/2) is another number."""
    u, du = lambda a: R - 3 * np.sin(a) ** 2, lambda a: -3 * np.sin(2 * a)
    right = quad(lambda a: ((u(a) * slope_of_bent(a)) ** 2 + du(a) ** 2) / (2 * R), 0, np.pi)[0]
    printed = quad(lambda a: du(a) ** 2 * (u(a) ** 2 + (du(a) / slope_of_bent(a)) ** 2) / (2 * R**1.5), 0, np.pi)[0]
    unit, errors = Strip("harmonic", 1.0), []
    for n in (41, 81):
        angle = torch.linspace(0, torch.pi, n, dtype=torch.float64)
        x = around(torch.from_numpy(u(angle.numpy())), torch.from_numpy(bent(angle.numpy())))
        errors.append(abs(float(unit.energy(x, around(R, angle))) - right))
    assert errors[1] < 0.3 * errors[0] < 3e-3 * right
    assert abs(printed - right) > 0.05 * right


def markers(count=31):
    return np.linspace(0, np.pi, count + 2)[1:-1]


@pytest.mark.parametrize("model", ["harmonic", "neo_hookean"])
def test_no_displacement_without_flow(model):
    got = MinimumEnergyProfile(R, Strip(model), 61)(markers(), markers())
    assert (got.nodes - around(R, got.angle)).abs().max() < 1e-10
    balanced = ForceBalanceProfile(R, Strip(model), 61, 2e-4)(markers(), markers())
    assert (balanced.nodes - around(R, balanced.angle)).abs().max() < 1e-6


@pytest.mark.parametrize("model", ["harmonic", "neo_hookean"])
def test_material_points_lie_on_the_rays_on_which_they_are_observed(model):
    """Eqs. 32-33: the node at rest at theta is found at the angle `g(theta)`, whatever its radius."""
    got = MinimumEnergyProfile(R, Strip(model), 61)(markers(60), bent(markers(60)))
    psi = torch.atan2(got.nodes[:, 1], got.nodes[:, 0]).numpy()
    np.testing.assert_allclose(psi, bent(got.angle.numpy()), atol=1e-5)
    assert np.abs(psi - got.angle.numpy()).max() > 0.1 and (got.nodes.norm(dim=-1) - R).abs().max() > 0.3
    at_nodes = got.angle.numpy()[1:-1:5]
    few = MinimumEnergyProfile(R, Strip(model), 61)(at_nodes, at_nodes + 0.02)
    np.testing.assert_allclose(np.arctan2(*few.nodes.numpy()[1:-1:5, ::-1].T), at_nodes + 0.02, atol=1e-12)


def test_minimum_energy_solves_the_boundary_value_problem():
    """Euler's equation of eqs. 35-37, `u'' = g'^2 u - p r / T u g'`, with u = r (not 0) at the ends, by collocation."""
    ode = lambda a, y, p: np.stack([y[1], slope_of_bent(a) ** 2 * y[0] - p[0] * y[0] * slope_of_bent(a),  # noqa: E731
                                    y[0] ** 2 * slope_of_bent(a) / 2])  # fmt: skip
    ends = lambda a, b, p: np.array([a[0] - R, b[0] - R, a[2], b[2] - np.pi * R**2 / 2])  # noqa: E731
    start = np.linspace(0, np.pi, 50)
    twin = solve_bvp(ode, ends, start, np.stack([R + 0 * start, 0 * start, R**2 * start / 2]), p=[1.0], tol=1e-7)
    assert twin.success and np.abs(twin.sol(markers())[0] - R).max() > 0.3
    errors = []
    for n in (31, 61):
        got = MinimumEnergyProfile(R, Strip("harmonic", 1.0), n)(markers(60), bent(markers(60)))
        u = got.nodes.norm(dim=-1).numpy()
        errors.append(np.abs(u - twin.sol(got.angle.numpy())[0]).max())
        assert abs(float(area(got.nodes) - area(around(R, got.angle)))) < 1e-9
        assert abs(u[0] - R) < 1e-12 and abs(u[-1] - R) < 1e-12
    assert errors[1] < 0.35 * errors[0] and errors[1] < 0.01
    assert abs(got.pressure * R - twin.p[0]) < 0.01


def observed(discs, noise=2e-4):
    truth = PressedStrip(R, discs)
    theta = markers()
    place = truth.positions(np.rad2deg(theta))
    psi = np.arctan2(place[:, 1], place[:, 0]) + noise * np.random.default_rng(0).standard_normal(len(theta))
    return truth, theta, psi, place


def error(profile, theta, place):
    rest = R * np.stack([np.cos(theta), np.sin(theta)], -1)
    return float(np.sqrt(((profile.at(theta) - place) ** 2).sum() / ((rest - place) ** 2).sum()))


@pytest.mark.parametrize(("discs", "bound"), [(CYLINDER, 0.07), (OFF_CENTRE, 0.05), (TWO_POINTS, 0.3)])
def test_force_balance_finds_what_minimum_energy_does_not(discs, bound):
    """Figs. 19 and 20 from the closed form, with noise: shape, force and pressure; least energy hides the press."""
    truth, theta, psi, place = observed(discs)
    least = MinimumEnergyProfile(R, SOFT, 61)(theta, psi)
    estimator = ForceBalanceProfile(R, SOFT, 61, 4e-4)
    found = estimator(theta, psi)
    assert error(found, theta, place) < bound and error(least, theta, place) > 0.4
    force = truth.forces(SOFT).sum(0)
    assert np.linalg.norm((found.traction * estimator.share).sum(0).numpy() - force) < 0.15 * np.linalg.norm(force)
    assert abs(found.pressure / truth.pressure(SOFT) - 1) < 0.06
    assert abs(float(area(found.nodes) / area(estimator.rest)) - 1) < 1e-4


def test_mirrored_markers_give_the_mirrored_strip():
    _, theta, psi, _ = observed(OFF_CENTRE)
    for estimator in (MinimumEnergyProfile(R, SOFT, 41), ForceBalanceProfile(R, SOFT, 41, 4e-4)):
        one, other = estimator(theta, psi), estimator(np.pi - theta[::-1], np.pi - psi[::-1])
        mirrored = other.nodes.flip(0) * torch.tensor([-1.0, 1.0])
        torch.testing.assert_close(one.nodes, mirrored, rtol=0, atol=1e-6)
