"""Pits taken for mounds: presses of twenty sensors by balls and plates, with the dent that the steps start from and without.

python -m bench.accuracy.basins [--sensors dome_24 bubble_60 ...] [--grid N]

The sensors of weight.py, each pressed eight times by the simulator, 0.025 to 0.14 of its size deep, tilted up to 27 degrees, by
balls of a ninth to a quarter of its size and, every third time, by a plate (seed: the sensor's place in the list); markers are
where their centres are seen, with 0.03 px of noise. Printed: how many presses end with the markers' surface off by over 0.15
and 0.25 of its displacement, and the force by over a tenth; medians of both. What the simulator cannot make is left out.
"""

import argparse
import warnings
from dataclasses import replace

import numpy as np
import torch

import torchmembrane as tm
from bench.accuracy.weight import SENSORS, sensor_of
from torchmembrane.simulate.dataset import stroke_to

PRESSES = 8
LOCATION_NOISE = 0.03  # px


def presses(sensor: tm.Sensor, rng: np.random.Generator) -> list[dict]:
    """Truth of every press, with `pixels [D, 2]`."""
    simulator, size, found = tm.simulate.Simulator(sensor), sensor.membrane.size, []
    aim = sensor.membrane.rest[sensor.membrane.fixed].mean(0).numpy()
    for number in range(PRESSES):
        depth, turn, tilt = np.exp(rng.uniform(np.log(0.025), np.log(0.14))), rng.uniform(0, 2 * np.pi), rng.uniform(0, 0.5)
        way = np.array([tilt * np.cos(turn), tilt * np.sin(turn), -1.0])
        ball = tm.simulate.Sphere(size / rng.uniform(4, 9))
        body = tm.simulate.Plane() if number % 3 == 2 else ball
        try:
            stroke = stroke_to(simulator, body, aim, way / np.linalg.norm(way), depth * size)
            *_, state = simulator.presses(stroke, ("push",))
        except tm.MembraneError:
            continue
        truth = simulator.frame(state, stroke, rng).truth
        seen = truth["uv_deformed"]
        found.append(dict(truth, pixels=seen + LOCATION_NOISE * rng.standard_normal(seen.shape)))
    return found


def errors(reconstructor: tm.Reconstructor, truths: list[dict]) -> np.ndarray:
    """Of the surface at the markers over its displacement, and of the force over the true one, `[B, 2]`."""
    with torch.no_grad():
        result = reconstructor.from_pixels(torch.from_numpy(np.stack([truth["pixels"] for truth in truths])).float())
    rows = []
    for markers, force, truth in zip(result.markers.numpy(), result.force.numpy(), truths, strict=True):
        rest, pressed = truth["dots_nominal"], truth["dots_deformed"]
        surface = np.linalg.norm(markers - pressed) / np.linalg.norm(pressed - rest)
        rows.append((surface, np.linalg.norm(force - truth["force"]) / np.linalg.norm(truth["force"])))
    return np.array(rows)


def undented(reconstructor: tm.Reconstructor) -> None:
    """Leave the dent out."""
    estimator = reconstructor.estimator
    while estimator is not None:
        estimator.dent, estimator = None, estimator.coarse


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sensors", nargs="+", default=list(SENSORS), choices=list(SENSORS), metavar="NAME")
    parser.add_argument("--grid", type=int)
    args = parser.parse_args()
    torch.set_num_threads(1)
    warnings.simplefilter("ignore")
    dented, without = [], []
    for name in args.sensors:
        sensor = sensor_of(name)
        truths = presses(sensor, np.random.default_rng(list(SENSORS).index(name)))
        if args.grid:
            sensor = replace(sensor, membrane=sensor.surface.membrane((args.grid, args.grid)))
        reconstructor = tm.Reconstructor(sensor)
        dented.append(errors(reconstructor, truths))
        undented(reconstructor)
        without.append(errors(reconstructor, truths))
    for words, rows in (("with the dent", np.concatenate(dented)), ("without", np.concatenate(without))):
        surface, force = rows.T
        print(
            f"{words}: {len(rows)} presses, surface {np.median(surface):.3f} at median, {(surface > 0.15).sum()} over 0.15, "
            f"{(surface > 0.25).sum()} over 0.25; force {np.median(force):.3f}, {(force > 0.1).sum()} over 0.1"
        )


if __name__ == "__main__":
    main()
