"""A moved camera is found with the surface and compensated."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy import ndimage
from test_light import CAMERAS

from torchmembrane import Reconstructor, Status, Tracker
from torchmembrane.camera.motion import shift_of, to_degrees_and_scale, to_pixels
from torchmembrane.estimators.force_balance.camera_motion import PRIOR_WEIGHT, CameraMotion
from torchmembrane.estimators.force_balance.marker_residuals import marker_rays
from torchmembrane.presets import preset
from torchmembrane.simulate import Simulator, Sphere, Stroke
from torchmembrane.simulate.appearance import Appearance

pytestmark = pytest.mark.usefixtures("quick_images")

SIZE = (640, 480)


def test_elimination_solves_the_whole_system():
    """`[M B'; B T] [d; dm] = -[g; k]` and, of three loads, the second alone feels the camera's slope."""
    generator = torch.Generator().manual_seed(0)
    root = torch.randn(2, 40, 34, generator=generator, dtype=torch.float64)
    whole = root.mT @ root
    M, B, T = whole[:, :30, :30], whole[:, 30:, :30], whole[:, 30:, 30:]
    loads, k = (torch.randn(*shape, generator=generator, dtype=torch.float64) for shape in ((2, 3, 30), (2, 4)))
    motion, all_loads = CameraMotion(B, T, k), torch.cat([loads, B], 1)
    products, following = motion.eliminated(all_loads @ torch.linalg.inv(M) @ all_loads.mT)
    pull = torch.stack([torch.zeros_like(k), k, torch.zeros_like(k)], 1)
    expected = torch.linalg.solve(whole, torch.cat([loads, pull], 2).mT)
    torch.testing.assert_close(following, -expected[:, 30:])
    torch.testing.assert_close(products, loads @ expected[:, :30])
    kept = motion.project_out(loads[:, 1:2], k[:, None])
    torch.testing.assert_close(kept @ torch.linalg.inv(M - B.mT @ torch.linalg.solve(T, B)), expected[:, :30, 1:2].mT)


def test_what_holds_the_camera_is_the_slope_of_its_loss():
    moved = torch.tensor([[0.2, -0.1, 0.05, 0.3]], dtype=torch.float64, requires_grad=True)
    loss = PRIOR_WEIGHT / 2 * torch.log(0.1**2 + moved.square().sum())
    (slope,) = torch.autograd.grad(loss, moved)
    none = CameraMotion(torch.zeros(1, 4, 3), torch.zeros(1, 4, 4), torch.zeros(1, 4))
    held = none.with_prior(moved.detach(), 0.1)
    torch.testing.assert_close(held.slope, slope)
    assert torch.linalg.eigvalsh(held.own).min() > 0


def test_the_motion_is_a_similarity_of_the_image_and_its_words_say_which():
    moved = torch.tensor([[0.4, -0.3, 0.5, -0.7]], dtype=torch.float64)
    pixels = torch.tensor([[[0.0, 0.0], [639.0, 479.0], [100.0, 300.0]]], dtype=torch.float64)
    du, dv, degrees, scale = to_degrees_and_scale(moved, SIZE)[0].tolist()
    c, s = np.cos(np.deg2rad(degrees)), np.sin(np.deg2rad(degrees))
    centre = np.array([319.5, 239.5])
    expected = scale * (pixels[0].numpy() - centre) @ np.array([[c, s], [-s, c]]) + centre + [du, dv]
    np.testing.assert_allclose((pixels + shift_of(moved, pixels, SIZE))[0].numpy(), expected, atol=2e-3)
    torch.testing.assert_close(to_pixels(to_degrees_and_scale(moved, SIZE), SIZE), moved)


@pytest.mark.parametrize("name", CAMERAS)
def test_rays_say_what_the_camera_s_motion_makes_of_their_angles(name):
    """Pixels shifted by a small motion: the angles of the unmoved markers' rays across the shifted ones are minus `motion`."""
    camera, generator = CAMERAS[name], torch.Generator().manual_seed(2)
    pixels = torch.tensor([120.0, 90.0]) + torch.rand(1, 30, 2, generator=generator) * torch.tensor([400.0, 300.0])
    root = 0.2 * torch.randn(1, 30, 2, 2, generator=generator) + 0.1 * torch.eye(2)
    covariance, moved = (root @ root.mT).double(), 1e-3 * torch.tensor([[1.0, -2.0, 3.0, 0.5]], dtype=torch.float64)
    pixels, sure = pixels.double(), torch.ones(1, 30, dtype=torch.float64)
    origins, directions = camera.pixel_to_ray(pixels)
    markers = (origins + 25 * directions)[0]
    still = marker_rays(camera, pixels, markers, sure, covariance)
    shifted = marker_rays(camera, pixels + shift_of(moved, pixels, SIZE), markers, sure, covariance)
    seen_at = torch.nn.functional.normalize(markers - shifted.origins, dim=-1)
    angles = (shifted.across @ seen_at[..., None])[..., 0]
    torch.testing.assert_close(angles, -(still.motion @ moved[0]), rtol=5e-3, atol=1e-6)


@pytest.fixture(scope="module")
def fingertip():
    sensor = preset("fingertip")
    sensor = replace(sensor, membrane=sensor.surface.membrane((17, 17)))
    simulator, way = Simulator(sensor, grid=(31, 31), appearance=Appearance(noise=35.0)), np.array([0.3, 0.2, -1.0])
    way /= np.linalg.norm(way)
    stroke = Stroke(Sphere(3.0).touching(simulator.membrane, way), way, 1.4)
    (state,) = simulator.presses(stroke, ("push",))
    return Reconstructor(sensor), simulator, simulator.frame(state, stroke, np.random.default_rng(0))


def seen(image, matrix=((1, 0), (0, 1)), shift=(0.0, 0.0)):
    """The image of a camera that moved, `p -> matrix (p - c) + c + shift`, rows first."""
    inverse, centre = np.linalg.inv(np.array(matrix, float)), (np.array(image.shape) - 1) / 2
    offset = centre - inverse @ (centre + np.array(shift))
    return ndimage.affine_transform(image / 255, inverse, offset, order=1, mode="nearest").astype(np.float32)


def turned(degrees):
    c, s = np.cos(np.deg2rad(degrees)), np.sin(np.deg2rad(degrees))
    return ((c, s), (-s, c))


WAYS = {  # matrix, shift; du, dv, degrees, scale
    "shifted": (dict(shift=(-1.5, 2.0)), (2.0, -1.5, 0, 1)),
    "far": (dict(shift=(0, 5.0)), (5.0, 0, 0, 1)),
    "rotated": (dict(matrix=turned(1.0)), (0, 0, 1.0, 1)),
    "zoomed": (dict(matrix=((0.98, 0), (0, 0.98))), (0, 0, 0, 0.98)),
}


@pytest.mark.parametrize("name", WAYS)
def test_a_bumped_camera_is_found_and_taken_out(fingertip, name):
    reconstructor, _, frame = fingertip
    options, expected = WAYS[name]
    with torch.no_grad():
        clean, got = reconstructor(frame.image), reconstructor(seen(frame.image, **options))
    du, dv, degrees, scale = got.camera_motion[0].tolist()
    assert abs(du - expected[0]) < 0.2 and abs(dv - expected[1]) < 0.2
    assert abs(degrees - expected[2]) < 0.03 and abs(scale - expected[3]) < 1e-3
    assert got.status.tolist() == [0] and got.residual[0] < 0.1
    truth, size = frame.truth["force"], np.linalg.norm(frame.truth["force"])
    assert np.linalg.norm(got.force[0].numpy() - truth) < 0.2 * size
    assert (got.vertices - clean.vertices).norm() < 0.1 * clean.displacement.norm()
    assert (got.pixels - clean.pixels).norm(dim=-1).median() > 0.4  # as measured


@pytest.mark.parametrize("share, status", [(0.02, Status.OK), (0.05, Status.UNEXPLAINED)])
def test_an_image_that_is_shifted_farther_than_a_camera_moves_is_doubted(fingertip, share, status):
    """As one of which bytes are lost, or a packet of its camera: it is kept, as a camera may have come off."""
    reconstructor, _, frame = fingertip
    shift = share * np.hypot(*reconstructor.image_size) / 2
    with torch.no_grad():
        got = reconstructor(seen(frame.image, shift=(0, shift)))
    assert got.status.tolist() == [status] and abs(float(got.camera_motion[0, 0]) - shift) < 0.5


def test_a_camera_that_stays_is_left_alone(fingertip):
    reconstructor, simulator, frame = fingertip
    images = [simulator.image(simulator.membrane.rest, np.random.default_rng(k)) for k in range(4)] + [frame.image]
    with torch.no_grad():
        motion = reconstructor(np.stack(images)).camera_motion
    assert (motion - torch.tensor([0, 0, 0, 1.0])).abs().max() < 0.02


def test_a_tracker_keeps_the_camera_s_motion(fingertip):
    reconstructor, _, frame = fingertip
    tracker, image = Tracker(reconstructor), seen(frame.image, shift=(0, 2.0))
    for _ in range(3):
        result = tracker(image)
        assert result.status.tolist() == [0] and abs(float(result.camera_motion[0, 0]) - 2.0) < 0.1


def test_what_no_camera_and_no_surface_does_is_said(fingertip):
    """Half of the image torn from the other."""
    reconstructor, _, frame = fingertip
    torn = np.concatenate([frame.image[:240], np.roll(frame.image[240:], 8, 1)])
    with torch.no_grad():
        got = reconstructor(torn)
    assert got.status.tolist() == [Status.UNEXPLAINED] and got.vertices.isfinite().all()
