"""Two views of a membrane against one: errors of shape, depth and force on presses of random sensors.

python -m bench.accuracy.views [--sensors 20] [--presses 60] [--first 0] [--depth 0.02,0.3] [--json FILE]

Each sensor of `data/random_sensors.py` with listed dots gets a second camera of the same lens, 0.2 to 2 times the membrane's
size beside the first, that looks at its middle. Each press is reconstructed from the dots' true pixels with 0.05 px of noise:
by the first view, by both, and by both where every third dot is hidden from one and every other third from the other. Shape is
the rms error of the dots over their rms displacement, depth the error of the deepest displacement over it, force the error over
the force; `deep` are presses deeper than 0.2 of the size, `soft` open cavities and prestretch below 1.1.
"""

import argparse
import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

import torchmembrane as tm
from bench.data.random_sensors import press, random_sensor
from bench.data.record import write
from torchmembrane.errors import MembraneError
from torchmembrane.markers.placement import markers_in_view
from torchmembrane.pose import ViewPose
from torchmembrane.sensor.views import View
from torchmembrane.simulate.simulator import Simulator

BASELINE = (0.2, 2.0)  # over the membrane's size
LEAST_SEEN = 0.5  # of the dots, by a view that is taken
TRIES = 40
NOISE = 0.05  # px
DEEP, UNSTRETCHED = 0.2, 1.1
MEASURES = ("shape", "depth", "force")


def with_second_view(sensor: tm.Sensor, rng: np.random.Generator) -> tuple[tm.Sensor, float]:
    """The sensor with a second view, and its baseline over the size.

    Raises:
        MembraneError: no view that was tried sees enough of the dots.
    """
    middle, size = sensor.membrane.rest.mean(0).numpy(), sensor.membrane.size
    for _ in range(TRIES):
        baseline, turn = rng.uniform(*BASELINE), rng.uniform(0, 2 * np.pi)
        place = baseline * size * np.array([np.cos(turn), np.sin(turn), 0.0])
        ahead = (middle - place) / np.linalg.norm(middle - place)
        right = np.cross([0.0, 1.0, 0.0], ahead)
        right /= np.linalg.norm(right)
        pose = ViewPose(np.stack([right, np.cross(ahead, right), ahead], 1), place)
        both = replace(sensor, views=(View("first", sensor.camera), View("second", sensor.camera, pose)))
        if markers_in_view(both.in_view(1)).mean() >= LEAST_SEEN:
            return both, baseline
    raise MembraneError(f"{sensor.name}: none of {TRIES} second views sees {LEAST_SEEN:g} of the dots")


def errors(result: tm.Reconstruction, truth: dict, normals: np.ndarray) -> list[float]:
    """Errors of shape, depth and force."""
    rest, now = truth["dots_nominal"], truth["dots_deformed"]
    off = np.sqrt(((result.markers[0].numpy() - now) ** 2).sum(-1).mean())
    shape = off / np.sqrt(((now - rest) ** 2).sum(-1).mean())
    deepest = [
        -float((u * n).sum(-1).min())
        for u, n in zip(
            (result.displacement[0].numpy(), truth["vertices_deformed"] - truth["vertices_nominal"]), normals, strict=True
        )
    ]
    force = np.linalg.norm(result.force[0].numpy() - truth["force"]) / np.linalg.norm(truth["force"])
    return [float(shape), abs(deepest[0] - deepest[1]) / deepest[1], float(force)]


def presses_of(number: int, count: int, depths: tuple[float, float]) -> list[dict]:
    """What comes of one sensor's presses."""
    sensor = random_sensor(number)
    if sensor.markers.positions is None:
        raise MembraneError(f"{sensor.name}: no listed dots")
    sensor, baseline = with_second_view(
        replace(sensor, markers=replace(sensor.markers, rest_image=None)), np.random.default_rng([number, 7])
    )
    simulator = Simulator(sensor)
    one, two = tm.Reconstructor(sensor.in_view(0)), tm.Reconstructor(sensor)
    normals, soft = (sensor.membrane.rest_normals.numpy(), simulator.membrane.rest_normals.numpy()), is_soft(sensor)
    rows = []
    for k in range(count):
        rng = np.random.default_rng([number, 8, k])
        try:
            truth = press(simulator, rng, depths).truth
        except MembraneError as error:
            print(error, flush=True)
            continue
        pixels = torch.from_numpy(truth["uv_deformed"] + rng.normal(0, NOISE, truth["uv_deformed"].shape))
        seen = torch.from_numpy(truth["visible_deformed"] & np.isfinite(pixels.numpy()).all(-1)).float()
        hidden = seen.clone()
        hidden[0, 0::3], hidden[1, 1::3] = 0, 0
        results = {"one": one.from_pixels(pixels[0], seen[0]), "two": two.from_pixels(pixels, seen)}
        results["hidden"] = two.from_pixels(pixels, hidden)
        found = {name: errors(result, truth, normals) for name, result in results.items()}
        status = {f"status {name}": int(result.status[0]) for name, result in results.items()}
        depth = float(-((truth["vertices_deformed"] - truth["vertices_nominal"]) * normals[1]).sum(-1).min())
        rows.append(dict(sensor=number, baseline=baseline, soft=soft, depth=depth / sensor.membrane.size) | found | status)
    return rows


def is_soft(sensor: tm.Sensor) -> bool:
    """Whether the cavity is open or the membrane nearly unstretched."""
    return sensor.cavity.filling == "open" or sensor.material.prestretch < UNSTRETCHED


def print_table(rows: list[dict]) -> None:
    """Medians and 90 % of the errors, where each has a surface."""
    groups = {"all": rows, "deep": [r for r in rows if r["depth"] > DEEP], "soft": [r for r in rows if r["soft"]]}
    print(f"{'':14}{'presses':>8}" + "".join(f"{name + ', median / 90 %':>28}" for name in MEASURES))
    for group, chosen in groups.items():
        for name in ("one", "two", "hidden"):
            values = np.array([row[name] for row in chosen], float).reshape(-1, len(MEASURES))
            values = values[np.isfinite(values).all(1)]
            if len(values):
                cells = "".join(f"{np.median(v):>18.3f} / {np.quantile(v, 0.9):.3f}  " for v in values.T)
                print(f"{group:6}{name:8}{len(values):>8}{cells}", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sensors", type=int, default=20)
    parser.add_argument("--presses", type=int, default=60)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--depth", default="0.02,0.3", help="of the presses, over the size")
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    warnings.simplefilter("ignore")
    depths, rows, number, made = tuple(map(float, args.depth.split(","))), [], args.first, 0
    while made < args.sensors:
        try:
            rows += presses_of(number, args.presses, (depths[0], depths[1]))
            made += 1
            print(f"s{number:04d}: {len(rows)} presses of {made} sensors", flush=True)
        except MembraneError as error:
            print(error, flush=True)
        number += 1
    print_table(rows)
    if args.json:
        write(args.json, {"presses": rows})


if __name__ == "__main__":
    main()
