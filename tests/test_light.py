"""Light touches are found as soon as they exceed the noise."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from test_force_balance import ONE, SETTINGS, along_y, at_rest, make, seen
from test_force_balance import pressed as pressed

from torchmembrane import Reconstructor
from torchmembrane.camera.model import Camera
from torchmembrane.errors import MembraneError
from torchmembrane.estimators.force_balance import traction_loss
from torchmembrane.estimators.force_balance.marker_residuals import marker_rays
from torchmembrane.estimators.force_balance.robust import GemanMcClure
from torchmembrane.markers.noise import pixel_noise
from torchmembrane.presets import preset
from torchmembrane.simulate import Simulator, Sphere, Stroke
from torchmembrane.simulate.appearance import Appearance, noisy
from torchmembrane.solve.stencil import inner

pytestmark = pytest.mark.usefixtures("quick_images")

CAMERAS = {
    "pinhole": Camera("pinhole", (640, 480), (400, 410), (320, 240), [-0.1, 0.02]),
    "fisheye": Camera("fisheye", (640, 480), (180, 180), (320, 240), [-0.01, 0.002]),
    "port": Camera("pinhole", (640, 480), (300, 300), (320, 240), ports=[(2.0, 3.0, 1.49)], medium_index=1.33),
    "wide port": Camera("fisheye", (640, 480), (180, 180), (320, 240), ports=[(3.0, 2.4, 1.49)], medium_index=1.33),
}


def push(estimator, centre, size, radius=2.5, shear=0.0):
    """Forces `[1, 3, N]` of a patch of pushes of `size` times p0 about `centre`, with `shear` times as much shear."""
    X, normal = at_rest(estimator)
    patch = (X - torch.tensor(centre, dtype=X.dtype)).norm(dim=1) < radius
    traction = patch[:, None] * size * estimator.reference * (-normal + shear * along_y(normal))
    return (traction * estimator.equations.loss.area[:, None]).mT[None], patch


def normal_weights(estimator, force):
    """Weight of the normal part at every inner vertex, over that of a small traction measured against p0."""
    _, normal = at_rest(estimator)
    loss = estimator.equations.loss
    W = loss.weights(normal.mT, force, ONE, SETTINGS.tau[1] * ONE)[0].movedim(-1, 0)
    scale = SETTINGS.sparsity / (estimator.reference * estimator.size) ** 2 / loss.area
    return (normal[:, None] @ W @ normal[..., None]).ravel() / scale


@pytest.mark.parametrize("shear", [0.0, 0.4])
def test_a_touch_looks_the_same_whatever_its_scale(shear, monkeypatch):
    """The loss is that of tractions over what is around: a hundredth of the tractions weighs ten thousand times as much."""
    estimator = make(17)
    loss = estimator.equations.loss
    loss.push_noise = 0 * loss.push_noise
    monkeypatch.setattr(traction_loss, "LEAST_SCALE", 1e-6)
    _, normal = at_rest(estimator)
    force, _ = push(estimator, (3.0, 0.0, 11.5), 0.5, shear=shear)
    strong, light = (loss.weights(normal.mT, share * force, ONE, SETTINGS.tau[1] * ONE) for share in (1.0, 0.01))
    torch.testing.assert_close(light, 1e4 * strong)


def test_tractions_are_compared_with_p0_while_tau_is_large_and_with_no_less_than_the_least_scale():
    loss, last = make(17).equations.loss, SETTINGS.tau[1]
    loss.push_noise = 0 * loss.push_noise
    none = torch.zeros(5, len(loss.area), dtype=torch.float64)
    tau = last * torch.tensor([10.0, 2.0, 1.5, 1.1, 1.0], dtype=torch.float64)
    rho = loss.scale2(none, torch.ones_like(tau), tau).sqrt()
    law = torch.tensor([1.0, 1.0, 0.5, 0.1, traction_loss.LEAST_SCALE], dtype=torch.float64)
    torch.testing.assert_close(rho, law[:, None].expand_as(rho))


def test_a_touch_is_seen_beside_one_that_pushes_four_times_as_much_and_a_hundredth_is_not():
    estimator = make(33)
    estimator.equations.loss.push_noise *= 0
    near, far, least = (6.0, 0.0, 10.0), (-6.0, 0.0, 10.0), (0.0, 7.0, 9.5)
    forces, patches = zip(*(push(estimator, *touch) for touch in ((near, 2.0), (far, 0.5), (least, 0.02))), strict=True)
    weight = normal_weights(estimator, sum(forces))
    strong, weak, none = (weight[patch].median() for patch in patches)
    without = normal_weights(estimator, sum(forces[:2]))[patches[2]].median()
    assert strong < 0.01 and weak < 0.05 * none and none > 0.9 * without


def test_nothing_is_a_push_that_the_noise_makes_by_itself():
    """Pushes at the level of the noise weigh nearly as those far below it; ten times as large ones do not."""
    estimator = make(17)
    loss = estimator.equations.loss
    force, patch = push(estimator, (0.0, 0.0, 12.0), 1.0)
    level = SETTINGS.noise_share * loss.push_noise[patch].mean()
    far_below, at_noise, above = (normal_weights(estimator, share * level * force)[patch] for share in (0.01, 0.5, 10.0))
    assert (at_noise > 0.25 * far_below).all() and (above.median() < 0.01 * far_below.median())


@pytest.mark.parametrize("changes", [{}, dict(floor=0.02), dict(contact_noise=5.0)])
def test_the_smallest_push_of_a_contact_has_the_weight_of_the_floor_beside_noise(changes):
    """With the scale that the noise alone gives: a little less is no contact and weighs more, a little more weighs less."""
    settings, noise = replace(SETTINGS, **changes), 0.01
    scale = settings.noise_share * noise / settings.tau[1]
    smallest = settings.contact_noise * noise / scale
    weights = [float(GemanMcClure(settings.tau[1]).weight(torch.tensor(share * smallest) ** 2)) for share in (0.9, 1, 1.1)]
    assert weights[0] > 1.1 * settings.floor > 1.1 * weights[2] and weights[1] == pytest.approx(settings.floor, rel=1e-5)


@pytest.mark.parametrize("floor", [0.0, 1.0, -1e-3])
def test_a_floor_that_is_no_share_is_refused(floor):
    with pytest.raises(MembraneError, match=f"floor = {floor}; expected more than 0 and less than 1"):
        replace(SETTINGS, floor=floor)


@pytest.mark.parametrize("options", [{}, dict(filling="open"), dict(filling="gas", gas=(0.1, 2600.0))])
def test_the_noise_of_pushes_is_what_noisy_markers_make(options):
    """One undamped quadratic step from rest for a small error of every marker in either direction; their squares add up."""
    estimator, small = make(13, **options), 1e-4
    bearings, loss = estimator.equations.bearings, estimator.equations.loss
    true = torch.nn.functional.normalize(bearings.positions, dim=-1)
    unit = bearings.measured(seen(torch.zeros_like(true), true)).across[0].movedim(-1, 0) * bearings.noise  # [D, 2, 3]
    D = len(true)
    turn = torch.zeros(D, 2, D, 3, dtype=torch.float64)
    turn[range(D), :, range(D)] = bearings.noise * unit
    rays = torch.nn.functional.normalize(true + small * turn.flatten(0, 1), dim=-1)
    measured = bearings.measured(seen(torch.zeros_like(rays), rays))
    state = estimator.at_rest(torch.ones(2 * D, 1, dtype=torch.float64))
    quadratic = torch.full_like(state.pressure, torch.inf)
    u, pressure, moved = estimator.gauss_newton.step(state, measured, quadratic, torch.ones_like(quadratic))
    traction = estimator.equilibrium(u, pressure, moved, u, measured).traction
    _, normal = at_rest(estimator)
    push = (inner(traction, estimator.membrane.grid) * normal).sum(-1) / estimator.reference / small
    expected = (push.square().sum(0) @ loss.surroundings).sqrt()
    torch.testing.assert_close(loss.push_noise, expected, rtol=0.01, atol=0)


def test_a_push_is_a_contact_where_it_stands_out_of_the_noise():
    estimator = make(17)
    loss = estimator.equations.loss
    force, patch = push(estimator, (0.0, 0.0, 12.0), 1.0, radius=4.0)
    _, normal = at_rest(estimator)
    middle = torch.zeros_like(patch)
    middle[len(patch) // 2] = True
    for times, is_contact in ((1.5, False), (6.0, True)):
        traction = times * loss.push_noise[middle] * force / loss.area
        scale = loss.contact_scale(loss(traction, normal.mT, ONE), ONE)[0, middle]
        pushed = -(traction[0] * normal.mT).sum(0)[middle] / estimator.reference
        assert (pushed > scale / 2).item() is is_contact


@pytest.mark.parametrize("camera", CAMERAS.values(), ids=CAMERAS)
def test_along_the_two_vectors_across_a_ray_noise_has_the_covariance_one(camera):
    generator = torch.Generator().manual_seed(1)
    pixels = torch.tensor([[[320.0, 240.0], [150.0, 300.0], [500.0, 100.0]]], dtype=torch.float64)
    root = torch.eye(2) + 0.3 * torch.randn(1, 3, 2, 2, generator=generator, dtype=torch.float64)
    origins, directions = camera.pixel_to_ray(pixels)
    markers, covariance, sure = (origins + 20 * directions)[0], root @ root.mT, torch.ones(1, 3)
    observed = marker_rays(camera, pixels, markers, sure, covariance)
    assert (observed.across @ observed.directions[..., None]).abs().max() < 1e-9
    angles = []
    for noise in root.unbind(-1):  # independent noises of one standard deviation, a thousandth of them
        noisy = marker_rays(camera, pixels + 1e-3 * noise, markers, sure, covariance)
        to_marker = torch.nn.functional.normalize(markers - noisy.origins, dim=-1)
        angles.append((noisy.across @ to_marker[..., None])[..., 0] / 1e-3)
    unit = torch.stack(angles, -1)
    torch.testing.assert_close(unit @ unit.mT, torch.eye(2).expand_as(unit).double(), rtol=0, atol=3e-3)


@pytest.mark.parametrize("noise", [0.003, 0.03, 0.1])
def test_noise_is_measured_beside_edges_and_dots(noise):
    v, u = np.mgrid[:480, :640]
    image = 0.5 + 0.0004 * (u - 320) + 0.2 * ((u // 23 + v // 19) % 2)
    draw = np.random.default_rng(0).normal(size=image.shape)
    measured = pixel_noise(torch.as_tensor(image + noise * draw)[None, None])
    assert measured.item() == pytest.approx(noise, rel=0.12)


@pytest.mark.parametrize("cut", [0.0, 1.0])
def test_noise_is_not_measured_where_the_image_is_black_or_white(cut):
    draw = 0.03 * torch.randn(1, 1, 480, 640, generator=torch.Generator().manual_seed(0))
    image = torch.full((1, 1, 480, 640), 0.5)
    image[..., :213] = cut
    assert pixel_noise((image + draw).clamp(0, 1)).item() == pytest.approx(0.03, rel=0.12)


@pytest.fixture(scope="module")
def fingertip():
    sensor = preset("fingertip")
    sensor = replace(sensor, membrane=sensor.surface.membrane((17, 17)))
    return Simulator(sensor, grid=(26, 26), appearance=Appearance(noise=30.0)), Reconstructor(sensor)


@pytest.fixture(scope="module")
def rest_images(fingertip):
    """Twelve at rest, rendered once, each with noise of its own."""
    simulator, _ = fingertip
    with torch.no_grad():
        clean = simulator.renderer(simulator.membrane.rest)
    return [(255 * noisy(clean, 30.0, np.random.default_rng(k))).round().byte().numpy() for k in range(12)]


def test_covariances_are_the_scatter_of_dots_in_noisy_images(fingertip):
    simulator, reconstructor = fingertip
    with torch.no_grad():
        clean = simulator.renderer(simulator.membrane.rest).numpy()
    noise = np.random.default_rng(1).normal(0, 10**-1.5, (16, *clean.shape))
    with torch.no_grad():
        pixels, _, covariance = reconstructor.observer.locator(torch.from_numpy(clean + noise).float()[:, None])
    scatter, expected = pixels.var(0).mean(-1), covariance.diagonal(dim1=-2, dim2=-1).mean((0, -1))
    assert 0.6 < (scatter / expected).sqrt().median() < 1.2
    assert np.corrcoef(scatter.log(), expected.log())[0, 1] > 0.5


def test_several_rest_images_have_less_noise_than_one(fingertip, rest_images):
    _, reconstructor = fingertip
    images = [image / 255 for image in rest_images[:8]]
    sensor = reconstructor.sensor
    variances = []
    for rest in (images[0], np.mean(images, 0)):
        markers = replace(sensor.markers, rest_image=rest.astype(np.float32))
        observer = Reconstructor(replace(sensor, markers=markers), "minimum-energy").observer
        variances.append(observer.rest_covariance.diagonal(dim1=-2, dim2=-1).mean())
    assert 0.1 < variances[1] / variances[0] < 0.4  # an eighth, and what the dots' model leaves


def test_a_marker_that_is_known_badly_moves_nothing(fingertip):
    _, reconstructor = fingertip
    displacement = torch.zeros(1, len(reconstructor.rest_pixels), 2)
    displacement[0, 40, 0] = 0.2
    covariance = 2 * reconstructor.observer.rest_covariance[None].clone()
    moved = []
    for variance in (0.0, 100.0):
        covariance[0, 40, 0, 0] += variance
        with torch.no_grad():
            observation = reconstructor.observation(displacement, torch.ones(1, displacement.shape[1]), covariance)
            found = reconstructor.estimator(observation)
        moved.append((found.vertices - reconstructor.estimator.membrane.rest).norm())
    assert moved[1] < 0.2 * moved[0]


@pytest.mark.parametrize("frames", [4, pytest.param(12, marks=pytest.mark.full)])
def test_at_rest_no_contact_is_found_and_hardly_any_force(fingertip, rest_images, frames):
    _, reconstructor = fingertip
    with torch.no_grad():
        result = reconstructor(np.stack(rest_images[:frames]))
    assert (result.status == 0).all() and result.contact_points.isnan().all()
    assert result.force.norm(dim=-1).max() < 0.02  # the touch below, of a hundredth of a firm press, takes 0.1


def test_a_light_touch_is_found_with_its_force_and_place(fingertip):
    simulator, reconstructor = fingertip
    ball, way = Sphere(2.5), np.array([0.3, 0.2, -1.0]) / np.linalg.norm([0.3, 0.2, -1.0])
    ball = ball.touching(simulator.membrane, way)
    stroke = Stroke(ball, way, 0.45)
    (state,) = simulator.presses(stroke, ("push",))
    frame = simulator.frame(state, stroke, np.random.default_rng(0))
    with torch.no_grad():
        result = reconstructor(frame.image)
    force, place = state.force.numpy(), state.contact_points[0].numpy()
    assert np.linalg.norm(result.force[0].numpy() - force) < 0.15 * np.linalg.norm(force)
    assert result.contact_points[0, 1:].isnan().all()
    assert np.linalg.norm(result.contact_points[0, 0].numpy() - place) < 1.0
