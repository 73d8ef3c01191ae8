"""Compiles the machine code of a frame once, before the tests start."""

from dataclasses import replace
from pathlib import Path

import torch

import torchmembrane as tm

SENSOR = Path(__file__).parents[1] / "examples" / "sensor.toml"


def main() -> None:
    sensor = tm.Sensor.from_file(SENSOR)
    small = replace(sensor, membrane=sensor.surface.membrane((9, 9)))
    for dtype in (torch.float32, torch.float64):
        reconstructor = tm.Reconstructor(small, dtype=dtype)
        with torch.no_grad():
            reconstructor(reconstructor.read(SENSOR.parent / "rest.png"))


if __name__ == "__main__":
    main()
