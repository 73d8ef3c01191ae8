"""The reconstruction compiles to one graph with the same results."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch

from torchmembrane.estimators.force_balance.gauss_newton import GaussNewton
from torchmembrane.estimators.force_balance.settings import ForceBalanceSettings
from torchmembrane.estimators.minimum_energy.estimator import MinimumEnergySettings
from torchmembrane.machine_code import using
from torchmembrane.reconstruct import Reconstructor
from torchmembrane.sensor.sensor import Sensor

EXAMPLES = Path(__file__).parents[1] / "examples"
FEW = ForceBalanceSettings(steps=2, settling_steps=1, retry_steps_factor=2, retry_acceptance_ratio=1e9)
"""Steps take long to compile; after so few the first try has not settled, and the second is taken, whatever its objective."""


def test_the_second_try_is_taken_in_what_is_compiled_here(monkeypatch):
    sensor, asked = Sensor.from_file(EXAMPLES / "sensor.toml"), []
    small = replace(sensor, membrane=sensor.membrane.resampled((9, 9)))
    reconstructor = Reconstructor(small, dtype=torch.float64, settings=FEW)
    again = reconstructor.estimator._retry
    monkeypatch.setattr(reconstructor.estimator, "_retry", lambda *given: asked.append(1) or again(*given))
    with torch.no_grad():
        second = reconstructor(reconstructor.read(EXAMPLES / "two_contacts.png"))
        monkeypatch.setattr(reconstructor.estimator, "chosen", lambda done, values, others: values)
        first = reconstructor(reconstructor.read(EXAMPLES / "two_contacts.png"))
    assert asked == [1, 1] and (first.vertices - second.vertices).abs().max() > 1e-3


@pytest.fixture(params=[pytest.param("all steps", marks=pytest.mark.full), "few steps"])
def settings(request):
    """Of each estimator, by name."""
    few = {"force-balance": FEW, "minimum-energy": MinimumEnergySettings(steps=3)}
    return few if request.param == "few steps" else dict.fromkeys(few)


def example(estimator="force-balance", settings=None):
    sensor = Sensor.from_file(EXAMPLES / "sensor.toml")
    coarse = replace(sensor, membrane=sensor.membrane.resampled((9, 9)))
    return Reconstructor(coarse, estimator, settings=settings, dtype=torch.float64)


WAYS = {
    "from rest": lambda reconstructor, images, start, **gauge: reconstructor(images, **gauge),
    "from a start": lambda reconstructor, images, start, **gauge: reconstructor(images, start, **gauge),
    "from markers": lambda reconstructor, images, start, **gauge: reconstructor.from_pixels(start.pixels, **gauge),
}
QUICK = {("force-balance", "from markers"), ("minimum-energy", "from a start")}
"""From a start dots are searched for as well, where a graph cannot know that they are followed."""


@pytest.mark.parametrize(
    "estimator, way",
    [
        pytest.param(estimator, way, marks=[] if (estimator, way) in QUICK else pytest.mark.full)
        for estimator in ("force-balance", "minimum-energy")
        for way in WAYS
    ],
)
def test_the_compiled_reconstruction_is_one_graph_and_agrees(estimator, way, settings):
    """In double precision: eagerly the steps are taken by machine code, compiled ones are tensor operations."""
    reconstructor = example(estimator, settings[estimator])
    images = reconstructor.read(EXAMPLES / "two_contacts.png")
    with torch.no_grad():
        start = reconstructor(images)
        gauge = {"pressure": 1.1 * start.pressure} if reconstructor.finds_tractions else {}
        expected = WAYS[way](reconstructor, images, start, **gauge)
        compiled = torch.compile(WAYS[way], fullgraph=True, backend="eager")
        got = compiled(reconstructor, images, start, **gauge)
    assert expected.displacement.norm(dim=-1).max() > 0.1
    for key, value in expected._asdict().items():
        torch.testing.assert_close(got._asdict()[key], value, rtol=1e-6, atol=1e-6, equal_nan=True)


def test_a_step_returns_tensors_alone_or_torch_would_trace_each_anew(monkeypatch):
    reconstructor, step, returned = example(settings=FEW), GaussNewton._nested_step, []
    monkeypatch.setattr(GaussNewton, "_nested_step", lambda *given: returned.append(step(*given)) or returned[-1])
    with torch.no_grad(), using(False):
        reconstructor.from_pixels(reconstructor.rest_pixels)
    assert returned and all(type(each) is tuple and {type(part) for part in each} == {torch.Tensor} for each in returned)


def slope(function, at):
    leaf = at.clone().requires_grad_()
    return torch.autograd.grad(function(leaf), leaf)[0]


@pytest.mark.parametrize("whole", [pytest.param(True, marks=pytest.mark.full), False])
def test_gradients_compile_in_one_graph_and_agree(settings, whole):
    """Of the force by pixels; of which the steps alone take a third of the time."""
    reconstructor = example(settings=settings["force-balance"])
    with torch.no_grad():
        pixels = reconstructor(reconstructor.read(EXAMPLES / "two_contacts.png")).pixels

    def stepped(pixels):
        made = reconstructor.estimator
        observation = made.prepare(reconstructor.camera, pixels, torch.ones_like(pixels[..., 0]))
        measured = made.equations.bearings.measured(observation)
        state, before = made.gauss_newton(made.at_rest(measured.weight), measured, made.schedule()[:2], settling=2)
        return made.equilibrium(*state, before, measured).traction.square().sum()

    def loss(pixels):
        return reconstructor.from_pixels(pixels).force.square().sum()

    function = loss if whole else stepped
    expected = slope(function, pixels)
    assert expected.abs().max() > 1e-3
    compiled = torch.compile(function, fullgraph=True, backend="eager")
    torch.testing.assert_close(slope(compiled, pixels), expected, rtol=1e-4, atol=1e-6)
