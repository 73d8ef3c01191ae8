"""torch's default device does not change any result."""

import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

import torchmembrane as tm
from torchmembrane.calibrate.camera import Views
from torchmembrane.cli.main import main
from torchmembrane.simulate.dataset import stroke_to
from torchmembrane.simulate.pattern import Speckle

EXAMPLES = Path(__file__).parents[1] / "examples"


@pytest.fixture(autouse=True)
def _cpu_by_default():
    yield
    torch.set_default_device(None)


@pytest.fixture(scope="module")
def paths(small_sensor, small_images):
    return small_sensor / "sensor.toml", small_images


def answers(paths, **options):
    """What a sensor's reconstructor says of an image by all ways."""
    path, images = paths
    made, levels = tm.Reconstructor.from_file(path, **options), np.asarray(Image.open(images[2]))
    with torch.no_grad():
        result = made(levels)
        found = [*result, *made(levels, result), *made.from_pixels(result.pixels.numpy())]
    differentiated = made.read(images[2]).requires_grad_()
    made(differentiated).vertices.nansum().backward()
    found += [differentiated.grad, *made.state_dict().values()]
    if made.finds_tractions:
        with torch.no_grad():
            found += [*made.standard_deviations(result), *made(levels, pressure=0.01), *made.fields(result).values()]
    return found


def tracked(paths):
    """Frames of one stream, with a gauge, and the drift."""
    path, images = paths
    tracker = tm.Tracker(tm.Reconstructor.from_file(path))
    frames = [np.asarray(Image.open(images[k])) for k in (0, 0, 2)]
    found = [part for frame in frames for part in tracker(frame, pressure=0.01)]
    tracker.rezero(frames[0])
    found += [part for _ in range(12) for part in tracker(frames[0])]
    tracker.warm_up()
    return [*found, torch.from_numpy(np.array(tracker.drift))]


def of_presets(paths):
    """Surfaces, cameras and cavities of all presets: caps, a half cylinder, and an inflated sheet."""
    found = []
    for name in ("fingertip", "bubble", "half_cylinder"):
        sensor = tm.preset(name)
        found += [
            *sensor.membrane.resampled((9, 9)).buffers(),
            *sensor.camera.buffers(),
            *sensor.surface.membrane((9, 9)).buffers(),
        ]
    return found


def simulated(paths):
    """Presses of all bodies, and their images."""
    sensor = tm.Sensor.from_file(paths[0])
    simulator = tm.simulate.Simulator(sensor)
    bodies = [
        tm.simulate.Sphere(3.0),
        tm.simulate.Box(np.full(3, 4.0), 0.5),
        tm.simulate.Union([tm.simulate.Wedge(90.0, 0.5), tm.simulate.Cylinder(2.0), tm.simulate.Plane(translation=(0, 0, 9))]),
    ]
    found = []
    for body in bodies:
        stroke = stroke_to(simulator, body, np.array([0.0, 1.0, 18.0]), np.array([-0.3, 0.0, -0.95]), 1.0, friction=0.3)
        (press,) = simulator.presses(stroke, ["push"], frames=1)
        found += [press.vertices, torch.from_numpy(simulator.frame(press, stroke, np.random.default_rng(0)).image)]
    painted = tm.simulate.Renderer(sensor, pattern=Speckle(0.8), samples=1)
    return [*found, painted(sensor.membrane.rest), painted.depth(sensor.membrane.rest)]


def textured(paths):
    """A sensor with texture."""
    sensor = tm.Sensor.from_file(paths[0])
    image = torch.from_numpy(np.random.default_rng(0).random(sensor.image_size[::-1], np.float32))
    markers = tm.Markers("texture", rest_image=image.numpy())
    return [*tm.Reconstructor(replace(sensor, markers=markers), check_rest=False)(image.roll(1, 1))]


def of_two_views(paths):
    """A sensor with two views of the same membrane, whose markers stand on levers."""
    sensor = tm.Sensor.from_file(paths[0])
    views = [
        tm.View(name, sensor.camera, tm.ViewPose(np.eye(3), np.array([x, 0.0, 0.0]))) for name, x in (("a", 0.0), ("b", 1.0))
    ]
    both = tm.Reconstructor(replace(sensor, views=tuple(views)), check_rest=False)
    return [*both([np.asarray(Image.open(paths[1][2]))] * 2), *both.from_pixels(both.rest_pixels)]


def calibrated(paths):
    """A lens from views of a board."""
    board, true = tm.calibrate.Checkerboard(6, 5, 3.0), tm.Camera("pinhole", (320, 240), (150.0, 151.0), (161.0, 119.0))
    turns = np.array([[0.3, 0.0, 0.0], [0.0, 0.4, 0.2], [-0.3, 0.2, 0.0], [0.1, -0.4, 0.1]])
    points = torch.from_numpy(board.points - board.points.mean(0)) @ tm.calibrate.fit.rotations(torch.from_numpy(turns)).mT
    pixels = true.point_to_pixel(points + torch.from_numpy(np.array([0.0, 0.0, 22.0])))
    guess = tm.Camera("pinhole", (320, 240), (140.0, 140.0), (160.0, 120.0))
    return [*tm.calibrate.lens_from_views(guess, board, Views(pixels.numpy(), np.zeros(4, bool))).camera.buffers()]


WAYS = {
    **{name: lambda paths, name=name: answers(paths, estimator=name) for name in ("force-balance", "minimum-energy", "paper")},
    "soft": lambda paths: answers(paths, locator="soft"),
    "double": lambda paths: answers(paths, dtype=torch.float64),
    **{way.__name__: way for way in (tracked, of_presets, simulated, textured, of_two_views, calibrated)},
}


@pytest.mark.parametrize("way", WAYS)
def test_answers_are_the_same_to_the_last_digit(paths, way):
    expected = WAYS[way](paths)
    torch.set_default_device("meta")
    found = WAYS[way](paths)
    torch.set_default_device(None)
    for one, other in zip(found, expected, strict=True):
        assert one.dtype == other.dtype and torch.equal(one.nan_to_num(), other.nan_to_num())


def test_a_default_that_is_set_before_the_import_or_the_call_changes_nothing(paths):
    """The import in a new process; the reconstructor is built there before the default is set."""
    path, images = str(paths[0]), str(paths[1][2])
    script = (
        "import torch; torch.set_default_device('meta')\n"
        "import torchmembrane as tm\n"
        "torch.set_default_device(None)\n"
        f"made = tm.Reconstructor.from_file({path!r})\n"
        "torch.set_default_device('meta')\n"
        f"print(made(made.read({images!r})).force.tolist())"
    )
    said = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True)
    made = tm.Reconstructor.from_file(path)
    assert said.stdout.strip() == str(made(made.read(images)).force.tolist()), said.stderr


def test_the_command_computes_the_same(paths, tmp_path, capsys):
    """In the same process."""
    press = ["--indenter", "box", "--sides", "4,4,4", "--radius", "0.5", "--depth", "1"]

    def told(folder):
        for arguments in (["check", paths[0]], ["reconstruct", paths[0], paths[1][2], "--out", folder]):
            assert main([str(each) for each in arguments]) == 0, capsys.readouterr().err
        assert main(["simulate", str(paths[0]), "--out", str(folder / "simulated"), *press]) == 0, capsys.readouterr().err
        found, truth = tm.read_results(folder)["press2"], next((folder / "simulated").glob("*_truth.npz"))
        return [found["vertices"], found["force"], np.load(truth)["force"]]

    expected = told(tmp_path / "cpu")
    torch.set_default_device("meta")
    found = told(tmp_path / "meta")
    assert all(np.array_equal(one, other) for one, other in zip(found, expected, strict=True))


@pytest.mark.full
def test_the_exported_model_is_the_same(paths, tmp_path):
    expected = tm.export(tm.Reconstructor.from_file(paths[0]), tmp_path / "cpu.onnx")
    torch.set_default_device("meta")
    found = tm.export(tm.Reconstructor.from_file(paths[0]), tmp_path / "meta.onnx")
    assert found.SerializeToString(deterministic=True) == expected.SerializeToString(deterministic=True)
