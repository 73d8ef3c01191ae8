"""Slack sheets are solved in double precision everywhere."""

from dataclasses import replace

import numpy as np
import onnxruntime
import pytest
import torch
from onnx import TensorProto, numpy_helper
from test_dots import SIZE, batch, deform, measured, render, scene, slide

from torchmembrane.estimators.base import Observation
from torchmembrane.markers.dots import locator as module
from torchmembrane.markers.dots.locator import DotLocator, short
from torchmembrane.markers.dots.pyramid import mean_pyramid
from torchmembrane.markers.noise import pixel_noise
from torchmembrane.onnx.graph import Assembly, described
from torchmembrane.onnx.trace import traced_model
from torchmembrane.reconstruct import Reconstructor
from torchmembrane.sensor.sensor import Sensor


@pytest.fixture(scope="module")
def slack(small_sensor):
    sensor = Sensor.from_file(small_sensor / "sensor.toml")
    return replace(sensor, material=replace(sensor.material, prestretch=1.01))


def precisions(module):
    return {value.dtype for value in module.buffers() if value.is_floating_point()}


def test_a_slack_sheet_is_solved_in_double_precision(slack, small_sensor, small_images):
    made, firm = Reconstructor(slack), Reconstructor.from_file(small_sensor / "sensor.toml")
    assert precisions(made.estimator) == precisions(made.observer.locator.fit) == {torch.float64}
    assert precisions(firm) == {torch.float32}
    result = made(made.read(*small_images))
    assert {value.dtype for value in result if value.is_floating_point()} == {torch.float32}
    assert (result.status == 0).all()


def test_called_float_it_is_solved_in_single_precision(slack, small_images):
    """A flat plate's press moves by a tenth: with so little stretch, it has several solutions that are about as good."""
    made = Reconstructor(slack)
    expected = made(made.read(*small_images))
    single = made.float()
    assert precisions(single) == {torch.float32}
    result = single(single.read(*small_images))
    assert (result.status == 0).all() and result.vertices.dtype == torch.float32
    off = (result.vertices - expected.vertices).flatten(1).norm(dim=1) / expected.displacement.flatten(1).norm(dim=1)
    assert off.median() < 0.02 and off.max() < 0.15


def test_it_is_what_a_module_in_double_precision_finds(slack, small_images):
    single, double = Reconstructor(slack), Reconstructor(slack, dtype=torch.float64)
    found, expected = (made(made.read(*small_images)) for made in (single, double))
    assert (found.vertices - expected.vertices).norm(dim=-1).max() < 2e-5 * expected.displacement.norm(dim=-1).max()


def test_gradients_reach_the_images(slack, small_images):
    made = Reconstructor(slack)
    images = made.read(small_images[-1]).requires_grad_()
    made(images).force.sum().backward()
    assert images.grad.dtype == torch.float32 and images.grad.isfinite().all() and images.grad.abs().max() > 0


def nudged(locator, by):
    """What a locator makes of eight images in another runtime, which rounds otherwise before the fit and after it."""
    parts = [
        (locator.detect, "forward"),
        (locator.match, "gradient"),
        (locator.match, "predict"),
        (locator.match.neighbour_steps, "forward"),
    ]
    s = scene()
    images = torch.cat([batch(render(*deform(s, slide, tenths / 10))) for tenths in range(1, 9)])
    with pytest.MonkeyPatch.context() as patch:
        for owner, name in parts if by else ():
            patch.setattr(owner, name, rounded_otherwise(getattr(owner, name), by))
        if by:
            patch.setattr(module, "pixel_noise", rounded_otherwise(pixel_noise, by))
            patch.setattr(module, "mean_pyramid", lambda image: [level.float() for level in mean_pyramid(image.double())])
        return locator(images)


def rounded_otherwise(function, by):
    def called(*given):
        found = function(*given)
        return [value * (1 + by) for value in found] if isinstance(found, tuple) else found * (1 + by)

    return called


def test_an_exact_locator_tells_the_same_whatever_the_rounding_before_its_fit():
    s = scene()
    locator = DotLocator(measured(s), SIZE, "dark", s.rim)
    found = [nudged(locator, by) for by in (0.0, 1e-7)]
    locator.be_exact()
    exact = [nudged(locator, by) for by in (0.0, 1e-7)]
    apart = [max(float((a - b).abs().max()) for a, b in zip(*pair, strict=True)) for pair in (found, exact)]
    assert apart[0] > 1e-7 and apart[1] == 0
    assert exact[0].pixels.dtype == torch.float64 and float((exact[0].pixels - found[0].pixels).abs().max()) < 0.01


def test_means_of_a_short_image_do_not_depend_on_their_order():
    image = torch.rand(1, 1, 64, 64, generator=torch.Generator().manual_seed(0))
    assert float((short(image) - image).abs().max()) <= 2.0**-21
    for values, same in ((short(image), True), (image, False)):
        four = values.unflatten(-1, (-1, 4)).unflatten(-3, (-1, 4)).permute(0, 1, 2, 4, 3, 5).flatten(-2)
        sums = [sum(four[..., k] for k in order) for order in (range(16), range(15, -1, -1))]
        assert torch.equal(*sums) == same


class Formula(torch.nn.Module):
    def __init__(self, formula):
        super().__init__()
        self.formula = formula

    def forward(self, x):
        return (self.formula(x),)


@pytest.mark.parametrize(
    "formula",
    [
        lambda x: 0.4 * x,
        lambda x: x + 0.4,
        lambda x: 0.4 - x,
        lambda x: 0.4 / x,
        lambda x: x.clamp(0.3, 0.4),
        lambda x: x**1.4,
        lambda x: 0.4**x,
        lambda x: torch.where(x > 0.3, x, 0.4),
        lambda x: x.masked_fill(x > 0.3, 0.4),
        lambda x: torch.full_like(x, 0.4) + x,
        lambda x: x.new_full(x.shape[1:], 0.4) + x,
        lambda x: torch.full(x.shape[1:], 0.4, dtype=torch.float64) + x,
    ],
)
def test_numbers_are_exported_in_double_precision(formula):
    """Torch's own exporter rounds them to single."""
    x = torch.rand(2, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0)) + 0.1
    model = traced_model(Formula(formula), {"x": x}, ["y"])
    (found,) = onnxruntime.InferenceSession(model.SerializeToString()).run(None, {"x": x.numpy()})
    np.testing.assert_allclose(found, formula(x), rtol=1e-15)


@pytest.mark.parametrize("single, share", [(True, 0.55), (False, 1.1)])
@pytest.mark.parametrize("zeros", [False, True])
def test_constants_in_double_precision_take_half_where_single_holds_them(single, share, zeros):
    array = np.random.default_rng(0).random((100, 90)) + 1
    array = array.astype(np.float32).astype(float) if single else array
    array[:, 3:] *= 1 - zeros
    assembly = Assembly()
    name = assembly.constant(array)
    stored = sum(len(tensor.raw_data) for tensor in assembly.constants.values())
    assert stored < share * np.count_nonzero(array) * (8 + 2 * zeros) + 100
    assert single or all(numpy_helper.to_array(each).dtype != np.float32 for each in assembly.constants.values())
    assembly.named(name, "y")
    model = assembly.model([], [described("y", TensorProto.DOUBLE, array.shape)], {})
    (found,) = onnxruntime.InferenceSession(model.SerializeToString()).run(None, {})
    np.testing.assert_array_equal(found, array)


def test_markers_from_elsewhere_come_in_single_precision(slack, small_images):
    made = Reconstructor(slack)
    result = made(made.read(small_images[-1]))
    found = made.from_pixels(result.pixels, result.confidence)
    expected = Reconstructor(slack, dtype=torch.float64).from_pixels(result.pixels.double(), result.confidence.double())
    assert (found.vertices - expected.vertices).norm(dim=-1).max() < 0.01 * result.displacement.norm(dim=-1).max()
    directions = torch.nn.functional.normalize(made.rest_markers, dim=-1)[None]
    sure = torch.ones_like(directions[..., 0])
    observation = Observation(torch.zeros_like(directions), directions, sure)
    measured = made.estimator.equations.bearings.measured(observation)
    assert {value.dtype for value in measured if value is not None} == {torch.float64}
    assert made.estimator(observation).vertices.isfinite().all()
    deviations = made.standard_deviations(result)
    assert deviations.force.isfinite().all() and deviations.vertices.isfinite().all()
