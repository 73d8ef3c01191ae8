"""Standard deviations match the scatter of estimates."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from torchmembrane import MembraneError, Reconstructor, Status
from torchmembrane.camera.model import Camera
from torchmembrane.estimators.base import Observation
from torchmembrane.estimators.contacts import Contacts
from torchmembrane.estimators.force_balance.estimator import ForceBalance
from torchmembrane.estimators.force_balance.settings import ForceBalanceSettings
from torchmembrane.estimators.force_balance.uncertainty import (
    DEPTH,
    FORCE,
    FORCE_SHARE,
    RIM_ERROR,
    SAG,
    UNDETECTED,
    changes,
    depths,
    gap_around,
    linearise,
    noise_loads,
    of_presses,
    shares_of_deepest,
    spreads,
)
from torchmembrane.mechanics.hyperelastic import ElasticEnergy
from torchmembrane.presets import preset
from torchmembrane.simulate import Simulator, Stroke
from torchmembrane.simulate.indenters import Sphere
from torchmembrane.simulate.quasi_static import carried, press
from torchmembrane.solve.stencil import inner
from torchmembrane.surface.shapes import ellipsoid_cap, half_cylinder, spherical_cap
from torchmembrane.surface.tangent import tangent_frame

NOISE = 0.05  # px
CAP, FINGER, CYLINDER = (
    lambda n: spherical_cap(12, 9, 3, (n, n)),
    lambda n: ellipsoid_cap((10, 8, 12), 3, (n, n)),
    lambda n: half_cylinder(10, 36, 80, 24, (n, n)),
)
FISHEYE = Camera("fisheye", (640, 480), (168, 168), (320, 240))
PORT = Camera("pinhole", (640, 480), (265, 265), (322.4, 237), ports=[(4, 3, 1.49)], medium_index=1.33)
PRESSES = {
    "cap": (CAP, FISHEYE, dict(prestretch=1.3), 4.0, (0.5, 0.0, 0.866), 2.0),
    "fingertip": (FINGER, FISHEYE, dict(prestretch=1.25), 3.0, (0.3, 0.6, 0.7), 1.5),
    "half cylinder": (CYLINDER, PORT, dict(model="mooney_rivlin", prestretch=1.2, c2_ratio=0.1), 4.0, (0.0, 0.4, 0.9), 2.0),
}


SETTLED = ForceBalanceSettings(steps=(600, 600, 600), settled_step_tol=1e-13)
"""Gradients are those of the fixed point of the steps."""


def observed(name, n, truth_grid=25, settings=None, **options):
    """An estimator on `n` x `n` vertices, its camera, and the markers' exact pixels in a press on a finer grid."""
    shape, camera, material, radius, direction, depth = PRESSES[name]
    direction = torch.tensor(direction, dtype=torch.float64) / torch.tensor(direction).norm()
    dome, rest = shape(truth_grid), shape(n)
    ball = Sphere(radius).touching(dome, -direction)
    truth = press(dome, ElasticEnergy(dome, **material), [[ball, ball.moved(-depth * direction)]])
    net = shape(33).resampled((13, 13)).rest.reshape(13, 13, 3)
    positions = net[1:-1, 1:-1].reshape(-1, 3)
    markers, noise = rest.closest_points(positions.numpy()), 2 * NOISE / float(camera.focal.mean())
    elasticity = ElasticEnergy(rest, **material)
    estimator = ForceBalance(rest, elasticity, markers, positions, noise, settings=settings, **options)
    return estimator, camera, camera.point_to_pixel(carried(truth.vertices, dome, positions))


def estimate(estimator, camera, pixels):
    return estimator(estimator.prepare(camera, pixels, torch.ones_like(pixels[..., 0])))


def force_of(estimator, result):
    return estimator.equations.forces(result.vertices - estimator.membrane.rest, result.pressure).sum(1)


def turns(estimator, camera, pixels, vertices):
    """How the rays to the markers turn by one standard deviation of the pixels, by the camera's inverse: `[B, D, 2, 3]`."""
    place = estimator.equations.bearings.markers(vertices - estimator.membrane.rest)
    origins, directions = camera.pixel_to_ray(pixels)
    basis = tangent_frame(directions.mT, dim=1).movedim(-1, 1)
    step = 1e-5
    moved = camera.point_to_pixel(place[..., None, :] + step * basis) - camera.point_to_pixel(place)[..., None, :]
    distance = torch.linalg.vector_norm(place - origins, dim=-1)[..., None, None]
    return NOISE * step / distance * torch.linalg.inv(moved) @ basis


def shares_inside(name, lines, truth_lines, draws):
    """Shares of vertices and of forces within one deviation of the mean of the estimates, over draws of the markers' noise."""
    estimator, camera, exact = observed(name, lines, truth_grid=truth_lines)
    generator = torch.Generator().manual_seed(1)
    pixels = exact + NOISE * torch.randn(draws, *exact.shape, generator=generator, dtype=torch.float64)
    with torch.no_grad():
        result = estimate(estimator, camera, pixels)
        noise = turns(estimator, camera, pixels, result.vertices)
        observation = estimator.prepare(camera, pixels, torch.ones_like(pixels[..., 0]))
        deviations = estimator.standard_deviations(result.vertices, result.pressure, result.moved, observation, noise)
    free = estimator.membrane.free_vertices
    found = (result.vertices[:, free], deviations.vertices[:, free]), (force_of(estimator, result), deviations.force)
    return [float(((values - values.mean(0)).abs() < spread).double().mean()) for values, spread in found]


@pytest.mark.parametrize("name", [pytest.param("cap", marks=pytest.mark.full), "fingertip", "half cylinder"])
def test_intervals_of_one_standard_deviation_hold_two_thirds_of_the_estimates(name):
    for inside in shares_inside(name, 13, truth_lines=17, draws=192):
        assert 0.60 < inside < 0.76


@pytest.mark.full
@pytest.mark.parametrize("name", PRESSES)
def test_intervals_hold_as_many_on_as_many_lines_as_default_grids_have(name):
    for inside in shares_inside(name, 25, truth_lines=31, draws=192):
        assert 0.60 < inside < 0.76


def test_deviations_grow_with_the_noise_and_leave_the_rim_alone():
    estimator, camera, exact = observed("cap", 9, truth_grid=15)
    result = estimate(estimator, camera, exact[None])
    rays, weight, found = camera.pixel_to_ray(exact[None]), torch.ones_like(exact[None, :, 0]), (*result[:2], result.moved)
    all_found = Observation(*rays, weight)
    once, twice = (estimator.standard_deviations(*found, all_found, k * NOISE / 168) for k in (1, 2))
    for a, b in zip(once, twice, strict=True):
        torch.testing.assert_close(2 * a, b)
    assert (once.vertices[:, estimator.membrane.fixed] == 0).all() and (once.force > 0).all()
    half = weight * (torch.arange(weight.shape[1]) < 60)
    lost = estimator.standard_deviations(*found, Observation(*rays, half), NOISE / 168)
    assert lost.vertices.norm() > 1.2 * once.vertices.norm()


def along(function, at, direction, step=1e-5):
    return (function(at + step * direction) - function(at - step * direction)) / (2 * step)


@pytest.mark.parametrize("pressed", [True, False])
def test_gradients_in_the_pixels_agree_with_finite_differences(pressed):
    """Of vertices and force, through the camera and the steps; at rest too, where forces and angles vanish."""
    estimator, camera, exact = observed("half cylinder", 9, truth_grid=15, settings=SETTLED)
    pixels = (exact if pressed else camera.point_to_pixel(estimator.equations.bearings.positions))[None]
    generator = torch.Generator().manual_seed(0)
    direction = torch.randn(pixels.shape, generator=generator, dtype=torch.float64)
    weights = torch.randn(estimator.membrane.rest.shape, generator=generator, dtype=torch.float64)

    def answers(pixels):
        result = estimate(estimator, camera, pixels)
        return torch.cat([(weights * result.vertices[0]).sum()[None], force_of(estimator, result)[0]])

    given = pixels.clone().requires_grad_()
    gradients = torch.stack([torch.autograd.grad(a, given, retain_graph=True)[0] for a in answers(given)])
    expected = along(answers, pixels, direction)
    torch.testing.assert_close((gradients * direction).flatten(1).sum(1), expected, rtol=1e-5, atol=1e-7)


@pytest.mark.parametrize("filling", ["liquid", "open"])
def test_gradients_in_the_prestretch_agree_with_finite_differences(filling):
    estimator, camera, exact = observed("cap", 9, truth_grid=15, settings=SETTLED, filling=filling)
    weights = torch.randn(estimator.membrane.rest.shape, generator=torch.Generator().manual_seed(0), dtype=torch.float64)

    def answers(prestretch):
        estimator.set_prestretch(prestretch)
        result = estimate(estimator, camera, exact[None])
        return torch.cat([(weights * result.vertices[0]).sum()[None], force_of(estimator, result)[0]])

    prestretch = torch.tensor(1.3, dtype=torch.float64)
    given = prestretch.clone().requires_grad_()
    gradients = torch.stack([torch.autograd.grad(a, given, retain_graph=True)[0] for a in answers(given)])
    torch.testing.assert_close(gradients, along(answers, prestretch, torch.ones(())), rtol=1e-6, atol=1e-8)


def test_deviations_are_of_the_weights_of_the_solve():
    """Every second marker is known badly: the force scatters as little as is said, not as if all were trusted alike."""
    sensor = preset("fingertip")
    sensor = replace(sensor, membrane=sensor.surface.membrane((13, 13)))
    simulator, reconstructor = Simulator(sensor, grid=(18, 18)), Reconstructor(sensor, dtype=torch.float64)
    observer, generator = reconstructor.observer, torch.Generator().manual_seed(3)
    noise = 0.02 + 0.5 * (torch.arange(len(reconstructor.rest_pixels)) % 2).double()[:, None]
    observer.rest_covariance = (0.5 * noise**2)[..., None] * torch.eye(2, dtype=torch.float64)
    way = np.array([0.0, 0.0, -1.0])
    stroke = Stroke(Sphere(4.0).touching(simulator.membrane, way), way, 1.5)
    (state,) = simulator.presses(stroke, ("push",))
    exact = torch.as_tensor(simulator.renderer.dots(state.vertices).pixels)
    pixels = exact + noise * torch.randn(48, *exact.shape, generator=generator, dtype=torch.float64)
    with torch.no_grad():
        result = reconstructor.from_pixels(pixels)
        deviations = reconstructor.standard_deviations(result)
    scatter, said = result.force.std(0).norm(), deviations.force.square().mean(0).sum().sqrt()
    assert 0.6 < said / scatter < 1.5


@pytest.mark.parametrize(("filling", "gauge"), [("liquid", False), ("liquid", True), ("gas", False), ("open", False)])
def test_spreads_by_the_transposed_equations_are_those_of_every_noise_by_itself(filling, gauge):
    """Force and depth: one solve for each against one for every marker and direction, a camera that may move included."""
    gas = (10.0, 900.0) if filling == "gas" else None
    estimator, camera, exact = observed("fingertip", 17, truth_grid=31, filling=filling, gas=gas)
    confidence = (torch.arange(len(exact)) % 7 > 0).double()[None]
    covariance = torch.tensor([[2e-3, 1e-3], [1e-3, 4e-3]]).double().expand(1, len(exact), 2, 2)
    observation = estimator.prepare(camera, exact[None], confidence, covariance)
    if gauge:
        observation = estimator.gauged(observation, 1.1 * estimator.rest_pressure)
    found = estimator(observation)
    net, state = estimator.coarse, estimator.coarsened(found.vertices - estimator.membrane.rest, found.pressure, found.moved)
    settings, equations = estimator.settings, net.equations
    of_force, of_depth = spreads(net.gauss_newton, settings, state, observation)
    measured = equations.bearings.measured(observation)
    scales = settings.tau[1], settings.outlier
    _, normal, solution = linearise(equations, net.cavity, state, measured, scales, settings.camera_motion, curvature=True)
    each = torch.eye(2).double().expand(1, len(exact), 2, 2)
    dx, dp = changes(solution, noise_loads(equations, normal, measured, solution.motion, each))
    dF = dx @ solution.force.mT - dp[..., None] * solution.of_pressure[:, None]
    torch.testing.assert_close(of_force, dF.square().sum(1).sqrt())
    inner_normals = inner(net.membrane.rest_normals, net.membrane.grid)
    depth = inner(depths(net.membrane, state.u)[..., None], net.membrane.grid)[0, :, 0]
    deepest = int(depth.argmax())
    of_deepest = dx.unflatten(-1, (3, -1))[0, :, :, deepest] @ inner_normals[deepest]
    torch.testing.assert_close(of_depth[0], of_deepest.square().sum().sqrt())


def test_deviations_of_an_answer_are_its_spreads_and_what_the_model_leaves_out():
    """Each part by itself, and turned with the force."""
    spread, gap = (torch.tensor([[3.0, 4.0, 0.0]]), torch.tensor([2.0])), 3.0

    def of(spread, force=(0.0, 0.0, 0.0), depth=0.0, at_rim=torch.nan, unseen=0.0, lines=25, gap=gap):
        rows = {name: torch.full((1, 4), torch.nan) for name in Contacts._fields}
        contacts = Contacts(**rows | {"points": torch.full((1, 4, 3), torch.nan)})
        if at_rim == at_rim:
            contacts.points[0, 0], contacts.at_rim[0, 0] = 0.0, at_rim
        force, depth, gap = torch.tensor([force]), torch.tensor([depth]), torch.tensor([gap])
        membrane = SimpleNamespace(size=10.0, grid=(33, lines))
        return of_presses(spread, force, depth, gap, contacts, membrane, torch.tensor(unseen))

    nothing = tuple(torch.zeros_like(s) for s in spread)
    close = torch.testing.assert_close
    close(of(spread, at_rim=0).force, FORCE * spread[0])
    close(of(spread, at_rim=0, lines=33).force, FORCE * spread[0])
    close(of(spread, at_rim=0, lines=13).force, 4 * FORCE * spread[0])
    close(of(spread, gap=0.0).depth, spread[1])
    close(of(spread, depth=4.0).depth, (4 + DEPTH**2 * 6 + (SAG * 3.3) ** 2) ** 0.5 * torch.ones(1))
    close(of(spread, depth=4.0, lines=13).depth, (64 + DEPTH**2 * 24 + (SAG * 3.3) ** 2) ** 0.5 * torch.ones(1))
    close(of(nothing, (0.0, -5.0, 0.0), at_rim=0).force, torch.tensor([[0.0, 5 * FORCE_SHARE, 0.0]]))
    rim = of(nothing, (3.0, 0.0, 4.0), 2.0, at_rim=1)
    own = FORCE_SHARE * torch.tensor([[3.0, 0.0, 4.0]])
    close(rim.force, (own**2 + (5 * RIM_ERROR) ** 2).sqrt())
    close(rim.depth, torch.tensor([SAG * 2.1]))
    close(of(nothing, unseen=7.0).force, torch.full((1, 3), 7 * UNDETECTED))
    close(of(nothing).depth, torch.tensor([SAG * 0.9]))


def test_depths_are_along_the_rest_normals_however_the_surface_tilts():
    """A steep dent and a shift across the rest normals: the dent's own depth everywhere."""
    dome = spherical_cap(12.0, 9.0, 3.0, grid=(9, 9))
    dent = 3 * torch.exp(-(dome.rest - dome.rest[40]).square().sum(-1) / 8)
    across = torch.linalg.cross(dome.rest_normals, torch.tensor([0.3, -1.0, 0.2]).double().expand_as(dome.rest_normals))
    torch.testing.assert_close(depths(dome, (0.7 * across - dent[:, None] * dome.rest_normals)[None])[0], dent)


def test_the_gap_is_the_mean_distance_to_the_nearest_markers_that_are_seen():
    """Of the deepest vertex; lost markers leave a gap, and where hardly any are seen it is the surface's size."""
    dome = spherical_cap(12.0, 9.0, 3.0, grid=(9, 9))
    depth = torch.zeros(2, 81, dtype=torch.float64)
    depth[0, 40], depth[1, 30] = 1.0, 2.0
    deepest = shares_of_deepest(depth)
    assert deepest.sum(1).tolist() == [1, 1] and deepest[0, 40] == deepest[1, 30] == 1
    positions = dome.rest[40] + torch.tensor([[1.0, 0, 0], [0, 2, 0], [0, 0, 3], [-4, 0, 0], [0, -5, 0]], dtype=torch.float64)
    seen = torch.tensor([[1.0, 1, 1, 1, 1], [1, 1, 1, 1, 1]])
    offsets = torch.linalg.vector_norm(positions - dome.rest[30], dim=-1).sort().values
    torch.testing.assert_close(
        gap_around(deepest, positions, seen, dome), torch.stack([torch.tensor(2.5).double(), offsets[:4].mean()])
    )
    seen[0, 0] = 0
    assert float(gap_around(deepest, positions, seen, dome)[0]) == pytest.approx(3.5)
    assert float(gap_around(deepest, positions, 0 * seen, dome)[0]) == pytest.approx(dome.size)


def test_pixels_as_noisy_as_they_are_said_to_be_are_explained():
    sensor = preset("bubble")
    reconstructor = Reconstructor(replace(sensor, membrane=sensor.surface.membrane((17, 17))))
    u, v = 0.2 * torch.randn(2, *reconstructor.rest_pixels.shape, generator=torch.Generator().manual_seed(0))
    pixels, rest = reconstructor.rest_pixels + u, reconstructor.rest_pixels + v
    unsaid, said = (reconstructor.from_pixels(pixels, rest_pixels=rest, noise=noise) for noise in (None, 0.2))
    assert unsaid.status.tolist() == [Status.UNEXPLAINED] and said.status.tolist() == [Status.OK]
    for wrong in (0.0, -0.1, float("nan"), 1e3):
        with pytest.raises(MembraneError, match="noise of pixels"):
            reconstructor.from_pixels(pixels, noise=wrong)
