"""A pixel of a cropped or binned camera sees its block's mean."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from torchmembrane import Camera, MembraneError, Reconstructor, Sensor
from torchmembrane.cli.describe import described

EXAMPLES = Path(__file__).parents[1] / "examples"
PORT = {"ports": [(2.0, 3.0, 1.49)], "medium_index": 1.33}
CAMERAS = {
    "pinhole": Camera("pinhole", (640, 480), (400.0, 404.0), (320.3, 238.8), (-0.3, 0.1, 1e-3, -2e-3, -0.01)),
    "fisheye": Camera("fisheye", (640, 480), (170.0, 172.0), (321.7, 240.2), (-0.02, 0.004, -0.003, 0.0005)),
    "pinhole, port": Camera("pinhole", (640, 480), (300.0, 302.0), (318.9, 241.1), **PORT),
    "fisheye, port": Camera("fisheye", (640, 480), (170.0, 172.0), (320.4, 239.6), (-0.02, 0.004), **PORT),
}
MODES = [(None, 2), (None, (1, 4)), ((11, 7, 600, 468), 1), ((101, 32, 450, 360), 3), ((50, 61, 500, 399), (5, 3))]
CROP = (91, 21, 462, 444)


@pytest.mark.parametrize("crop, binning", MODES)
@pytest.mark.parametrize("name", CAMERAS)
def test_a_pixel_of_a_mode_sees_what_the_middle_of_its_block_sees(name, crop, binning):
    whole = CAMERAS[name]
    camera = whole.in_mode(crop, binning)
    left, top, width, height = crop or (0, 0, 640, 480)
    b, c = (binning, binning) if isinstance(binning, int) else binning
    assert camera.image_size == (width // b, height // c)
    rng = np.random.default_rng(0)
    column, row = (rng.integers(size // 4, 3 * size // 4, 50) for size in camera.image_size)
    block = (
        np.stack([left + b * column[:, None] + np.arange(b)] * c, 1),
        np.stack([top + c * row[:, None] + np.arange(c)] * b, 2),
    )
    middle = np.stack([part.mean((1, 2)) for part in block], -1)
    origin, direction = camera.pixel_to_ray(torch.from_numpy(np.stack([column, row], -1).astype(float)))
    for t in (20.0, 60.0):
        seen = whole.point_to_pixel(origin + t * direction)
        torch.testing.assert_close(seen, torch.from_numpy(middle), rtol=0, atol=1e-8)


@pytest.mark.parametrize("name", CAMERAS)
def test_a_mode_within_a_mode_is_one_mode(name):
    camera = CAMERAS[name]
    twice = camera.in_mode((40, 30, 560, 420), (2, 1)).in_mode((10, 60, 240, 300), (3, 5))
    once = camera.in_mode((60, 90, 480, 300), (6, 5))
    for key, value in once.state_dict().items():
        torch.testing.assert_close(twice.state_dict()[key], value)
    assert twice.image_size == once.image_size


def test_the_whole_image_unbinned_is_the_camera_itself():
    camera = CAMERAS["fisheye, port"]
    same = camera.in_mode()
    assert same.image_size == camera.image_size
    assert all(torch.equal(same.state_dict()[key], value) for key, value in camera.state_dict().items())


@pytest.fixture(scope="module")
def sensor():
    whole = Sensor.from_file(EXAMPLES / "sensor.toml")
    return replace(whole, membrane=whole.membrane.resampled((17, 17)))


@pytest.fixture(scope="module")
def presses(sensor):
    """Images `[2, H, W]` of an independent renderer, and what is reconstructed from them."""
    reconstructor = Reconstructor(sensor)
    images = reconstructor.read(EXAMPLES / "press_on_axis.png", EXAMPLES / "two_contacts.png")
    with torch.no_grad():
        return images[:, 0].numpy(), reconstructor(images)


def blocks(image, crop, b, c):
    """The mean of each block, one by one."""
    left, top, width, height = crop
    part = image[top : top + height, left : left + width]
    return np.mean([part[j::c, i::b] for i in range(b) for j in range(c)], 0)


@pytest.mark.parametrize("binning, surface, force", [((1, 1), 0.03, 0.01), ((2, 2), 0.1, 0.03), ((2, 1), 0.1, 0.03)])
def test_the_cropped_and_binned_image_of_a_press_gives_the_whole_one_s_surface(sensor, presses, binning, surface, force):
    images, whole = presses
    mode = replace(sensor, camera=sensor.camera.in_mode(CROP, binning))
    reconstructor = Reconstructor(mode)
    assert np.allclose(mode.markers.rest_image, blocks(sensor.markers.rest_image, CROP, *binning), atol=1e-6)
    off = (reconstructor.observer.measured_rest - reconstructor.rest_pixels).mean(0)
    assert off.norm() < 0.01  # px; a block's corner in place of its middle would be 0.25 in u
    with torch.no_grad():
        got = reconstructor(np.stack([blocks(image, CROP, *binning) for image in images]))
    assert got.status.tolist() == [0, 0]
    error, moved = (got.vertices - whole.vertices).norm(dim=(1, 2)), whole.displacement.norm(dim=(1, 2))
    assert (error < surface * moved).all()
    assert ((got.force - whole.force).norm(dim=1) < force * whole.force.norm(dim=1)).all()


def test_images_of_another_size_than_the_mode_s_are_refused(sensor):
    reconstructor = Reconstructor(replace(sensor, camera=sensor.camera.in_mode(CROP, 2)))
    with pytest.raises(MembraneError, match="the image is 640 x 480 px, expected 231 x 222 .*mode crops or bins"):
        reconstructor(np.zeros((480, 640), np.uint8))
    with pytest.raises(MembraneError, match=r"shape is \[222, 231\]; expected the calibrated \[480, 640\]"):
        reconstructor.camera.mode.image(np.zeros((222, 231)))


MODE = "crop = [91, 21, 462, 444]\nbinning = 3\n"
BEFORE = "[membrane]"


@pytest.fixture
def file(tmp_path):
    """Path of a copy of the example's sensor in a mode."""
    for name in ("rest_grid.npz", "dots.csv", "rest.png"):
        (tmp_path / name).symlink_to(EXAMPLES / name)
    text = (EXAMPLES / "sensor.toml").read_text()
    assert text.count(BEFORE) == 1
    (tmp_path / "sensor.toml").write_text(text.replace(BEFORE, MODE + BEFORE))
    return tmp_path / "sensor.toml"


def test_a_mode_is_written_as_it_was_read(file, tmp_path):
    sensor = Sensor.from_file(file)
    written = sensor.to_file(tmp_path / "again")
    assert "image_size = [640, 480]" in written.read_text() and "binning = [3, 3]" in written.read_text()
    again = Sensor.from_file(written)
    assert again.camera.mode == sensor.camera.mode and again.camera.image_size == (154, 148)
    assert all(torch.equal(again.camera.state_dict()[key], value) for key, value in sensor.camera.state_dict().items())
    assert np.array_equal(again.markers.rest_image, sensor.markers.rest_image)
    assert again.fingerprint == sensor.fingerprint


def test_a_mode_and_the_camera_that_it_makes_have_one_fingerprint(file):
    sensor, whole = Sensor.from_file(file), Sensor.from_file(EXAMPLES / "sensor.toml")
    camera = sensor.camera
    values = camera.focal.tolist(), camera.centre.tolist(), camera.distortion.tolist(), camera.ports, camera.medium_index.item()
    alike = replace(sensor, camera=Camera(camera.model, camera.image_size, *values))
    assert alike.camera.mode is None and alike.fingerprint == sensor.fingerprint != whole.fingerprint


def test_a_rest_image_may_be_of_the_mode_s_size_or_of_the_calibrated_one(file):
    sensor = Sensor.from_file(file)
    levels = np.rint(65535.0 * sensor.markers.rest_image).astype(np.uint16)
    (file.parent / "rest.png").unlink()
    Image.fromarray(levels).save(file.parent / "rest.png")
    given = Sensor.from_file(file)
    assert np.allclose(given.markers.rest_image, sensor.markers.rest_image, atol=1e-5)
    Image.fromarray(np.zeros((240, 320), np.uint8)).save(file.parent / "rest.png")
    with pytest.raises(MembraneError) as caught:
        Sensor.from_file(file)
    for words in (str(file), "320 x 240 px", "[154, 148]", "[91, 21, 462, 444]", "[3, 3]", "or the calibrated [640, 480]"):
        assert words in str(caught.value)


def test_a_camera_that_was_changed_after_is_written_as_it_is(file, tmp_path):
    sensor = Sensor.from_file(file)
    sensor.camera.centre.add_(0.125)
    again = Sensor.from_file(sensor.to_file(tmp_path / "again"))
    assert again.camera.mode is None and torch.equal(again.camera.centre, sensor.camera.centre)


@pytest.mark.parametrize(
    "mode, words",
    [
        ("crop = [91, 21, 462]", "[camera] crop = [91, 21, 462]; expected a list of 4 whole numbers"),
        ("crop = [91.5, 21, 462, 444]", "[camera] crop = [91.5, 21, 462, 444]; expected a list of 4 whole numbers"),
        ("crop = [-1, 21, 462, 444]", "crop is [-1, 21, 462, 444]; expected left, top, width, height"),
        ("crop = [91, 21, 550, 444]", "crop is [91, 21, 550, 444]; expected left, top, width, height in whole px, within"),
        ("crop = [91, 40, 462, 444]", "within the calibrated image of 640 x 480"),
        ("crop = [91, 21, 0, 444]", "crop is [91, 21, 0, 444]"),
        ("binning = 0", "binning is [0, 0]; expected whole numbers of 1 or more"),
        ("binning = 2.0", "[camera] binning = 2.0; expected a whole number, or a list of 2"),
        ("binning = [2, 2, 2]", "[camera] binning = [2, 2, 2]; expected a whole number, or a list of 2"),
        ("binning = 7", "divide the width and height of the crop, 640 x 480: crop = [0, 0, 637, 476] would do"),
        ("crop = [1, 2, 30, 40]\nbinning = [50, 1]", "binning is [50, 1]; expected"),
        ("bining = 2", "[camera] bining is unknown here"),
    ],
)
def test_every_mistake_in_a_mode_is_named(file, mode, words):
    file.write_text(file.read_text().replace(MODE, mode + "\n"))
    with pytest.raises(MembraneError) as caught:
        Sensor.from_file(file)
    message = str(caught.value)
    assert str(file) in message and "[camera]" in message and words in message and "\n" not in message


@pytest.mark.parametrize(
    "crop, binning", [((0.5, 0, 4, 4), 1), ((0, 0, float("nan"), 4), 1), ((0, 0, 4), 1), (None, (2, 2, 2))]
)
def test_a_mode_made_in_python_is_checked_alike(crop, binning):
    with pytest.raises(MembraneError, match="Camera: (crop|binning) is"):
        CAMERAS["pinhole"].in_mode(crop, binning)


def test_check_says_the_mode_in_words(file):
    said = "\n".join(described(Sensor.from_file(file)))
    assert "fisheye, 154 x 148 px" in said
    assert "calibrated at 640 x 480 px; its images are the 462 x 444 px from column 91 and row 21 on, binned 3 x 3" in said
    assert "calibrated" not in "\n".join(described(Sensor.from_file(EXAMPLES / "sensor.toml")))
