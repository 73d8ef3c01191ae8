"""torch's default dtype does not change any result."""

import subprocess
import sys

import numpy as np
import pytest
import torch
from PIL import Image

import torchmembrane as tm
from torchmembrane.simulate.pattern import Speckle
from torchmembrane.simulate.render import render

KINDS = {"float64": torch.float64, "float16": torch.float16, "bfloat16": torch.bfloat16}
CHOSEN = ["float64", "float16", pytest.param("bfloat16", marks=pytest.mark.full)]
"""Of more digits than float32, and of fewer."""


@pytest.fixture(autouse=True)
def _single_by_default():
    yield
    torch.set_default_dtype(torch.float32)


def answers(path, image, **options):
    """What a sensor's reconstructor says of an image by all ways, as arrays of one type."""
    made = tm.Reconstructor.from_file(path, **options)
    levels = np.asarray(Image.open(image))
    with torch.no_grad():
        result = made(levels)
        found = [*result, *tm.Tracker(made)(levels), *made.from_pixels(result.pixels)]
    differentiated = made.read(image).requires_grad_()
    made(differentiated).vertices.nansum().backward()
    found.append(differentiated.grad)
    if made.finds_tractions:
        with torch.no_grad():
            found += [*made.standard_deviations(result), *made(levels, pressure=0.01)]
    return found


@pytest.fixture(scope="module")
def expected(small_sensor, small_images):
    return {
        choice: answers(small_sensor / "sensor.toml", small_images[2], **choice_of(choice))
        for choice in ("force-balance", "minimum-energy", "soft")
    }


def choice_of(name):
    return {"locator": "soft"} if name == "soft" else {"estimator": name}


@pytest.mark.parametrize("kind", CHOSEN)
@pytest.mark.parametrize("choice", ["force-balance", "minimum-energy", "soft"])
def test_answers_are_the_same_to_the_last_digit(small_sensor, small_images, expected, choice, kind):
    torch.set_default_dtype(KINDS[kind])
    found = answers(small_sensor / "sensor.toml", small_images[2], **choice_of(choice))
    for one, other in zip(found, expected[choice], strict=True):
        assert one.dtype == other.dtype and torch.equal(one.nan_to_num(), other.nan_to_num())


@pytest.mark.parametrize("kind", CHOSEN)
def test_a_default_that_is_set_before_the_call_changes_nothing(small_sensor, small_images, kind):
    made = tm.Reconstructor.from_file(small_sensor / "sensor.toml")
    expected = made(made.read(*small_images))
    torch.set_default_dtype(KINDS[kind])
    for one, other in zip(made(made.read(*small_images)), expected, strict=True):
        assert one.dtype == other.dtype and torch.equal(one.nan_to_num(), other.nan_to_num())


def rendered(path):
    sensor = tm.Sensor.from_file(path)
    return render(sensor, sensor.membrane.rest, pattern=Speckle(0.8))


@pytest.mark.parametrize("kind", CHOSEN)
def test_images_are_rendered_and_textures_followed_alike(small_sensor, kind):
    from dataclasses import replace

    def told():
        image = rendered(small_sensor / "sensor.toml")
        sensor = tm.Sensor.from_file(small_sensor / "sensor.toml")
        markers = tm.Markers("texture", rest_image=image.numpy())
        made = tm.Reconstructor(replace(sensor, markers=markers), check_rest=False)
        return [image, *made(image.roll(1, 1))]

    expected = told()
    torch.set_default_dtype(KINDS[kind])
    for one, other in zip(told(), expected, strict=True):
        assert one.dtype == other.dtype and torch.equal(one.nan_to_num(), other.nan_to_num())


@pytest.mark.parametrize("kind", ["float64", *(pytest.param(kind, marks=pytest.mark.full) for kind in ("float16", "bfloat16"))])
def test_a_default_that_is_set_before_the_import_changes_nothing(small_sensor, small_images, kind):
    script = (
        f"import torch; torch.set_default_dtype(torch.{kind})\n"
        "import torchmembrane as tm\n"
        f"made = tm.Reconstructor.from_file({str(small_sensor / 'sensor.toml')!r})\n"
        f"print(made(made.read({str(small_images[2])!r})).force.tolist())"
    )
    said = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True)
    made = tm.Reconstructor.from_file(small_sensor / "sensor.toml")
    assert said.stdout.strip() == str(made(made.read(small_images[2])).force.tolist()), said.stderr
