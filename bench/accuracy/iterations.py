"""Narrow presses on the axis of domes: whether answers get worse the longer the finest grid is iterated.

python -m bench.accuracy.iterations [--presses 36] [--steps 4 8 16 32 64] [--seed 0] [--json FILE]

Caps with rim radii of 8 to 40 and random heights, prestretch and fillings, each pressed once on its axis by a ball with a
radius of 0.1 to 0.2 of the cap's size, 0.05 to 0.2 of it deep, with friction of 0 or 0.3. The markers are where their centres
are seen, with 0.03 px of noise. Every row takes so many steps on the finest grid, settled or not. Printed: errors of the
surface at the markers over their displacement and of the force, median, 90 % and worst; with the default settings in the last
row.
"""

import argparse
import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

import torchmembrane as tm
from bench.accuracy.basins import errors
from bench.data.record import write
from torchmembrane.presets.design import dome_dots
from torchmembrane.sensor.parts import Cavity, Markers, Material, Surface
from torchmembrane.sensor.toml import default_grid
from torchmembrane.simulate.dataset import stroke_to

LOCATION_NOISE = 0.03  # px
IMAGE = (640, 480)


def random_dome(rng: np.random.Generator) -> tm.Sensor:
    """A cap in front of a fisheye camera."""
    radius = float(np.exp(rng.uniform(*np.log([8, 40]))))
    height, near = radius * rng.uniform(0.3, 0.9), radius * rng.uniform(0.4, 1.5)
    surface = Surface("spherical_cap", {"rim_radius": radius, "height": height, "base_z": near})
    sphere = (radius**2 + height**2) / (2 * height)
    spacing = float(np.sqrt(surface.membrane((17, 17)).rest_area.sum() / rng.uniform(80, 200)))
    positions, sizes = dome_dots((sphere,) * 3, float(np.arctan2(radius, sphere - height)), near, spacing)
    markers = Markers("dots", "dark", positions, sizes)
    camera = tm.Camera("fisheye", IMAGE, (170.0, 170.0), (320.0, 240.0))
    material = Material("neo_hookean", float(1 + np.exp(rng.uniform(*np.log([0.02, 0.5])))), None)
    material = replace(material, shear_modulus=0.3, thickness=0.01 * radius)
    cavity = Cavity(str(rng.choice(["liquid", "open"])))
    return tm.Sensor("dome", "mm", camera, surface.membrane(default_grid(markers)), material, cavity, markers, surface)


def axial_press(sensor: tm.Sensor, rng: np.random.Generator) -> dict:
    """Truth of one press, with `pixels [D, 2]`."""
    simulator, size = tm.simulate.Simulator(sensor), sensor.membrane.size
    aim, way = np.array([0.0, 0.0, float(sensor.membrane.rest[:, 2].max())]), np.array([0.0, 0.0, -1.0])
    ball, depth = tm.simulate.Sphere(size * rng.uniform(0.1, 0.2)), size * rng.uniform(0.05, 0.2)
    stroke = stroke_to(simulator, ball, aim, way, depth, friction=float(rng.choice([0.0, 0.3])))
    *_, state = simulator.presses(stroke, ("push",))
    truth = simulator.frame(state, stroke, rng).truth
    return dict(truth, pixels=truth["uv_deformed"] + LOCATION_NOISE * rng.standard_normal(truth["uv_deformed"].shape))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--presses", type=int, default=36)
    parser.add_argument("--steps", type=int, nargs="+", default=[4, 8, 16, 32, 64])
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    torch.set_num_threads(1)
    warnings.simplefilter("ignore")
    default = tm.ForceBalanceSettings()
    coarsest, second, _ = default.steps
    rows = {f"{count} steps": replace(default, steps=(coarsest, second, count), settled_step_tol=0.0) for count in args.steps}
    rows["until settled"] = default
    found: dict[str, list[np.ndarray]] = {name: [] for name in rows}
    number = 0
    while len(found["until settled"]) < args.presses:
        rng, number = np.random.default_rng([args.seed, number]), number + 1
        try:
            sensor = random_dome(rng)
            truth = axial_press(sensor, rng)
        except tm.MembraneError:  # the simulator cannot follow this press
            continue
        for name, settings in rows.items():
            found[name].append(errors(tm.Reconstructor(sensor, settings=settings), [truth])[0])
    print("| finest grid | surface: median | 90 % | worst | force: median | 90 % | worst |\n|---|---|---|---|---|---|---|")
    for name, values in found.items():
        cells = (f"{part:.3f}" for column in np.array(values).T for part in (*np.quantile(column, [0.5, 0.9]), column.max()))
        print(f"| {name} | {' | '.join(cells)} |")
    write(args.json, dict(rows={name: np.array(values).tolist() for name, values in found.items()}))


if __name__ == "__main__":
    main()
