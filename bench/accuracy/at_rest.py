"""False contacts: images at rest of random sensors, each sensor with several rest images, whose noise stays in every frame.

python -m bench.accuracy.at_rest [--sensors 10] [--first 0] [--draws 10] [--frames 10] [--noise 30] [--json FILE]

Sensors of data/random_sensors.py. Printed for every sensor: frames with a contact, frames with another status than ok, the
largest total force found over tension times size.
"""

import argparse
import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

import torchmembrane as tm
from bench.data.random_sensors import random_sensor
from bench.data.record import write
from torchmembrane.simulate.appearance import noisy
from torchmembrane.simulate.simulator import Simulator


def false_contacts(number: int, draws: int, frames: int, noise: float) -> dict:
    """Return the counts of one sensor, and its largest force over tension times size; `noise`: signal over noise, dB."""
    sensor = random_sensor(number)
    simulator, rng = Simulator(sensor), np.random.default_rng([1, number])
    with torch.no_grad():
        clean = simulator.renderer(simulator.membrane.rest)
    found = dict(sensor=number, frames=0, contacts=0, flagged=0, force=0.0)
    for _ in range(draws):
        rest, *images = ((255 * noisy(clean, noise, rng)).round().byte() for _ in range(1 + frames))
        reconstructor = tm.Reconstructor(replace(sensor, markers=replace(sensor.markers, rest_image=rest.numpy())))
        with torch.no_grad():
            result = reconstructor(torch.stack(images)[:, None])
        scale = float(reconstructor.estimator.elasticity.tension) * sensor.membrane.size
        found["frames"] += frames
        found["contacts"] += int(torch.isfinite(result.contact_points[..., 0]).any(1).sum())
        found["flagged"] += int((result.status != 0).sum())
        found["force"] = max(found["force"], float(result.force.norm(dim=-1).nan_to_num().max()) / scale)
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sensors", type=int, default=10)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--draws", type=int, default=10)
    parser.add_argument("--frames", type=int, default=10)
    parser.add_argument("--noise", type=float, default=30.0)
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    warnings.simplefilter("ignore")
    torch.set_num_threads(1)
    rows = []
    for number in range(args.first, args.first + args.sensors):
        try:
            rows.append(false_contacts(number, args.draws, args.frames, args.noise))
        except tm.MembraneError as error:
            print(f"sensor {number}: {error}", flush=True)
            continue
        row = rows[-1]
        print(
            f"sensor {number}: {row['contacts']} of {row['frames']} frames with a contact, {row['flagged']} flagged, "
            f"force up to {row['force']:.1e}",
            flush=True,
        )
    total = {key: sum(row[key] for row in rows) for key in ("frames", "contacts", "flagged")}
    print(f"all: {total['contacts']} of {total['frames']} frames with a contact, {total['flagged']} flagged")
    write(args.json, dict(noise=args.noise, rows=rows))


if __name__ == "__main__":
    main()
