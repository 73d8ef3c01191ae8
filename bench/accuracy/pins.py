"""Pins of 1, 2 and 4 mm under a pressed dome, through rendered photographs: errors with their height in the file and without.

python -m bench.accuracy.pins [--heights 0,1,2,4] [--json FILE]

A dome of 24 mm across and 9 mm high, filled with liquid, prestretched 1.3, carries 121 pins, whose tips a fisheye sees. Balls
of 3 and 5 mm press it from three directions, 0.5, 1.5 and 2.5 mm deep; images have 40 dB of noise, the rest image too. Each
press is reconstructed by three files: one that lists the pins' feet and has their `height`; one with the `height` and no list,
whose tips are found in the rest image; and one without either, for which the tips are dots on the surface. Each line has the
median and the worst error of the displacement at all vertices, over the displacement, and of the force, over the force; how
many presses have the status ok, and how many of these a displacement that is wrong by more than a quarter; and the share of the
pins that is found. The height 0 is that of painted dots.
"""

import argparse
import warnings
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

import torchmembrane as tm
from bench.data.record import write
from torchmembrane.camera.model import Camera
from torchmembrane.sensor.parts import Cavity, Markers, Material, Surface
from torchmembrane.simulate import Simulator, Sphere
from torchmembrane.simulate.appearance import Appearance
from torchmembrane.simulate.dataset import stroke_to
from torchmembrane.simulate.quasi_static import Press, carried
from torchmembrane.simulate.simulator import SimulatedFrame

RIM, DOME, BASE = 12.0, 9.0, 15.0  # mm
RADIUS = 0.35  # of a tip, mm
GRID = (25, 25)
LINES = 11  # of pins
TOUCHES = (((0.0, 0.0), (0.0, 0.0, -1.0)), ((4.0, 1.0), (-0.35, -0.1, -0.93)), ((-3.0, -5.0), (0.2, 0.35, -0.92)))
BALLS, DEPTHS = (3.0, 5.0), (0.5, 1.5, 2.5)
WRONG = 0.25  # of the displacement


def dome(height: float) -> tm.Sensor:
    """The sensor, its pins of such a height."""
    surface = Surface("spherical_cap", {"rim_radius": RIM, "height": DOME, "base_z": BASE})
    fine = surface.membrane((2 * LINES + 3, 2 * LINES + 3))
    feet = fine.rest.numpy().reshape(2 * LINES + 3, -1, 3)[2:-1:2, 2:-1:2].reshape(-1, 3)
    camera = Camera("fisheye", (640, 480), (260.0, 260.0), (319.5, 239.5))
    material = Material("neo_hookean", 1.3, shear_modulus=0.3, thickness=0.4)
    markers = Markers("dots", "dark", feet, height=height)
    return tm.Sensor("dome", "mm", camera, surface.membrane(GRID), material, Cavity("liquid"), markers, surface)


def presses(simulator: Simulator) -> Iterator[tuple[Press, SimulatedFrame]]:
    """Balls on the dome, and their photographs."""
    for k, ((x, y), travel) in enumerate(TOUCHES):
        for ball in BALLS:
            for depth in DEPTHS:
                stroke = stroke_to(simulator, Sphere(ball), np.array([x, y, BASE + DOME]), np.array(travel), depth)
                (state,) = simulator.presses(stroke, ["push"])
                yield state, simulator.frame(state, stroke, np.random.default_rng([k, int(10 * ball), int(10 * depth)]))


def files(simulator: Simulator) -> dict[str, tm.Sensor]:
    """The sensor as its file may describe it."""
    known = simulator.at_rest()
    found = replace(known, markers=replace(known.markers, positions=None, sizes=None))
    return {"feet and height": known, "height": found, "no height": replace(found, markers=replace(found.markers, height=0.0))}


def rows_of(height: float) -> list[dict]:
    """What comes of all presses of pins of one height."""
    simulator = Simulator(dome(height), appearance=Appearance(noise=40.0), radii=(RADIUS, RADIUS))
    made = {name: tm.Reconstructor(sensor) for name, sensor in files(simulator).items()}
    rows = []
    for state, frame in presses(simulator):
        u = carried(state.vertices[None], simulator.membrane, simulator.sensor.membrane.rest)[0]
        u = u - simulator.sensor.membrane.rest
        for name, reconstructor in made.items():
            with torch.no_grad():
                found = reconstructor(frame.image)
            off = np.linalg.norm(found.force[0].numpy() - frame.truth["force"]) / np.linalg.norm(frame.truth["force"])
            rows.append(
                dict(
                    height=height,
                    file=name,
                    surface=float((found.displacement[0] - u).norm() / u.norm()),
                    force=float(off),
                    status=int(found.status[0]),
                    found=float((found.confidence[0] > 0).float().mean()),
                )
            )
    return rows


def print_table(rows: list[dict]) -> None:
    """A line for each height and file."""
    print(f"{'mm':>4} {'file':16}{'presses':>8}{'surface':>17}{'force':>22}{'ok':>10}{'wrong':>7}{'found':>7}")
    for height in dict.fromkeys(row["height"] for row in rows):
        for name in dict.fromkeys(row["file"] for row in rows):
            chosen = [row for row in rows if (row["height"], row["file"]) == (height, name)]
            surface, force, found = (np.array([row[key] for row in chosen]) for key in ("surface", "force", "found"))
            ok = np.array([row["status"] == 0 for row in chosen])
            both = (f"{np.nanmedian(values):>13.3f} / {np.nanmax(values):<7.3f}" for values in (surface, force))
            wrong = int((ok & (surface > WRONG)).sum())
            print(
                f"{height:>4g} {name:16}{len(chosen):>8}{''.join(both)}{ok.sum():>5}{wrong:>7}{found.mean():>7.2f}", flush=True
            )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--heights", default="0,1,2,4", help="of the pins, mm")
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    warnings.simplefilter("ignore")
    rows = [row for height in map(float, args.heights.split(",")) for row in rows_of(height)]
    print_table(rows)
    write(args.json, {"presses": rows})


if __name__ == "__main__":
    main()
