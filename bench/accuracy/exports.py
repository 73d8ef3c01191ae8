"""Exported models of random sensors against torch: vertices and statuses on images of the sensor at rest and pressed.

python -m bench.accuracy.exports [--sensors 40] [--first 0] [--json FILE]

Sensors as of data/random_sensors.py, but of prestretch 1.002 to 2, 20 to 400 dots (one in ten a speckle), grids of 9 to 49
lines, every second one exported to track; number 0 is a gas-filled dome of radius 20, wall 1.5, prestretch 1.006, with 81 dots
and 1280 x 720 pixels. The file is run on the rest image and two random presses, alone and together. Same: the vertices of
frames with status ok within 1e-3 of the largest displacement or of a length unit, and all statuses equal. Beside it how far
torch in float32 is from torch in float64, or from itself on images one rounding away (rounding), and the seconds of processor
time that the export took.
"""

import argparse
import tempfile
import time
import warnings
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

import torchmembrane as tm
from bench.data.random_sensors import press, random_sensor
from bench.data.record import write
from torchmembrane.camera.model import Camera
from torchmembrane.errors import MembraneError
from torchmembrane.files.images import to_grey
from torchmembrane.onnx.check import compare, rounding
from torchmembrane.presets.design import dome_dots
from torchmembrane.sensor.parts import Cavity, Markers, Material, Surface
from torchmembrane.sensor.sensor import Sensor
from torchmembrane.sensor.toml import default_grid
from torchmembrane.simulate.appearance import Appearance, noisy
from torchmembrane.simulate.render import Renderer
from torchmembrane.simulate.simulator import Simulator

SEED = 17
LINES = (9, 49)
CLOSE = 1e-3
AS_ROUNDING = 2.0  # times what rounding does to torch: a model no further from it is as right as torch is


def drawn(number: int, lines: int | None = None) -> Sensor:
    """The sensor of that number, on a grid of so many lines rather than its own."""
    sensor = slack_dome() if number == 0 else random_grid(number)
    return sensor if lines is None else replace(sensor, membrane=sensor.surface.membrane((lines, lines)))


def random_grid(number: int) -> Sensor:
    """A random sensor on a random grid."""
    sensor = random_sensor(number, SEED, dots=(20, 400), prestretch=(1.002, 2.0))
    lines = int(np.random.default_rng([SEED, number, 6]).integers(LINES[0] // 2, LINES[1] // 2 + 1)) * 2 + 1
    return replace(sensor, membrane=sensor.surface.membrane((lines, lines)))


def slack_dome() -> Sensor:
    """Of gas, nearly unstretched, on its default grid."""
    surface = Surface("spherical_cap", {"rim_radius": 20.0, "height": 19.9, "base_z": 25.0})
    camera = Camera("fisheye", (1280, 720), (330.0, 330.0), (640.0, 360.0))
    markers = Markers("dots", "dark", *dome_dots((20.0,) * 3, np.pi / 2, 25.0, 5.8))
    membrane = surface.membrane(default_grid(markers))
    material = Material("neo_hookean", 1.006, None, 0.3, 1.5)
    sensor = Sensor("slack_dome", "mm", camera, membrane, material, Cavity("gas", 1013.0), markers, surface)
    rest = noisy(Renderer(sensor)(membrane.rest), 40.0, np.random.default_rng(SEED))
    return replace(sensor, markers=replace(markers, rest_image=to_grey((255 * rest).round().byte().numpy())))


def compared(number: int, folder: Path, sensor: Sensor) -> dict[str, Any]:
    """What became of the export of the sensor of that number."""
    simulator, tracking = Simulator(sensor, appearance=Appearance(noise=40.0)), number % 2 == 1
    images = [sensor.markers.rest_image] + [press(simulator, np.random.default_rng([SEED, number, k])).image for k in (1, 2)]
    reconstructor = tm.Reconstructor(sensor)
    grey, path, start = torch.cat([reconstructor.grey(image) for image in images]), folder / "model.onnx", time.process_time()
    tm.export(reconstructor, path, tracking=tracking)
    row = dict(number=number, lines=sensor.membrane.grid[0], filling=sensor.cavity.filling, tracking=tracking)
    row |= dict(kind=sensor.markers.kind, markers=len(reconstructor.rest_pixels), prestretch=sensor.material.prestretch)
    row |= dict(seconds=time.process_time() - start, megabytes=path.stat().st_size / 1e6)
    found = compare(path.read_bytes(), reconstructor, grey)
    with torch.no_grad():
        vertices = reconstructor(grey).vertices.nan_to_num()
    displacement = float((vertices - reconstructor.estimator.membrane.rest).norm(dim=-1).max())
    row |= dict(
        apart=found.distance, displacement=displacement, rounding=rounding(reconstructor, grey), statuses=found.expected
    )
    row["statuses_equal"] = found.status == found.expected
    row["same"] = row["statuses_equal"] and found.distance <= CLOSE * max(displacement, 1.0)
    return row


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sensors", type=int, default=40)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    warnings.simplefilter("ignore")
    torch.set_num_threads(1)
    rows = []
    for number in range(args.first, args.first + args.sensors):
        try:
            with tempfile.TemporaryDirectory() as folder:
                rows.append(row := compared(number, Path(folder), drawn(number)))
        except MembraneError as error:
            rows.append(row := dict(number=number, same=False, error=str(error)))
        print(
            " ".join(f"{key}={value:.3g}" if isinstance(value, float) else f"{key}={value}" for key, value in row.items()),
            flush=True,
        )
        write(args.json, dict(rows=rows))
    others = [row for row in rows if not row["same"]]
    as_torch = sum(row.get("apart", np.inf) <= AS_ROUNDING * row.get("rounding", 0.0) for row in others)
    print(f"{len(rows) - len(others)} of {len(rows)} the same; {as_torch} more within {AS_ROUNDING:g} times rounding")


if __name__ == "__main__":
    main()
