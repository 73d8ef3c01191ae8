"""The pipeline neither mixes devices nor waits for one.

A tensor left on the CPU, a value read by Python, a branch on one: each is an error on the meta device. (Fake CUDA tensors
cannot be indexed where torch was built without CUDA.)
"""

import dataclasses

import pytest
import torch
from torch.overrides import TorchFunctionMode

import torchmembrane as tm
from torchmembrane.estimators.minimum_energy.estimator import MinimumEnergySettings

CASES = [
    pytest.param("force-balance", {}, marks=pytest.mark.full),
    pytest.param("force-balance", dict(locator="soft"), marks=pytest.mark.full),
    pytest.param("minimum-energy", {}, marks=pytest.mark.full),
    ("minimum-energy", dict(locator="soft")),
    ("paper", {}),
]
"""The others go through their estimators in `test_nothing_is_copied_to_the_device_for_a_frame` as well."""


@pytest.fixture(scope="module")
def sensor():
    whole = tm.Sensor.from_file("examples/sensor.toml")
    return dataclasses.replace(whole, membrane=whole.membrane.resampled((17, 17)))


@pytest.fixture(params=[pytest.param("all steps", marks=pytest.mark.full), "few steps"])
def settings(request, few_steps):
    """Of each estimator, by name: each step is the same operations once more."""
    few = {"force-balance": few_steps, "minimum-energy": MinimumEnergySettings(steps=2)}
    return few if request.param == "few steps" else {}


@pytest.mark.parametrize(("estimator", "options"), CASES)
def test_images_go_through_every_estimator(sensor, estimator, options, settings):
    reconstructor = tm.Reconstructor(sensor, estimator, settings=settings.get(estimator), **options).to("meta")
    images = torch.empty(2, 480, 640, 3, dtype=torch.uint8, device="meta")
    result = reconstructor(images)
    assert {values.device.type for values in result} == {"meta"}
    assert result.vertices.shape == (2, 289, 3)


@pytest.mark.full
def test_frames_are_tracked_gauged_and_taken_from_markers(sensor, settings):
    reconstructor = tm.Reconstructor(sensor, settings=settings.get("force-balance")).to("meta")
    images = torch.empty(2, 1, 480, 640, device="meta")
    first = reconstructor(images)
    followed = reconstructor(images, first, pressure=torch.empty(2, device="meta"))
    located = reconstructor.from_pixels(first.pixels, first.confidence)
    assert followed.force.shape == located.force.shape == (2, 3)


class NoCopies(TorchFunctionMode):
    """Refuses tensors that come from the processor: a GPU waits for each such copy, and no CUDA graph can hold one."""

    def __torch_function__(self, function, types, args=(), kwargs=None):
        assert function not in (torch.tensor, torch.Tensor.new_tensor), f"{function.__name__}{args}"
        if function is torch.Tensor.__getitem__:
            indices = args[1] if isinstance(args[1], tuple) else (args[1],)
            assert not any(isinstance(index, list) for index in indices), f"a list as an index: {indices}"
        result = function(*args, **(kwargs or {}))
        if function in (torch.as_tensor, torch.Tensor.to, torch.Tensor.copy_):
            given = args[1] if function is torch.Tensor.copy_ else args[0]
            assert getattr(given, "device", None) == result.device, f"{function.__name__}{args}"
        return result


@pytest.mark.parametrize("estimator", ["force-balance", "minimum-energy"])
def test_nothing_is_copied_to_the_device_for_a_frame(sensor, few_steps, estimator):
    """Neither for images, nor for what is tracked, gauged or taken from markers."""
    settings = few_steps if estimator == "force-balance" else None
    reconstructor = tm.Reconstructor(sensor, estimator, settings=settings).to("meta")
    images = torch.empty(2, 480, 640, 3, dtype=torch.uint8, device="meta")
    gauge = {"pressure": torch.empty(2, device="meta")} if reconstructor.finds_tractions else {}
    with NoCopies(), torch.no_grad():
        first = reconstructor(images)
        followed = reconstructor(images, first, **gauge)
        located = reconstructor.from_pixels(first.pixels, first.confidence)
    for result in (first, followed, located):
        assert {values.device.type for values in result} == {"meta"}
        assert result.vertices.shape == (2, 289, 3) and result.force.shape == (2, 3)


def test_a_tensor_left_on_the_cpu_is_refused(sensor):
    """What the tests above are worth."""
    reconstructor = tm.Reconstructor(sensor).to("meta")
    reconstructor.observer.rest_pixels = reconstructor.observer.rest_pixels.new_zeros(
        reconstructor.observer.rest_pixels.shape, device="cpu"
    )
    with pytest.raises(RuntimeError, match="meta"):
        reconstructor(torch.empty(2, 1, 480, 640, device="meta"))
