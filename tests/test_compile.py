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
from torchmembrane.solve import implicit

EXAMPLES = Path(__file__).parents[1] / "examples"
SETTINGS = ForceBalanceSettings()
FEW = ForceBalanceSettings(steps=(4, 2, 2))
"""Steps take long to compile; of so few, half are damped, because no frame has settled before."""


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
def test_gradients_compile_in_one_graph_and_agree(whole, monkeypatch):
    """Of the force by pixels, for a light press, whose steps converge fast: the compiled graph unrolls the last of them."""
    monkeypatch.setattr(implicit, "UNROLLED_STEPS", 12)
    reconstructor = example(settings=replace(FEW, steps=(48, 2, 2), settled_step_tol=1e-12))
    with torch.no_grad():
        pixels = reconstructor(reconstructor.read(EXAMPLES / "two_contacts.png")).pixels
        pixels = reconstructor.rest_pixels + 0.1 * (pixels - reconstructor.rest_pixels)
    made = reconstructor.estimator

    def measured(pixels):
        return made.equations.bearings.measured(made.prepare(reconstructor.camera, pixels, torch.ones_like(pixels[..., 0])))

    with torch.no_grad():
        settled, _ = made.gauss_newton(made.at_rest(pixels[..., 0]), measured(pixels), SETTINGS.tau[0], 200)

    def traction(pixels):
        state = made.gauss_newton.with_gradients(settled, measured(pixels))
        return made.equilibrium(*state, settled.u, measured(pixels)).traction.square().sum()

    def force(pixels):
        return reconstructor.from_pixels(pixels).force.square().sum()

    function = force if whole else traction
    expected = slope(function, pixels)
    assert expected.abs().max() > 1e-4
    compiled = torch.compile(function, fullgraph=True, backend="eager")
    torch.testing.assert_close(slope(compiled, pixels), expected, rtol=0, atol=1e-4 * expected.abs().max().item())
