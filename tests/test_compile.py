"""The reconstruction compiles to one graph with the same results."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch

from torchmembrane.estimators.force_balance.settings import ForceBalanceSettings
from torchmembrane.estimators.minimum_energy.estimator import MinimumEnergySettings
from torchmembrane.reconstruct import Reconstructor
from torchmembrane.sensor.sensor import Sensor

EXAMPLES = Path(__file__).parents[1] / "examples"
FEW = ForceBalanceSettings(steps=2, retry_steps_factor=2, retry_acceptance_ratio=1e9)
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


@pytest.mark.parametrize("estimator", ["force-balance", "minimum-energy"])
@pytest.mark.parametrize("from_rest", [pytest.param(True, marks=pytest.mark.full), False])
def test_the_compiled_reconstruction_is_one_graph_and_agrees(estimator, settings, from_rest):
    """In double precision: eagerly the steps are taken by machine code, compiled ones are tensor operations. Dots are searched
    from rest by the one estimator, from a start by the other."""
    reconstructor = example(estimator, settings[estimator])
    compiled = torch.compile(reconstructor, fullgraph=True, backend="eager")
    images = reconstructor.read(EXAMPLES / "two_contacts.png")
    with torch.no_grad():
        expected, pairs = reconstructor(images), []
        if from_rest or not reconstructor.finds_tractions:
            pairs.append((compiled(images), expected))
        if reconstructor.finds_tractions:
            reading = {"pressure": 1.1 * expected.pressure}
            pairs.append((compiled(images, expected, **reading), reconstructor(images, expected, **reading)))
    assert expected.displacement.norm(dim=-1).max() > 0.1
    for got, want in pairs:
        for key, value in want._asdict().items():
            torch.testing.assert_close(got._asdict()[key], value, rtol=1e-6, atol=1e-6, equal_nan=True)


def test_gradients_compile_in_one_graph_and_agree(settings):
    reconstructor = example(settings=settings["force-balance"])
    with torch.no_grad():
        pixels = reconstructor(reconstructor.read(EXAMPLES / "two_contacts.png")).pixels

    def slope(function):
        leaf = pixels.clone().requires_grad_()
        return torch.autograd.grad(function(leaf), leaf)[0]

    def loss(pixels):
        return reconstructor.from_pixels(pixels).force.square().sum()

    expected = slope(loss)
    assert expected.abs().max() > 0.01
    torch.testing.assert_close(slope(torch.compile(loss, fullgraph=True, backend="eager")), expected, rtol=1e-4, atol=1e-6)
