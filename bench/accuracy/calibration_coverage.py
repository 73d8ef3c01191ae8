"""How often the intervals of `calibrate material` hold the truth where the rest shape is off by 1, 2 or 5 % of the size.

python -m bench.accuracy.calibration_coverage [--sensors 102] [--first 0] [--seed 0] [--json FILE]

Sheets on rectangles, ellipses and rounded triangles of 32 to 50 mm, prestretch 1.02 to 1.3, modulus x thickness 0.02 to 0.1
N/mm, blown up with gas to 0.1 (of 5 %: 0.2) to 0.3 of their size, pressed three times by balls, on an unstructured mesh by
another solver (`bench.accuracy.windows`). The package is told the rim; the height, normal, with 1, 2 or 5 % of the size as its
standard deviation (no more than two of them off), and this as `--rest-error`; a prestretch of 1.1, which `init` assumes; the
gauge at rest, to 5 %; the forces of two presses, to 3 %; the dots' pixels, to 0.05 px. Dots are placed from the rest pixels.
Calibrated is as `calibrate material --forces --overpressure --rest-error` does; the third press is reconstructed with what it
writes. Of each group: how many intervals of one standard deviation hold prestretch, modulus and the third force (68 % would of
normal errors), mean and standard deviation of the errors over their standard deviations, and the median standard deviation,
relative. Sensors that FILE has already are not computed again.
"""

import argparse
import json
import time
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

import torchmembrane as tm
from bench.accuracy.rest_shapes import flat_rim
from bench.accuracy.windows import AIR, Sheet, Twin, lattice
from bench.data.record import write
from torchmembrane.calibrate.known_modulus import KnownForces
from torchmembrane.calibrate.material import material_from_pixels
from torchmembrane.forming.formed import SheetMaterial, formed_surface
from torchmembrane.presets.blown_up import ASSUMED_PRESTRETCH, Stated, blown_up
from torchmembrane.sensor.parts import Cavity, Markers
from torchmembrane.sensor.record import Record
from torchmembrane.sensor.units import hectopascal

WRONG = (0.01, 0.02, 0.05)
TOLD = {"gauge": 0.05, "force": 0.03}  # relative standard deviations of what is read
LOCATION_NOISE = 0.05  # px
PRESSES = 3  # the last one is not calibrated from
NAMES = ("prestretch", "modulus", "force")


class Drawn(NamedTuple):
    """A sensor, drawn at random.

    Attributes:
        rim: `[K, 3]`, mm.
        sheet: what it is made of.
        size: size of its membrane, mm.
        off: standard deviation of the height that is told, over the size.
        error: error of that height, in these.
    """

    rim: np.ndarray
    sheet: Sheet
    size: float
    off: float
    error: float


def drawn(k: int, rng: np.random.Generator) -> Drawn:
    """The k-th sensor."""
    off = WRONG[k % len(WRONG)]
    a, b = 40 * rng.uniform(0.8, 1.25, 2)
    rim = np.insert(flat_rim(int(rng.integers(3)), a, b), 2, 1.1 * max(a, b), axis=1)
    stretch, modulus = float(rng.uniform(1.02, 1.3)), float(0.02 * 5 ** rng.uniform())
    height = float(rng.uniform(max(0.1, 4 * off), 0.3) * (a * b) ** 0.5)
    formed = formed_surface(rim, SheetMaterial("neo_hookean", stretch), height=height)
    error = next(z for z in rng.standard_normal(100) if abs(z) < 2)
    gauge = formed.pressure * modulus / hectopascal("mm")
    return Drawn(rim, Sheet(stretch, modulus, gauge), tm.Membrane(formed.vertices).size, off, error)


class Window:
    """A simulated window: at rest and pressed, on the mesh of its `Twin`, and as a camera sees it."""

    def __init__(self, made: Drawn, rng: np.random.Generator) -> None:
        self.made, self.rng, self.twin = made, rng, Twin(made.rim, made.sheet)
        distance = made.rim[:, 2].mean()
        self.camera = tm.Camera("pinhole", (640, 480), (480.0, 480.0), (321.0, 238.0))
        self.rest, self.dots = self.twin.blown_up(), lattice(self.twin)
        self.height = float(self.rest[:, 2].max()) - distance
        gas = float(self.twin.volume(self.rest) - self.twin.volume(self.twin.sheet))
        self.presses = [self._pressed(gas) for _ in range(PRESSES)]

    def _pressed(self, gas: float) -> tuple[Tensor, Tensor]:
        """Vertices and force under a ball: its place, radius and depth at random."""
        size, rng = self.made.size, self.rng
        place = torch.from_numpy(rng.uniform(-0.12, 0.12, 2) * size)
        ball, depth = rng.uniform(0.15, 0.25) * size, rng.uniform(0.05, 0.09) * size
        top = self.rest[(self.rest[:, :2] - place).norm(dim=1).argmin(), 2:]
        return self.twin.pressed(self.rest, torch.cat([place, top + ball - depth]), gas, ball)

    def seen(self, x: Tensor) -> Tensor:
        """Pixels of the dots with the vertices at `x`, `[D, 2]`."""
        pixels = self.camera.point_to_pixel((x[self.dots[0]] * self.dots[1][..., None]).sum(1))
        return pixels + LOCATION_NOISE * torch.from_numpy(self.rng.standard_normal(pixels.shape))

    def sensor(self, height: float, gauge: float) -> tuple[tm.Sensor, Tensor, np.ndarray]:
        """What `init` makes of a height, mm, and a rest photograph; the pixels in it, `[D, 2]`, of those dots `[D]` that it
        places."""
        told = blown_up({"outline": self.made.rim}, "mm", Stated(height, None, ASSUMED_PRESTRETCH, None, 1.0))
        pixels = self.seen(self.rest)
        rays = self.camera.pixel_to_ray(pixels)
        origins, directions = rays.origin.numpy(), rays.direction.numpy()
        distance = told.surface.membrane((65, 65)).ray_points(origins, directions).distance
        kept = np.isfinite(distance)
        markers = Markers("dots", positions=(origins + distance[:, None] * directions)[kept])
        membrane, cavity = told.surface.membrane((33, 33)), Cavity("gas", AIR + gauge)
        sensor = tm.Sensor("window", "mm", self.camera, membrane, told.material, cavity, markers, told.surface)
        return sensor, pixels[kept], kept


def calibrated(made: Drawn, rng: np.random.Generator) -> dict:
    """Simulate a window and calibrate it: values found and true, and their standard deviations."""
    window, sheet = Window(made, rng), made.sheet
    height = window.height + made.error * made.off * made.size
    gauge = sheet.gauge * (1 + TOLD["gauge"] * rng.standard_normal())
    sensor, rest_pixels, kept = window.sensor(height, gauge)
    forces = np.array([float(force.norm()) for _, force in window.presses])
    given = (forces * (1 + TOLD["force"] * rng.standard_normal(PRESSES)))[:-1, None]
    pixels = torch.stack([window.seen(x)[kept] for x, _ in window.presses])
    began = time.process_time()
    known = KnownForces(given, TOLD["force"] * given[:, 0])
    rest_error = made.off * made.size / height
    found = material_from_pixels(sensor, pixels[:-1], known, overpressure=gauge, noise=LOCATION_NOISE, rest_error=rest_error)
    seconds = time.process_time() - began
    written = replace(found.sensor, record=Record(uncertainty=found.force_deviation))
    reconstructor = tm.Reconstructor(written)
    there = torch.cdist(reconstructor.rest_pixels.double(), rest_pixels).argmin(1)  # dots whose rays meet the surface found
    with torch.no_grad():
        result = reconstructor.from_pixels(pixels[-1:, there], rest_pixels=rest_pixels[there], noise=LOCATION_NOISE).frame(0)
    F = result["force"].astype(float)
    magnitude = float(np.linalg.norm(F))
    of_force = float(np.linalg.norm(result["force_deviation"] * F)) / magnitude
    return dict(
        off=made.off,
        height=window.height / made.size,
        height_found=[found.height[0] / window.height - 1, found.height[1] / window.height],
        height_error=made.error,
        rest_error=rest_error,
        true=[sheet.stretch, sheet.modulus, float(forces[-1])],
        found=[*found.values.tolist(), magnitude],
        deviation=[*found.deviations.tolist(), of_force],
        scale_deviation=found.force_deviation,
        status=int(result["status"]),
        contradictions=list(found.contradictions),
        seconds=seconds,
    )


def off_by(rows: list[dict]) -> np.ndarray:
    """Errors over their standard deviations, `[n, 3]`."""
    found, true, deviation = (np.array([row[key] for row in rows]) for key in ("found", "true", "deviation"))
    return (found - true) / deviation


def report(rows: list[dict]) -> list[dict]:
    """Coverage of all and by how far the rest shape is off; printed, and returned."""
    told = [row for row in rows if "refused" not in row]
    groups = []
    for off in (None, *WRONG):
        chosen = [row for row in told if off in (None, row["off"])]
        if not chosen:
            continue
        z = off_by(chosen)
        width = np.median([np.array(row["deviation"]) / row["found"] for row in chosen], axis=0)
        group = dict(off=off, sensors=len(chosen), held=(abs(z) < 1).mean(0).tolist(), within_two=(abs(z) < 2).mean(0).tolist())
        group |= dict(mean=z.mean(0).tolist(), spread=z.std(0).tolist(), width=width.tolist())
        groups.append(group)
        words = [
            f"{name} {group['held'][i]:.0%} ({group['mean'][i]:+.2f} ± {group['spread'][i]:.2f}; {width[i]:.1%})"
            for i, name in enumerate(NAMES)
        ]
        print(f"{'all' if off is None else f'off by {off:.0%}'}: {len(chosen)} sensors; {'; '.join(words)}")
    print(f"refused: {len(rows) - len(told)}; contradictions named: {sum(bool(row['contradictions']) for row in told)}")
    return groups


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sensors", type=int, default=102)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    torch.set_num_threads(1)
    before = json.loads(args.json.read_text())["rows"] if args.json and args.json.exists() else []
    rows = {row["sensor"]: row for row in before if row["seed"] == args.seed}
    for k in range(args.first, args.first + args.sensors):
        if k in rows:
            continue
        rng = np.random.default_rng([args.seed, k])
        made = drawn(k, rng)
        try:
            row = calibrated(made, rng)
        except tm.MembraneError as error:
            row = dict(off=made.off, refused=str(error))
        rows[k] = dict(sensor=k, seed=args.seed, **row)
        said = row.get("refused") or " ".join(f"{name} {z:+.2f}" for name, z in zip(NAMES, off_by([row])[0], strict=True))
        print(f"{k}: off by {made.off:.0%} x {made.error:+.2f}: {said}", flush=True)
        write(args.json, dict(rows=list(rows.values())))
    write(args.json, dict(groups=report(list(rows.values())), rows=list(rows.values())))


if __name__ == "__main__":
    main()
