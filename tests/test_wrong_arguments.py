"""A wrong argument raises a `MembraneError` that names it."""

import warnings
from functools import partial

import numpy as np
import pytest
import torch
from PIL import Image

import torchmembrane as tm
from torchmembrane import calibrate, simulate
from torchmembrane.errors import check_arguments
from torchmembrane.surface.shapes import spherical_cap

WRONG = {
    **{"None": None, "text": "x", "no items": [], "an object": object(), "a dict": {}, "bytes": b"a", "complex": 1j},
    **{"list of None": [None], "list of text": ["a"], "five axes": np.zeros((2, 2, 2, 2, 2)), "array of text": np.array("a")},
    **{"too large": 10**400, "a scalar tensor": torch.tensor(1.0), "not a number": float("nan"), "infinite": float("inf")},
}
NOTHING = ("an object", "complex")
"""Of these: what no argument may be."""


@pytest.fixture(scope="module")
def parts(small_sensor, small_images):
    """A sensor, its reconstructor, an image of it and a result."""
    sensor = tm.Sensor.from_file(small_sensor / "sensor.toml")
    made = tm.Reconstructor(sensor)
    image = np.array(Image.open(small_images[2]))
    with torch.no_grad():
        return sensor, made, image, made(image)


def calls(sensor, made, image, result):
    """Functions and right arguments, as far as it matters that they are right."""
    dots, mesh = sensor.markers.positions, sensor.membrane.rest.reshape(9, 9, 3)
    board = calibrate.DotBoard(9, 7, 2.0)
    lens = dict(model="pinhole", image_size=(160, 120), focal=(100, 100), centre=(79, 60), distortion=[], ports=[])
    names = dict(name="cap", length_unit="mm", camera=sensor.camera, membrane=sensor.membrane, material=sensor.material)
    return {
        "Camera": (tm.Camera, lens | {"medium_index": 1.33}),
        "Camera.in_mode": (sensor.camera.in_mode, dict(crop=(0, 0, 80, 80), binning=2)),
        "Camera.pixel_to_ray": (sensor.camera.pixel_to_ray, dict(pixels=torch.zeros(2, 2))),
        "Camera.point_to_pixel": (sensor.camera.point_to_pixel, dict(points=torch.ones(2, 3))),
        "Cavity": (tm.Cavity, dict(filling="gas", pressure=1013.0)),
        "Markers": (tm.Markers, dict(kind="dots", polarity="dark", positions=dots, height=1.0)),
        "Material": (tm.Material, dict(model="neo_hookean", prestretch=1.3, shear_modulus=0.3)),
        "Membrane": (tm.Membrane, dict(vertices=mesh.numpy())),
        "Membrane.resampled": (sensor.membrane.resampled, dict(grid=(9, 9))),
        "Pose": (tm.Pose, dict(rotation=np.zeros(3), translation=np.zeros(3))),
        "Pose.points": (tm.Pose(np.zeros(3), np.zeros(3)).points, dict(points=np.zeros(3))),
        "Pose.wrench": (tm.Pose(np.zeros(3), np.zeros(3)).wrench, dict(wrench=np.zeros(6))),
        "Sensor": (tm.Sensor, names | dict(cavity=sensor.cavity, markers=sensor.markers)),
        "Sensor.from_file": (tm.Sensor.from_file, dict(path="sensor.toml")),
        "Surface": (tm.Surface, dict(shape="spherical_cap", values={"rim_radius": 8.0, "height": 4.0, "base_z": 14.0})),
        "Surface.membrane": (sensor.surface.membrane, dict(grid=(9, 9))),
        "spherical_cap": (spherical_cap, dict(rim_radius=8.0, height=4.0, base_z=14.0)),
        "Reconstructor": (tm.Reconstructor, dict(sensor=sensor, channels="rgb", dtype=torch.float32, check_rest=True)),
        "Reconstructor.from_file": (tm.Reconstructor.from_file, dict(path="sensor.toml")),
        "read": (made.read, {"*": "press.png"}),
        "forward": (made, dict(images=image)),
        "grey": (made.grey, dict(images=image)),
        "from_pixels": (made.from_pixels, dict(pixels=result.pixels)),
        "standard_deviations": (made.standard_deviations, dict(result=result)),
        "Tracker": (tm.Tracker, dict(reconstructor=made)),
        "Tracker.rezero": (tm.Tracker(made).rezero, dict(frame=image)),
        "frame": (result.frame, dict(index=0)),
        "wrench_in": (result.wrench_in, dict(pose=tm.Pose(np.zeros(3), np.zeros(3)))),
        "indentation": (result.indentation, dict(rest=sensor.membrane)),
        "preset": (tm.preset, dict(name="bubble")),
        "read_results": (tm.read_results, dict(folder="results")),
        "export": (partial(tm.export, path="none/model.onnx"), dict(reconstructor=made)),
        "Sphere": (simulate.Sphere, dict(radius=1.0, translation=(0, 0, 1.0))),
        "Box": (simulate.Box, dict(sides=(1.0, 1.0, 1.0), radius=0.1)),
        "facing": (simulate.facing, dict(direction=(0, 0, 1.0))),
        "moved": (simulate.Sphere(1.0).moved, dict(offset=(0, 0, 1.0))),
        "touching": (simulate.Sphere(1.0).touching, dict(membrane=sensor.membrane, direction=(0, 0, -1.0))),
        "Appearance": (simulate.Appearance, dict(exposure=0.7, blur=0.5)),
        "Speckle": (simulate.Speckle, dict(size=1.0)),
        "Dots.of": (simulate.Dots.of, dict(sensor=sensor, missing=[0])),
        "Simulator": (simulate.Simulator, dict(sensor=sensor, missing=[0])),
        "DotBoard": (calibrate.DotBoard, dict(columns=9, rows=7, pitch=2.0)),
        "find_target": (calibrate.find_target, dict(image=image / 255, board=board)),
        "pixel_lattice": (calibrate.pixel_lattice, dict(sensor=sensor, pitch=20.0)),
        "layout_for_pixels": (calibrate.layout_for_pixels, dict(sensor=sensor, pixels=[[80.0, 60.0]], sizes=["small"])),
        "material_from_pixels": (calibrate.material_from_pixels, dict(sensor=sensor, pixels=result.pixels)),
        "rest_from_image": (calibrate.rest_from_image, dict(sensor=sensor, image=image / 255)),
        "rest_from_depth": (calibrate.rest_from_depth, dict(sensor=sensor, depth=image / 255, image=image / 255)),
    }


def outcome(function, right, key, wrong):
    """What a call with one wrong argument raises, if it does."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            function(wrong) if key == "*" else function(**right | {key: wrong})
        except Exception as error:
            return error
    return None


@pytest.mark.parametrize("kind", WRONG)
def test_a_wrong_argument_ends_in_no_other_error(parts, kind, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for name, (function, right) in calls(*parts).items():
        for key in right:
            error = outcome(function, right, key, WRONG[kind])
            assert error is None or isinstance(error, tm.MembraneError), (name, key, error)


@pytest.mark.parametrize("kind", NOTHING)
def test_what_no_argument_may_be_is_refused_in_words(parts, kind):
    for name, (function, right) in calls(*parts).items():
        for key in right:
            error = outcome(function, right, key, WRONG[kind])
            assert isinstance(error, tm.MembraneError) and "expected" in str(error), (name, key, error)


@pytest.mark.parametrize(
    "time, said",
    [
        *[
            (time, "Tracker: time is .*; expected seconds of any clock, a finite number")
            for time in ("x", [], np.inf, -np.inf, np.nan, 1j)
        ],
        (1.0, "a frame of time 1.0 after one of 1.0"),
        (0.5, "a frame of time 0.5 after one of 1.0"),
    ],
)
def test_a_time_that_is_refused_leaves_the_stream_as_it_was(parts, time, said):
    _, made, image, _ = parts
    tracker = tm.Tracker(made)
    tracker(image, time=1.0)
    with pytest.raises(tm.MembraneError, match=said):
        tracker(image, time=time)
    assert tracker.time == 1.0
    tracker(image, time=np.float32(1.5))


@pytest.mark.parametrize("pressure", ["x", [None], {}, 1j, torch.ones(2), np.inf])
def test_a_pressure_that_is_none_is_refused_and_the_time_of_the_frame_not_taken(parts, pressure):
    _, made, image, _ = parts
    tracker = tm.Tracker(made)
    with pytest.raises(tm.MembraneError, match="pressure.*expected"):
        tracker(image, pressure=pressure, time=1.0)
    assert tracker.time is None
    tracker(image, pressure=0.01, time=1.0)


@pytest.mark.parametrize("pressure", [0.01, np.float32(0.01), np.array(0.01), [0.01], torch.tensor([0.01])])
def test_a_pressure_may_be_any_number(parts, pressure):
    _, made, image, _ = parts
    expected = made(image, pressure=torch.tensor(0.01))
    torch.testing.assert_close(made(image, pressure=pressure).pressure, expected.pressure)


@pytest.mark.parametrize(
    "call, said",
    [
        (lambda made, image: made.read(), "Reconstructor.read: paths is ..; expected one image file or more"),
        (
            lambda made, image: made.read(["a.png", "b.png"]),
            "Reconstructor.read: paths is .'a.png', 'b.png'.; expected text or a path",
        ),
        (lambda made, image: made(torch.tensor(1.0)), r"images \[\]; expected \[H, W\].*give an image's array"),
        (lambda made, image: made(image, rest_pixels=torch.zeros(7, 2)), r"rest_pixels of shape \[7, 2\]; expected \[49, 2\]"),
        (lambda made, image: made(image, previous=image), "previous has no pixels, it is a ndarray"),
        (lambda made, image: made(image[:, :-1]), "the image is 159 x 120 px, expected 160 x 120"),
        (lambda made, image: made(image[None, None].repeat(4, 1)), "without alpha"),
        (lambda made, image: made(image).frame(1), "Reconstruction.frame: index is 1; expected the number of one of 1 frames"),
        (lambda made, image: made(image).to("gpu"), "Reconstruction.to: 'gpu'; expected an existing device, such as 'cpu',"),
        (lambda made, image: tm.Reconstructor("sensor.toml"), "Reconstructor: sensor is 'sensor.toml'; expected a Sensor"),
        (lambda made, image: tm.Tracker("sensor.toml"), "Tracker: reconstructor is a str; expected a tm.Reconstructor"),
    ],
)
def test_frequent_mistakes_are_answered_in_words(parts, call, said):
    with pytest.raises(tm.MembraneError, match=said):
        call(*parts[1:3])


def test_three_planes_without_a_batch_are_not_taken_for_three_frames_without_a_word(parts):
    _, made, image, _ = parts
    planes = np.stack([image] * 3)
    with pytest.warns(UserWarning, match=r"taken for three grey frames.*give image\[None\]") as said:
        assert len(made.grey(planes)) == len(made(planes).status) == 3
    assert {warning.filename for warning in said} == {__file__}  # the line of the caller
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert len(made.grey(planes[None])) == 1 and len(made.grey(planes[:, None])) == 3
        assert len(made.grey(np.stack([image] * 4))) == 4 and len(made.grey(planes[:2])) == 2


def test_arrays_that_cannot_be_written_to_are_taken_without_a_word(parts):
    _, made, image, _ = parts
    image.flags.writeable = False
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        made.grey(image)
    image.flags.writeable = True


def test_whole_numbers_are_turned_as_others_are():
    quarter = tm.Pose([0.0, 0.0, 45.0], [0.5, 0.0, 0.0])
    expected = quarter.points(np.array([1.0, 2.0, 3.0]))
    np.testing.assert_allclose(quarter.points(np.array([1, 2, 3])), expected)
    torch.testing.assert_close(quarter.points(torch.tensor([1, 2, 3])), torch.from_numpy(expected))


def test_arguments_are_compared_with_every_kind_of_annotation():
    @check_arguments
    def told(
        a: float,
        b: int = 0,
        *more: str,
        c: list[float] | None = None,
        d: tuple[int, str] = (0, ""),
        e: dict[str, int] | None = None,
    ):
        return a

    assert told(1) == 1 and told(np.float32(1)) == 1 and told(a=torch.tensor(2.0)) == 2.0 and told(np.array(3.0)) == 3.0
    assert told(1, np.int64(2), "x", c=np.ones(3), d=[1, "x"], e={"a": 1}) == 1 and told(1, 2.0, c=(1, 2)) == 1
    for arguments, options, said in (
        (("1",), {}, "a is '1'; expected a number"),
        ((np.ones(2),), {}, r"a is ndarray \[2\] of float64; expected a number"),
        ((1, 1.5), {}, "b is 1.5; expected a whole number"),
        ((1, 1, 2), {}, "more is 2; expected text"),
        ((1,), {"c": [1, "a"]}, "c is .1, 'a'.; expected a list of numbers or None"),
        ((1,), {"c": "12"}, "c is '12'; expected a list of numbers or None"),
        ((1,), {"d": (1,)}, "d is .1,.; expected 2 values, a whole number, text"),
        ((1,), {"e": [1]}, "e is .1.; expected a dict or None"),
    ):
        with pytest.raises(tm.MembraneError, match=said):
            told(*arguments, **options)
    with pytest.raises(TypeError, match="unexpected keyword argument 'f'"):
        told(1, f=2)
