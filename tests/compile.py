"""Compiles a frame's machine code in one precision before the tests.

The process that compiles may differ in the last bit from later ones, which load the code.
"""

import sys
from dataclasses import replace
from pathlib import Path

import torch

import torchmembrane as tm
from torchmembrane.machine_code import using

SENSOR = Path(__file__).parents[1] / "examples" / "sensor.toml"
IMAGES = [SENSOR.parent / f"{name}.png" for name in ("flat_plate", "press_on_axis", "two_contacts")]


def main(precision: str) -> None:
    sensor, dtype = tm.Sensor.from_file(SENSOR), getattr(torch, precision)
    small = replace(sensor, membrane=sensor.surface.membrane((9, 9)))
    with torch.no_grad():
        with using(dtype == torch.float32):  # in which dots are fitted, whatever the solver's precision
            reconstructor = tm.Reconstructor(small, dtype=dtype)
        reconstructor.from_pixels(reconstructor.rest_pixels[None])
        reconstructor(reconstructor.read(*IMAGES))


if __name__ == "__main__":
    main(*sys.argv[1:])
