"""The law of contact over depth of a sensor (`check --robot`): errors at the top, and what other places and bodies take.

python -m bench.accuracy.contact_law [--presses 12] [--json FILE] [SENSOR.toml ...]

Without a file, of the presets and of examples/sensor.toml. Printed: how far the law's force is off in the presses that it was
fitted to and in those held out, at most; then the simulated force over the law's, least, median and most: of balls of 0.16 of
the size pressed 0.05 of it deep at random places at least 0.25 of it off the rim, along the normal; and of a plate on the top,
pressed as deep, over that of the ball.
"""

import argparse
import warnings
from pathlib import Path

import numpy as np
import torch

import torchmembrane as tm
from bench.data.record import write
from torchmembrane.accuracy.contact_law import DEPTH, RADIUS, contact_law
from torchmembrane.accuracy.presses import followed
from torchmembrane.presets import NAMES
from torchmembrane.simulate.dataset import stroke_to
from torchmembrane.simulate.indenters import Indenter, Plane, Sphere
from torchmembrane.simulate.simulator import Simulator

CLEAR = 0.25


def force_of(simulator: Simulator, body: Indenter, place: np.ndarray, way: np.ndarray) -> float:
    """Of a press `DEPTH` of the size deep; NaN where it cannot be followed."""
    depth = DEPTH * simulator.membrane.size
    stroke = stroke_to(simulator, body, place, way, depth)
    states, _ = followed(simulator, [[stroke.indenter, stroke.indenter.moved(depth * stroke.travel)]], 0.0)
    return float(states[-1].force.norm()) if states else np.nan


def measured(sensor: tm.Sensor, presses: int) -> dict:
    """Of one sensor."""
    law, simulator, rng = contact_law(sensor), Simulator(sensor), np.random.default_rng(0)
    membrane, size = simulator.membrane, simulator.membrane.size
    expected = float(law.force(RADIUS * size, DEPTH * size))
    clear = torch.cdist(membrane.rest, membrane.rest[membrane.fixed]).amin(1)
    places = rng.permutation(np.flatnonzero(clear > CLEAR * size))[:presses]
    elsewhere = [
        force_of(simulator, Sphere(RADIUS * size), membrane.rest[k].numpy(), -membrane.rest_normals[k].numpy()) / expected
        for k in places
    ]
    plate = force_of(simulator, Plane(), np.array(law.place), np.array(law.inward)) / expected
    fitted, held = (float(np.abs(law.errors(which)).max()) for which in (False, True))
    return dict(sensor=sensor.name, fitted=fitted, held_out=held, elsewhere=elsewhere, plate=plate)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("sensors", type=Path, nargs="*")
    parser.add_argument("--presses", type=int, default=12)
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    warnings.simplefilter("ignore")
    sensors = [tm.Sensor.from_file(path) for path in args.sensors]
    sensors = sensors or [*map(tm.preset, NAMES), tm.Sensor.from_file(Path("examples/sensor.toml"))]
    rows = []
    for sensor in sensors:
        row = measured(sensor, args.presses)
        least, middle, most = np.nanquantile(row["elsewhere"], (0, 0.5, 1))
        print(f"{row['sensor']}: fitted {row['fitted']:.3f}, held out {row['held_out']:.3f}; ", end="")
        print(f"elsewhere {least:.2f}, {middle:.2f}, {most:.2f}; a plate {row['plate']:.2f}", flush=True)
        rows.append(row)
    write(args.json, dict(rows=rows))


if __name__ == "__main__":
    main()
