"""Two views of a membrane against one: errors of shape, depth and force on presses of random sensors.

python -m bench.accuracy.views [--sensors 20] [--presses 60] [--first 0] [--depth 0.02,0.3] [--grid 17] [--soft]
    [--json FILE]

Each sensor of `data/random_sensors.py` with listed dots gets a second camera of the same lens, 0.2 to 2 times the membrane's
size beside the first, that looks at its middle. Each press that its membrane can follow is reconstructed from the dots' true
pixels with 0.05 px of noise: by the first view, by both, and by both where every third dot is hidden from one and every other
third from the other. Shape is the rms error of the dots over their rms displacement, depth the error of the deepest
displacement over it, force the error over the force; `deep` are presses deeper than 0.2 of the size, `soft` open cavities and
prestretch below 1.1. A sensor whose membrane follows not even the first press is left out. --grid: lines of the solver's grid
in place of the 25 or 33 of these sensors; --soft: only `soft` ones.
"""

import argparse
import warnings
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch

import torchmembrane as tm
from bench.data.random_sensors import INCREMENT, patience, random_sensor, random_stroke
from bench.data.record import write
from torchmembrane.errors import MembraneError
from torchmembrane.markers.placement import markers_in_view
from torchmembrane.pose import ViewPose
from torchmembrane.sensor.views import View
from torchmembrane.simulate.quasi_static import presses
from torchmembrane.simulate.render import RenderedDots
from torchmembrane.simulate.simulator import Simulator

BASELINE = (0.2, 2.0)  # over the membrane's size
LEAST_SEEN = 0.5  # of the dots, by a view that is taken
TRIES = 40
STROKES, SECONDS = 4, 15  # that are tried for a press, and for one equilibrium
LOCATION_NOISE = 0.05  # px
DEEP, UNSTRETCHED = 0.2, 1.1
MEASURES = ("shape", "depth", "force")
SEEN = ("one", "two", "hidden")


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


class Pressed(NamedTuple):
    """A press as it is: the dots at rest and pressed, the surface on the simulator's grid, the force."""

    rest: np.ndarray
    dots: RenderedDots
    displacement: np.ndarray
    force: np.ndarray


def pressed(simulator: Simulator, rng: np.random.Generator, depths: tuple[float, float]) -> Pressed:
    """A random press that the membrane can follow.

    Raises:
        MembraneError: none of `STROKES` is one.
    """
    membrane = simulator.membrane
    for _ in range(STROKES):
        try:
            stroke = random_stroke(simulator, depths, rng)
            poses = [stroke.indenter, stroke.indenter.moved(stroke.depth * stroke.travel)]
            options = dict(friction=stroke.friction, increment=INCREMENT * membrane.size, **simulator.cavity)
            with patience(SECONDS):
                *_, state = presses(membrane, simulator.elasticity, [poses], **options)
        except (MembraneError, TimeoutError):
            continue
        if state.contact.any() and float(state.vertices[:, 2].min()) > 0:
            dots, rest = simulator.dots(state.vertices), simulator.rest_dots.positions.numpy()
            return Pressed(rest, dots, (state.vertices - membrane.rest).numpy(), state.force.numpy())
    raise MembraneError(f"{simulator.sensor.name}: no press of {STROKES} can be followed in {SECONDS} s")


def followed(simulator: Simulator, number: int, count: int, depths: tuple[float, float]) -> list[Pressed]:
    """Those of so many presses that the membrane can follow.

    Raises:
        MembraneError: the first is none of them.
    """
    truths: list[Pressed] = []
    for k in range(count):
        try:
            truths.append(pressed(simulator, np.random.default_rng([number, 8, k]), depths))
        except MembraneError as error:
            if not truths:
                raise
            print(error, flush=True)
    return truths


def deepest(displacement: np.ndarray, normals: np.ndarray) -> float:
    """The deepest displacement along the inward normal."""
    return -float((displacement * normals).sum(-1).min())


def errors(result: tm.Reconstruction, truth: Pressed, depths: tuple[float, float]) -> list[float]:
    """Errors of shape, depth (of those found and true) and force."""
    now = truth.dots.positions.numpy()
    off = np.sqrt(((result.markers[0].numpy() - now) ** 2).sum(-1).mean())
    shape = off / np.sqrt(((now - truth.rest) ** 2).sum(-1).mean())
    force = np.linalg.norm(result.force[0].numpy() - truth.force) / np.linalg.norm(truth.force)
    return [float(shape), abs(depths[0] / depths[1] - 1), float(force)]


def presses_of(
    number: int, count: int, depths: tuple[float, float], lines: int | None = None, soft: bool = False
) -> list[dict]:
    """What comes of one sensor's presses, solved on a grid of so many lines; None: on the sensor's own.

    Raises:
        MembraneError: it has no listed dots, or, where only `soft` sensors are asked for, is none.
    """
    sensor = random_sensor(number)
    if sensor.markers.positions is None:
        raise MembraneError(f"{sensor.name}: no listed dots")
    if soft and not is_soft(sensor):
        raise MembraneError(f"{sensor.name}: neither open nor nearly unstretched")
    sensor, baseline = with_second_view(
        replace(sensor, markers=replace(sensor.markers, rest_image=None)), np.random.default_rng([number, 7])
    )
    simulator = Simulator(sensor)
    truths = followed(simulator, number, count, depths)
    if lines is not None:
        sensor = replace(sensor, membrane=sensor.surface.membrane((lines, lines)))
    one, two = tm.Reconstructor(sensor.in_view(0)), tm.Reconstructor(sensor)
    normals, true_normals = sensor.membrane.rest_normals.numpy(), simulator.membrane.rest_normals.numpy()
    rows = []
    for k, truth in enumerate(truths):
        rng, exact = np.random.default_rng([number, 9, k]), truth.dots.pixels
        pixels = exact + torch.from_numpy(rng.normal(0, LOCATION_NOISE, exact.shape))
        seen = (truth.dots.visible & pixels.isfinite().all(-1)).float()
        hidden = seen.clone()
        hidden[0, 0::3], hidden[1, 1::3] = 0, 0
        results = {"one": one.from_pixels(pixels[0], seen[0]), "two": two.from_pixels(pixels, seen)}
        results["hidden"] = two.from_pixels(pixels, hidden)
        depth = deepest(truth.displacement, true_normals)
        row = dict(sensor=number, baseline=baseline, soft=is_soft(sensor), depth=depth / sensor.membrane.size)
        for name, result in results.items():
            row[name] = errors(result, truth, (deepest(result.displacement[0].numpy(), normals), depth))
            row[f"status {name}"] = int(result.status[0])
        rows.append(row)
    return rows


def is_soft(sensor: tm.Sensor) -> bool:
    """Whether the cavity is open or the membrane nearly unstretched."""
    return sensor.cavity.filling == "open" or sensor.material.prestretch < UNSTRETCHED


def bands(rows: list[dict]) -> list[dict]:
    """Median and 90 % of the errors, of all presses, the deep ones and those of soft membranes; a press without a surface in
    one of the three reconstructions is left out of all."""
    rows = [row for row in rows if np.isfinite([row[name] for name in SEEN]).all()]
    groups = {"all": rows, "deep": [r for r in rows if r["depth"] > DEEP], "soft": [r for r in rows if r["soft"]]}
    found = []
    for group, chosen in groups.items():
        for name in SEEN if chosen else ():
            values = np.array([row[name] for row in chosen])
            spans = {key: np.quantile(v, (0.5, 0.9)).tolist() for key, v in zip(MEASURES, values.T, strict=True)}
            ok = sum(row[f"status {name}"] == 0 for row in chosen)
            found.append(dict(group=group, seen=name, presses=len(chosen), ok=ok) | spans)
    return found


def print_table(rows: list[dict]) -> None:
    """The same as lines."""
    print(f"{'':14}{'presses':>8}{'ok':>6}" + "".join(f"{name + ', median / 90 %':>28}" for name in MEASURES))
    for band in bands(rows):
        cells = "".join(f"{band[key][0]:>18.3f} / {band[key][1]:.3f}  " for key in MEASURES)
        print(f"{band['group']:6}{band['seen']:8}{band['presses']:>8}{band['ok']:>6}{cells}", flush=True)


def options(doc: str | None, sensors: int, presses: int) -> argparse.ArgumentParser:
    """Options of a benchmark of random presses on random sensors."""
    parser = argparse.ArgumentParser(description=doc, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sensors", type=int, default=sensors)
    parser.add_argument("--presses", type=int, default=presses)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--depth", default="0.02,0.3", help="of the presses, over the size")
    parser.add_argument("--json", type=Path)
    return parser


def of_sensors(args: argparse.Namespace, of_sensor: Callable[[int, int, tuple[float, float]], list[dict]]) -> list[dict]:
    """Rows of the presses of as many sensors as are asked for, from `--first` on; those without listed dots are passed over."""
    warnings.simplefilter("ignore")
    low, high = map(float, args.depth.split(","))
    rows: list[dict] = []
    number, made = args.first, 0
    while made < args.sensors:
        try:
            rows += of_sensor(number, args.presses, (low, high))
            made += 1
            print(f"s{number:04d}: {len(rows)} presses of {made} sensors", flush=True)
        except MembraneError as error:
            print(error, flush=True)
        number += 1
    return rows


def main() -> None:
    parser = options(__doc__, sensors=20, presses=60)
    parser.add_argument("--grid", type=int)
    parser.add_argument("--soft", action="store_true")
    args = parser.parse_args()
    rows = of_sensors(args, lambda *press: presses_of(*press, args.grid, args.soft))
    print_table(rows)
    if args.json:
        write(args.json, {"presses": rows})


if __name__ == "__main__":
    main()
