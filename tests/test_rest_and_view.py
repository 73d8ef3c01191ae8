"""A wrong rest image and a partial view are recognised."""

import re
from dataclasses import replace

import numpy as np
import pytest
import torch
from PIL import Image
from scipy import ndimage

import torchmembrane as tm
from torchmembrane.camera.model import Camera
from torchmembrane.cli.main import main
from torchmembrane.presets import preset
from torchmembrane.simulate import Simulator, Sphere, Stroke
from torchmembrane.simulate.appearance import Appearance

pytestmark = pytest.mark.usefixtures("quick_images")

WAY = np.array([0.1, 0.2, -1.0]) / np.linalg.norm([0.1, 0.2, -1.0])


def seen_by(scale=1.0, shift=0.0):
    """The fingertip on 17 x 17 vertices, its camera's focal length times `scale`, its centre moved by `shift` px; simulator."""
    sensor = preset("fingertip")
    camera = sensor.camera
    centre = (float(camera.centre[0]) + shift, float(camera.centre[1]))
    camera = Camera(camera.model, camera.image_size, tuple((scale * camera.focal).tolist()), centre, camera.distortion.tolist())
    markers = replace(sensor.markers, rest_image=None)
    sensor = replace(sensor, camera=camera, membrane=sensor.surface.membrane((17, 17)), markers=markers)
    simulator = Simulator(sensor, grid=(26, 26), appearance=Appearance(noise=35.0))
    return replace(sensor, markers=replace(markers, rest_image=simulator.rest_image())), simulator


def pressed(simulator, seed=0):
    stroke = Stroke(Sphere(3.0).touching(simulator.membrane, WAY), WAY, 1.6)
    (state,) = simulator.presses(stroke, ("push",))
    return simulator.frame(state, stroke, np.random.default_rng(seed))


def drawn_out(image):
    """Stretched on one side, pressed together on the other: no motion of a camera."""
    v, u = np.indices(image.shape).astype(float)
    away = 6 * np.sin(np.pi * u / 640) ** 2 * np.sin(2 * np.pi * v / 480)
    return ndimage.map_coordinates(image.astype(float), [v, u - away], order=1, mode="nearest").clip(0, 255).astype(np.uint8)


@pytest.fixture(scope="module")
def fingertip():
    return seen_by()


@pytest.mark.parametrize(("shift", "said"), [(0, None), (2, None), (6, "6.0 px"), (40, "px")])
def test_a_rest_image_that_disagrees_is_refused_by_how_much(fingertip, shift, said):
    sensor, _ = fingertip
    moved = replace(sensor, markers=replace(sensor.markers, rest_image=np.roll(sensor.markers.rest_image, shift, 1)))
    if said is None:
        assert tm.Reconstructor(moved).observer.rest_offset() == pytest.approx(shift, abs=0.1)
        return
    with pytest.raises(tm.MembraneError, match=said):
        tm.Reconstructor(moved)


def test_check_opens_a_sensor_that_disagrees_and_says_so(fingertip, tmp_path, capsys):
    sensor, _ = fingertip
    moved = replace(sensor, markers=replace(sensor.markers, rest_image=np.roll(sensor.markers.rest_image, 9, 1)))
    moved.to_file(tmp_path / "sensor.toml")
    assert main(["check", str(tmp_path / "sensor.toml"), "--out", str(tmp_path / "drawn.png")]) == 2
    told = capsys.readouterr()
    assert "found in the rest image" in told.out and "9.0" in told.out and (tmp_path / "drawn.png").exists()
    assert "calibrate rest" in told.err


@pytest.mark.parametrize(("scale", "shift"), [(1.5, 120.0), pytest.param(2.2, 0.0, marks=pytest.mark.full)])
def test_a_part_of_the_membrane_is_seen_and_the_press_in_it_found(scale, shift):
    """Dots outside the image are unseen, not lost: the surface is known at those in view, and they alone count."""
    sensor, simulator = seen_by(scale, shift)
    reconstructor = tm.Reconstructor(sensor)
    seen = reconstructor.observer.seen_at_rest
    assert 0.5 * len(seen) < seen.sum() < 0.95 * len(seen)
    frame = pressed(simulator)
    with torch.no_grad():
        result = reconstructor(frame.image)
    X, Y = frame.truth["dots_nominal"], frame.truth["dots_deformed"]
    assert result.status.tolist() == [0] and result.coverage[0] > 0.95
    assert np.linalg.norm(result.markers[0].numpy() - Y) < 0.15 * np.linalg.norm(Y - X)
    assert np.linalg.norm(result.force[0].numpy() - frame.truth["force"]) < 0.25 * np.linalg.norm(frame.truth["force"])


@pytest.mark.parametrize(("pin", "status"), [(0.0, tm.Status.OK), (2.0, tm.Status.UNEXPLAINED), (4.0, tm.Status.UNEXPLAINED)])
def test_markers_that_move_as_the_tips_of_pins_are_not_those_of_a_membrane(fingertip, pin, status):
    """Pins that stand on the inner side turn with it: their tips move sideways with the slope, as no marker on it does."""
    sensor, simulator = fingertip
    stroke = Stroke(Sphere(3.0).touching(simulator.membrane, WAY), WAY, 0.5)
    (state,) = simulator.presses(stroke, ("push",))
    truth, membrane = simulator.frame(state, stroke, np.random.default_rng(0)).truth, simulator.membrane
    X, Y, at = truth["dots_nominal"], truth["dots_deformed"], membrane.closest_points(sensor.markers.positions)

    def seen(base, normals):
        tips = base - pin * (normals.numpy()[at.vertices] * at.weights[..., None]).sum(1)
        return sensor.camera.point_to_pixel(torch.from_numpy(tips))

    moved = seen(Y, membrane.normals(torch.as_tensor(state.vertices))) - seen(X, membrane.rest_normals)
    reconstructor = tm.Reconstructor(sensor)
    result = reconstructor.from_pixels(reconstructor.rest_pixels + moved)
    assert result.status.tolist() == [status]
    assert pin > 0 or np.linalg.norm(result.markers[0].numpy() - Y) < 0.15 * np.linalg.norm(Y - X)


def test_what_the_lens_cannot_image_is_no_error(fingertip):
    """A pinhole camera inside the membrane: what lies beside or behind it has no pixel."""
    sensor, _ = fingertip
    rest = sensor.membrane.rest.reshape(17, 17, 3).numpy() - np.array([0, 0, 6.0])
    surface = replace(sensor.surface, values=sensor.surface.values | {"base_z": sensor.surface.values["base_z"] - 6.0})
    camera = Camera("pinhole", (640, 480), (250, 250), (320, 240))
    positions = sensor.markers.positions - np.array([0, 0, 6.0])
    assert (rest[..., 2] < 0).any()
    lowered = replace(
        sensor,
        camera=camera,
        surface=surface,
        membrane=surface.membrane((17, 17)),
        markers=replace(sensor.markers, positions=positions, rest_image=None),
    )
    reconstructor = tm.Reconstructor(lowered)
    assert not reconstructor.vertex_pixels.isfinite().all()
    result = reconstructor.from_pixels(reconstructor.rest_pixels, reconstructor.observer.seen_at_rest.float())
    assert result.status.tolist() == [0] and result.force.norm() < 1e-3
    with pytest.raises(tm.MembraneError, match="cannot be projected"):
        tm.Reconstructor(lowered, "minimum-energy")


def test_a_recording_brings_its_own_rest(fingertip, tmp_path, capsys):
    """All images drawn out by up to 6 px, as of an aged membrane: against the rest image a false press, against their own the
    press."""
    sensor, simulator = fingertip
    sensor.to_file(tmp_path / "sensor.toml")
    frame = pressed(simulator)
    images = [simulator.image(simulator.membrane.rest, np.random.default_rng(k)) for k in range(2)] + [frame.image]
    for k, image in enumerate(images):
        Image.fromarray(drawn_out(image)).save(tmp_path / f"i{k}.png")
    *at_rest, press = (str(tmp_path / f"i{k}.png") for k in range(3))
    truth = frame.truth["force"]
    given = {"own": [press], "first": [*at_rest, press, "--rest", "first:2"], "files": [press, "--rest", *at_rest]}
    errors = {}
    for name, options in given.items():
        out = tmp_path / name
        assert main(["reconstruct", str(tmp_path / "sensor.toml"), *options, "--batch", "1", "--out", str(out)]) == 0
        force = tm.read_results(out)["i2"]["force"]
        errors[name] = np.linalg.norm(force - truth) / np.linalg.norm(truth)
    assert errors["own"] > 0.3 and errors["first"] < 0.12 and errors["files"] == pytest.approx(errors["first"], abs=1e-6)
    again = ["reconstruct", str(tmp_path / "sensor.toml"), *at_rest, press, "--out", str(tmp_path / "first")]
    assert main(again) == 2 and "--rest first:2" in capsys.readouterr().err
    assert main([*again, "--rest", "first:none"]) == 2


def test_the_sensor_s_own_rest_image_shows_no_contact_whatever_the_error_of_its_file(fingertip, tmp_path, capsys):
    """A membrane that the file says to be too high lies deeper in the rest image, which is no press of the recording."""
    sensor, _ = fingertip
    a, b, height = sensor.surface.values["semi_axes"]
    surface = replace(sensor.surface, values=sensor.surface.values | {"semi_axes": [a, b, 1.05 * height]})
    base, positions = sensor.surface.values["base_z"], sensor.markers.positions.copy()
    positions[:, 2] = base + 1.05 * (positions[:, 2] - base)
    high = replace(
        sensor, surface=surface, membrane=surface.membrane((17, 17)), markers=replace(sensor.markers, positions=positions)
    )
    path, rest = high.to_file(tmp_path / "sensor.toml"), str(tmp_path / "own.png")
    assert tm.Reconstructor.from_file(path).observer.rest_offset() > 1.0
    Image.fromarray(np.rint(255 * sensor.markers.rest_image).astype(np.uint8)).save(rest)
    assert main(["reconstruct", str(path), rest, "--out", str(tmp_path / "out"), "--rest", rest]) == 0
    assert "warning" not in capsys.readouterr().err


def test_results_by_other_rest_images_of_the_same_names_are_refused(fingertip, tmp_path, capsys):
    sensor, simulator = fingertip
    path, rest = sensor.to_file(tmp_path / "sensor.toml"), str(tmp_path / "rest.png")
    command = ["reconstruct", str(path), rest, "--out", str(tmp_path / "out"), "--rest", rest]
    for seed, code in ((3, 0), (3, 0), (4, 2)):
        Image.fromarray(simulator.image(simulator.membrane.rest, np.random.default_rng(seed))).save(rest)
        assert main(command) == code
    assert f"the images of --rest {rest} have changed since its results were made" in capsys.readouterr().err


def test_a_rest_that_is_a_press_is_said(fingertip, tmp_path, capsys):
    """With the force of the press, which then reads as none; of an image without contact nothing is said."""
    sensor, simulator = fingertip
    path, frame = sensor.to_file(tmp_path / "sensor.toml"), pressed(simulator)
    untouched = simulator.image(simulator.membrane.rest, np.random.default_rng(3))
    said = {}
    for name, image in {"untouched": untouched, "press": frame.image}.items():
        Image.fromarray(image).save(tmp_path / f"{name}.png")
        rest = str(tmp_path / f"{name}.png")
        assert main(["reconstruct", str(path), rest, "--out", str(tmp_path / name), "--rest", rest]) == 0
        said[name] = capsys.readouterr().err
    assert "warning" not in said["untouched"]
    words = r"--rest .*press.png: a contact of (\S+) .*is found in the images that are taken for rest, and reads as none"
    force = float(re.search(words, said["press"])[1])
    assert force == pytest.approx(np.linalg.norm(frame.truth["force"]), rel=0.2)


def test_a_rest_image_that_is_not_readable_is_named(small_sensor, small_images, tmp_path, capsys):
    Image.fromarray(np.zeros((8, 8), np.uint8)).save(tmp_path / "small.png")
    command = ["reconstruct", str(small_sensor / "sensor.toml"), str(small_images[0]), "--out", str(tmp_path / "out")]
    assert main([*command, "--rest", str(tmp_path / "small.png")]) == 2
    assert f"{tmp_path / 'small.png'}: the image is 8 x 8 px" in capsys.readouterr().err
