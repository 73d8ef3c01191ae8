"""The public face takes images and streams, and names mistakes."""

import warnings
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

import torchmembrane as tm
from torchmembrane.estimators.force_balance.settings import OLD_NAMES

EXAMPLES = Path(__file__).parents[1] / "examples"
NAMES = ("press_on_axis", "two_contacts", "flat_plate")
BATCHED = 1e-3  # mm, that a frame alone may be off the same frame in a batch (docs/jobs.md)


@pytest.fixture(scope="module")
def photographs():
    """Grey, as a camera of 8 bits gives it, `[3, H, W]`."""
    return np.stack([np.asarray(Image.open(EXAMPLES / f"{name}.png").convert("L")) for name in NAMES])


@pytest.fixture(scope="module")
def result(reconstructor, photographs):
    with torch.no_grad():
        return reconstructor(photographs)


def test_every_name_is_there_and_no_other_is():
    assert all(getattr(tm, name) is not None for name in tm.__all__) and set(tm.__all__) <= set(dir(tm))
    with pytest.raises(AttributeError, match="no attribute 'Reconstruktor'"):
        tm.Reconstruktor  # noqa: B018


def as_given(grey: np.ndarray) -> dict:
    """The same three frames, or the first one, in every accepted form."""
    tensor, colour = torch.from_numpy(grey.copy()), np.repeat(grey[..., None], 3, -1)
    return {
        "[H, W]": grey[0],
        "[H, W] flipped, of negative strides": np.flip(np.flip(grey[0])),
        "[H, W, 3]": colour[0],
        "[B, H, W]": grey,
        "[B, 1, H, W]": tensor[:, None],
        "[B, 3, H, W]": tensor[:, None].expand(-1, 3, -1, -1),
        "[B, H, W, 1]": grey[..., None],
        "[B, H, W, 3]": colour,
        "float32": tensor / 255.0,
        "float64": grey / 255.0,
        "uint16": (grey.astype(np.uint16) * 257),
        "big-endian uint16": (grey.astype(np.uint16) * 257).astype(">u2"),
    }


@pytest.mark.parametrize("form", list(as_given(np.zeros((1, 2, 2), np.uint8))))
def test_images_are_taken_as_cameras_give_them(reconstructor, photographs, result, form):
    images = as_given(photographs)[form]
    with torch.no_grad():
        got = reconstructor.observer(reconstructor.grey(images))
        expected = reconstructor.observer(reconstructor.grey(photographs[: len(got.status)]))
    torch.testing.assert_close(got.displacement, expected.displacement, rtol=0, atol=1e-3)
    assert got.status.tolist() == expected.status.tolist()


@pytest.mark.parametrize(("channels", "weights"), [("rgb", (0.299, 0.587, 0.114)), ("bgr", (0.114, 0.587, 0.299))])
def test_the_order_of_channels_is_said_once(sensor, channels, weights):
    made = tm.Reconstructor(sensor, channels=channels)
    width, height = sensor.camera.image_size
    for c, weight in enumerate(weights):
        image = np.zeros((height, width, 3), np.uint8)
        image[..., c] = 255
        torch.testing.assert_close(made.grey(image)[0, 0, 0, 0], torch.tensor(weight))


@pytest.mark.parametrize(
    ("shape", "said"),
    [
        ((640, 480), "rows and columns are exchanged"),
        ((640, 480, 3), "rows and columns are exchanged"),
        ((2, 3, 640, 480), "rows and columns are exchanged"),
        ((480, 640, 4), "without alpha"),
        ((2, 2, 480, 640), "one or three channels"),
        ((240, 320), "320 x 240 px, expected 640 x 480"),
        ((1, 240, 320, 3), "320 x 240 px, expected 640 x 480"),
        ((480,), "expected"),
        ((1, 1, 1, 480, 640), "expected"),
    ],
)
def test_other_shapes_are_refused_in_words(reconstructor, shape, said):
    with pytest.raises(tm.MembraneError, match=said):
        reconstructor(np.zeros(shape, np.uint8))


@pytest.mark.parametrize("dtype", [np.int64, np.complex64, bool, object])
def test_other_types_are_refused_in_words(reconstructor, dtype):
    with pytest.raises(tm.MembraneError, match="expected uint8, uint16, or float"):
        reconstructor(np.zeros((480, 640), dtype))


def test_wrong_words_are_refused(sensor):
    for wrong, said in (
        (dict(estimator="guess"), "expected one of force-balance, minimum-energy"),
        (dict(channels="gbr"), "expected 'rgb' or 'bgr'"),
        (dict(dtype=torch.float16), "expected torch.float32 or torch.float64"),
        (dict(settings=tm.MinimumEnergySettings()), "expected ForceBalanceSettings for force-balance"),
    ):
        with pytest.raises(tm.MembraneError, match=said):
            tm.Reconstructor(sensor, **wrong)
    with pytest.raises(tm.MembraneError, match="expected one of"):
        tm.PaperSettings(flow="cubic")
    with pytest.raises(tm.MembraneError, match="steps = 8; expected three numbers of at least 2"):
        tm.ForceBalanceSettings(steps=8)


def test_half_precision_images_are_taken_and_half_precision_modules_are_not(sensor, photographs, result):
    """Alone or in a model; what is refused changes nothing, because no later `.float()` could undo it."""
    made = tm.Reconstructor(sensor)
    model = torch.nn.ModuleDict({"eye": made, "head": torch.nn.Linear(6, 1)})
    images, refused = torch.from_numpy(photographs / 255.0), "convert the other parts of a model only"
    with torch.no_grad():
        got, expected = made(images.half()), made(images)
        for convert in (
            made.half,
            made.bfloat16,
            model.half,
            lambda: model.to("cpu", torch.bfloat16),
            lambda: made.type(torch.half),
        ):
            with pytest.raises(tm.MembraneError, match=refused):
                convert()
        for one, other in zip(made.float()(images), expected, strict=True):
            assert torch.equal(one.nan_to_num(), other.nan_to_num())
    assert (got.vertices - result.vertices).abs().max() < 0.02
    made.observer.half()
    for call in (lambda: made(images), lambda: made.from_pixels(made.rest_pixels)):
        with pytest.raises(tm.MembraneError, match=refused):
            call()


@pytest.mark.parametrize("estimator", ["force-balance", "minimum-energy"])
def test_autocast_changes_nothing(sensor, photographs, estimator):
    made = tm.Reconstructor(sensor, estimator)
    with torch.no_grad():
        pixels = made(photographs[:1]).pixels
        expected = made(photographs[:1]), made.from_pixels(pixels)
        with torch.autocast("cpu", torch.bfloat16):
            got = made(photographs[:1]), made.from_pixels(pixels)
    for one, other in zip(got, expected, strict=True):
        for field, value in other._asdict().items():
            torch.testing.assert_close(one._asdict()[field], value, equal_nan=True)


def test_autocast_changes_neither_what_is_built_nor_what_else_is_told(sensor, photographs):
    """Constants, a changed prestretch, the markers at rest, and standard deviations."""

    def told():
        made, other = tm.Reconstructor(sensor), tm.Reconstructor(sensor, locator="soft")
        result, rest = made(photographs[:1]), made.observer.rest_of(made.grey(photographs[:1]))
        deviations = made.standard_deviations(result)
        made.estimator.set_prestretch(torch.tensor(1.2))
        rendered = tm.simulate.Renderer(sensor, samples=1)
        images = rendered(sensor.membrane.rest), rendered.depth(sensor.membrane.rest)
        return [*made.buffers(), *other.buffers(), *rest, *made.observer.locate(made.grey(photographs)), *deviations, *images]

    with torch.no_grad():
        expected = told()
        with torch.autocast("cpu", torch.bfloat16):
            found = told()
    for one, other in zip(found, expected, strict=True):
        assert one.dtype == other.dtype and torch.equal(one.nan_to_num(), other.nan_to_num())


@pytest.mark.parametrize("locator", ["fit", "soft"])
def test_a_gradient_that_is_taken_within_autocast_is_one_of_few_digits(sensor, photographs, locator):
    """torch's own operations compute it in half precision then; the adjoint system is solved in the module's."""
    made, slopes = tm.Reconstructor(sensor, locator=locator), []
    for enabled in (False, True):
        image = made.grey(photographs[:1]).requires_grad_()
        with torch.autocast("cpu", torch.bfloat16, enabled=enabled):
            made(image).displacement.square().sum().backward()
        slopes.append(image.grad)
    assert slopes[0].abs().max() > 0
    assert (slopes[1] - slopes[0]).norm() < 0.03 * slopes[0].norm()


@pytest.mark.parametrize("estimator", ["force-balance", "minimum-energy"])
def test_an_empty_batch_gives_an_empty_result(sensor, estimator):
    made = tm.Reconstructor(sensor, estimator)
    for got in (made(np.zeros((0, 480, 640), np.uint8)), made.from_pixels(torch.zeros(0, 121, 2))):
        shapes = [tuple(field.shape) for field in got]
        assert all(shape[0] == 0 for shape in shapes) and shapes[0] == (0, 81, 3) and got.status.dtype == torch.int32


@pytest.mark.parametrize("estimator", ["force-balance", "minimum-energy"])
def test_an_empty_batch_gives_empty_gradients(sensor, estimator):
    made = tm.Reconstructor(sensor, estimator)
    images, pixels = (torch.zeros(0, *shape, requires_grad=True) for shape in ((1, 480, 640), (121, 2)))
    (made(images).force.sum() + made.from_pixels(pixels).force.sum()).backward()
    assert images.grad.shape == images.shape and pixels.grad.shape == pixels.shape


def test_confidence_outside_its_range_is_refused(reconstructor):
    pixels = reconstructor.rest_pixels
    for wrong in (1.5, -0.1, torch.nan):
        confidence = torch.ones(len(pixels))
        confidence[7] = wrong
        with pytest.raises(tm.MembraneError, match="confidence outside 0..1"):
            reconstructor.from_pixels(pixels, confidence)
    with pytest.raises(tm.MembraneError, match=r"confidence \[7\]; expected \[1, 121\]"):
        reconstructor.from_pixels(pixels, torch.ones(7))
    with pytest.raises(tm.MembraneError, match="rest_pixels"):
        reconstructor.from_pixels(pixels, rest_pixels=pixels[:7])


def test_a_previous_of_other_frames_is_refused_in_words(reconstructor, photographs, result):
    with pytest.raises(tm.MembraneError, match="an earlier result for each image"):
        reconstructor(photographs[:2], result)
    failed = result._replace(vertices=result.vertices * torch.nan, pixels=result.pixels * torch.nan)
    with torch.no_grad():
        assert (reconstructor(photographs, failed.to(torch.float64)).status >= 0).all()  # NaN: from rest


def test_a_result_moves_and_keeps_its_meaning(result):
    double = result.to(torch.float64)
    assert double.vertices.dtype == torch.float64 and double.status.dtype == torch.int32
    assert isinstance(double, tm.Reconstruction) and len(result) == 26 and result[0] is result.vertices
    arrays = result.cpu().numpy()
    assert all(isinstance(array, np.ndarray) for array in arrays) and arrays.status.dtype == np.int32
    frame = result.frame(1)
    assert frame.keys() == result._asdict().keys()
    np.testing.assert_array_equal(frame["vertices"], arrays.vertices[1])


def test_a_status_is_its_number_and_says_its_text(result):
    assert [int(status) for status in tm.Status] == list(range(11)) and tm.Status(3) == 3
    assert all(tm.Status(int(code)) is tm.Status.OK for code in result.status)
    assert tm.Status.NOT_CONVERGED.has_surface and not tm.Status.BAD_VALUES.has_surface
    assert len({status.text for status in tm.Status}) == 11


def test_a_tracker_gives_what_frames_with_their_previous_give(reconstructor, photographs, result):
    tracker = tm.Tracker(reconstructor)
    first, second = tracker(photographs[0]), tracker(photographs[1])
    torch.testing.assert_close(first.vertices, result.vertices[:1], rtol=0, atol=BATCHED)
    with torch.no_grad():
        expected = reconstructor(photographs[1], first)
    torch.testing.assert_close(second.vertices, expected.vertices)
    dark = tracker(np.zeros((480, 640), np.uint8))
    assert dark.status.tolist() == [tm.Status.BLANK]
    again = tracker(photographs[1])  # from rest again
    torch.testing.assert_close(again.vertices, result.vertices[1:2], rtol=0, atol=BATCHED)
    tracker.reset()
    torch.testing.assert_close(tracker(photographs[0]).vertices, first.vertices)
    with pytest.raises(tm.MembraneError, match="2 frames; expected one"):
        tracker(photographs[:2])


def test_a_tracker_takes_one_image_of_every_layout(reconstructor, photographs):
    """Grey and colour, channels first or last, with or without a batch of one: three planes are colours, never three frames."""
    colour = np.stack([photographs[0], photographs[1], photographs[0]], -1)
    for image in (photographs[0][..., None], colour):
        layouts = image, image[None], np.moveaxis(image, -1, 0), np.moveaxis(image, -1, 0)[None]
        seen = [tm.Tracker(reconstructor)(layout).pixels for layout in layouts]
        for pixels in seen[1:]:
            torch.testing.assert_close(pixels, seen[0], rtol=0, atol=0, equal_nan=True)
    assert seen[0].isfinite().any()


def test_rezero_in_a_press_warns_with_its_force(sensor):
    """Taken for rest all the same: a drift may look like a contact. In a frame without contact nothing is said."""
    made = tm.Reconstructor(sensor)
    rest, press = made.read(EXAMPLES / "rest.png", EXAMPLES / "press_on_axis.png").split(1)
    tracker = tm.Tracker(made)
    force = float(tracker(press).force.norm())
    for frame in (None, press):
        with pytest.warns(
            UserWarning, match=rf"Tracker.rezero: a contact of {force:.3g} N is found .* reads as none from now on"
        ):
            tracker.rezero(frame)
        assert not tracker(press).contact_points.isfinite().any()
        tracker.reset()
        tracker(press)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        tracker.rezero(rest)
        tracker(rest)
        tracker.rezero()


def test_rezero_nulls_what_has_drifted_since_the_rest_image(sensor):
    """Half of the image two pixels to the right: as seen, a press; after taking such a frame for rest, none."""
    made = tm.Reconstructor(sensor)
    rest = np.asarray(Image.open(EXAMPLES / "rest.png").convert("L"))
    drifted = np.concatenate([rest[:240], np.roll(rest[240:], 2, axis=1)])
    tracker = tm.Tracker(made)
    with pytest.raises(tm.MembraneError, match="no frame yet"):
        tracker.rezero()
    before = tracker(drifted)
    tracker.rezero()
    after = tracker(drifted)
    assert before.displacement.abs().max() > 0.05
    assert after.displacement.abs().max() < 1e-3 and after.residual.max() < 0.02
    with pytest.raises(tm.MembraneError, match="expected a frame without contact"):
        tracker.rezero(np.zeros((480, 640), np.uint8))


def test_names_before_this_version_are_accepted():
    old, new = dict(settled_step=1e-6, unexplained_of_press=3.0), dict(settled_step_tol=1e-6, unexplained_per_displacement=3.0)
    assert tm.ForceBalanceSettings(**old) == tm.ForceBalanceSettings(**new) != tm.ForceBalanceSettings()
    assert replace(tm.ForceBalanceSettings(**new), settled_step=1e-5).settled_step_tol == 1e-5
    assert set(OLD_NAMES.values()) < {field.name for field in fields(tm.ForceBalanceSettings)}
    membrane = tm.preset("fingertip").membrane
    assert torch.equal(tm.Surface.of(membrane).membrane(membrane.grid).rest, membrane.rest)
    assert tm.ElasticEnergy(membrane, prestretch=1.5).on(membrane).prestretch == 1.5
    assert len(tm.simulate.Dots.of(tm.preset("fingertip")).positions) == 119
