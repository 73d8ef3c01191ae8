"""Eighteen presses of six sensors with images and truth: the CASES of accuracy/accuracy.py and others.

python -m bench.data.cases OUT [--seed 0] [--grid 48]

The six sensors have 137 to 187 dots: a dome far from the camera, seen by a pinhole lens, by a fisheye lens, and through
Plexiglas and water; a dome near a fisheye lens; a fingertip; and a half cylinder. There are three materials: neo-Hookean with
prestretches of 1.3 and 1.05, and Mooney-Rivlin. They are pressed by spheres, plates and cylinders, in some presses by two
bodies at once, 1.5 to 4 mm deep with friction 0 to 0.8; one ball slides. For each press, NAME_clean.png, NAME_snr30.png (30 dB
of noise) and NAME_truth.npz are written, in the form of `torchmembrane simulate`; index.json lists them. The seed determines
places and directions. The project's simulator solves the equilibrium on a finer grid than the estimator's. Existing files are
kept, and the time of each press is printed in seconds.
"""

import argparse
import json
import time
from dataclasses import replace
from itertools import islice
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from PIL import Image

from bench.data.random_sensors import INCREMENT
from torchmembrane.camera.model import Camera
from torchmembrane.errors import MembraneError
from torchmembrane.files.images import to_grey
from torchmembrane.presets.design import cylinder_dots, dome_dots
from torchmembrane.sensor.parts import Cavity, Markers, Material, Surface
from torchmembrane.sensor.sensor import Sensor
from torchmembrane.sensor.toml import default_grid
from torchmembrane.simulate.appearance import Appearance, noisy
from torchmembrane.simulate.dataset import stroke_to
from torchmembrane.simulate.indenters import Cylinder, Indenter, Plane, Sphere
from torchmembrane.simulate.quasi_static import Press, presses
from torchmembrane.simulate.render import Renderer
from torchmembrane.simulate.simulator import Simulator, Stroke

NOISE_LEVEL = 30.0  # dB
OFF_RIM, TILT = 0.25, 20.0  # of places, over the surface's size; of directions, degrees
ATTEMPTS = 20
CENTRE = (317.5, 243.0)
MATERIALS = {
    "nh130": Material("neo_hookean", 1.3, shear_modulus=1.0, thickness=1.0),
    "nh105": Material("neo_hookean", 1.05, shear_modulus=1.0, thickness=1.0),
    "mr130": Material("mooney_rivlin", 1.3, 0.1, shear_modulus=1.0, thickness=1.0),
}
DOME = {"rim_radius": 12.5, "height": 8.5}
SENSORS = {  # surface, about how many dots, lens, focal length in px, through a port
    "dome15_pinhole": (Surface("spherical_cap", DOME | {"base_z": 16.0}), 121, "pinhole", 280.0, False),
    "dome15_fisheye": (Surface("spherical_cap", DOME | {"base_z": 16.0}), 121, "fisheye", 325.0, False),
    "dome15_port": (Surface("spherical_cap", DOME | {"base_z": 16.0}), 121, "pinhole", 172.0, True),
    "dome3_fisheye": (Surface("spherical_cap", DOME | {"base_z": 3.5}), 121, "fisheye", 165.0, False),
    "finger_fisheye": (Surface("ellipsoid_cap", {"semi_axes": [12.5, 9.5, 11.5], "base_z": 5.0}), 121, "fisheye", 195.0, False),
    "halfcyl_fisheye": (
        Surface("half_cylinder", {"radius": 10.5, "length": 42.0, "half_angle": 78.0, "base_z": 6.0}),
        169,
        "fisheye",
        210.0,
        False,
    ),
}


class Case(NamedTuple):
    """One press: sensor, material, bodies, friction, depth and slide in mm."""

    sensor: str
    material: str
    bodies: tuple[Indenter, ...]
    friction: float
    depth: float
    slide: float = 0.0


CASES = (
    Case("dome15_pinhole", "nh130", (Sphere(4.2),), 0.3, 3.0),
    Case("dome15_pinhole", "mr130", (Cylinder(1.8),), 0.3, 2.0),
    Case("dome15_pinhole", "nh130", (Sphere(5.5),), 0.8, 4.0),
    Case("dome15_fisheye", "mr130", (Plane(),), 0.0, 2.5),
    Case("dome15_fisheye", "nh105", (Sphere(6.0),), 0.8, 3.0),
    Case("dome15_port", "nh130", (Sphere(2.8), Sphere(3.8)), 0.0, 2.0),
    Case("dome3_fisheye", "nh130", (Sphere(3.8),), 0.0, 3.0),
    Case("dome3_fisheye", "nh130", (Plane(),), 0.8, 3.0),
    Case("dome3_fisheye", "nh105", (Sphere(3.2),), 0.3, 2.0),
    Case("dome3_fisheye", "nh130", (Sphere(3.0), Cylinder(1.8)), 0.0, 1.5),
    Case("dome3_fisheye", "nh130", (Sphere(4.5),), 0.8, 2.5, 1.0),
    Case("finger_fisheye", "nh130", (Sphere(4.2),), 0.0, 2.0),
    Case("finger_fisheye", "nh130", (Plane(),), 0.8, 2.5),
    Case("finger_fisheye", "nh105", (Sphere(4.8),), 0.0, 2.0),
    Case("finger_fisheye", "mr130", (Sphere(2.4), Sphere(3.4)), 0.0, 1.5),
    Case("halfcyl_fisheye", "nh130", (Sphere(5.2),), 0.0, 3.0),
    Case("halfcyl_fisheye", "mr130", (Cylinder(2.2),), 0.0, 2.5),
    Case("halfcyl_fisheye", "nh130", (Sphere(3.2), Sphere(4.0)), 0.0, 2.0),
)


def sensor_of(name: str, material: str) -> Sensor:
    """The sensor, with its rest image."""
    surface, count, lens, focal, behind = SENSORS[name]
    markers = Markers("dots", "dark", *_dots(surface, count))
    options = dict(ports=[(2.0, 2.5, 1.49)], medium_index=1.33) if behind else {}
    camera = Camera(lens, (640, 480), (focal, focal), CENTRE, **options)
    membrane = surface.membrane(default_grid(markers))
    sensor = Sensor(f"{name}_{material}", "mm", camera, membrane, MATERIALS[material], Cavity("liquid"), markers, surface)
    rest = noisy(Renderer(sensor)(membrane.rest), NOISE_LEVEL, np.random.default_rng(0))
    return replace(sensor, markers=replace(markers, rest_image=to_grey((255 * rest).round().byte().numpy())))


def _dots(surface: Surface, count: int) -> tuple[np.ndarray, list[str]]:
    """About so many dots of two sizes in a square pattern."""
    v = surface.values
    spacing = float(np.sqrt(0.86 * float(surface.membrane((17, 17)).rest_area.sum()) / count))
    if surface.shape == "half_cylinder":
        return cylinder_dots(v["radius"], v["length"], np.deg2rad(v["half_angle"]), v["base_z"], spacing)
    if surface.shape == "ellipsoid_cap":
        return dome_dots(v["semi_axes"], np.pi / 2, v["base_z"], spacing)
    sphere = (v["rim_radius"] ** 2 + v["height"] ** 2) / (2 * v["height"])
    return dome_dots((sphere,) * 3, float(np.arctan2(v["rim_radius"], sphere - v["height"])), v["base_z"], spacing)


def strokes_of(simulator: Simulator, case: Case, rng: np.random.Generator) -> list[Stroke]:
    """One stroke a body, towards places off the rim and apart from one another, up to `TILT` off the normal."""
    X, normals, fixed = (
        a.numpy() for a in (simulator.membrane.rest, simulator.membrane.rest_normals, simulator.membrane.fixed)
    )
    free = np.linalg.norm(X[:, None] - X[fixed], axis=-1).min(1) > OFF_RIM * simulator.membrane.size
    apart, strokes = sum(float(getattr(body, "radius", 0.0)) for body in case.bodies) + 1.0, []
    for body in case.bodies:
        weight = np.where(free, simulator.membrane.rest_area.numpy(), 0.0)
        target = rng.choice(len(X), p=weight / weight.sum())
        across = np.cross(normals[target], rng.normal(size=3))
        across /= np.linalg.norm(across)
        travel = -normals[target] + np.tan(np.deg2rad(TILT * rng.random())) * across
        options = dict(turn=rng.uniform(0, 2 * np.pi), slide=case.slide * across, friction=case.friction)
        strokes.append(stroke_to(simulator, body, X[target], travel, case.depth, **options))
        free &= np.linalg.norm(X - X[target], axis=1) > apart
    return strokes


def pressed(simulator: Simulator, case: Case, strokes: list[Stroke]) -> Press:
    """The equilibrium at the strokes' end."""
    legs = ("push", "slide") if case.slide else ("push",)
    paths = [[stroke.indenter, *stroke.poses(legs, 1, 0.0)] for stroke in strokes]
    options = dict(friction=case.friction, increment=INCREMENT * simulator.membrane.size, **simulator.cavity)
    *_, last = islice(presses(simulator.membrane, simulator.elasticity, paths, **options), 1, None)
    return last


def write(out: Path, number: int, case: Case, args: argparse.Namespace) -> dict:
    """One press' files, and its line of the index."""
    name, folder = f"p{number:02d}", out / case.sensor
    sensor_file = folder / case.material / "sensor.toml"
    images, truth = [folder / f"{name}_{kind}.png" for kind in ("clean", "snr30")], folder / f"{name}_truth.npz"
    if not sensor_file.exists():
        sensor_file.parent.mkdir(parents=True, exist_ok=True)
        sensor_of(case.sensor, case.material).to_file(sensor_file)
    if not truth.exists():
        clean, noise = (
            Simulator(Sensor.from_file(sensor_file), (args.grid, args.grid), Appearance(noise=decibel))
            for decibel in (None, NOISE_LEVEL)
        )
        rng = np.random.default_rng([args.seed, number])
        state, strokes = _followed(clean, case, rng)
        Image.fromarray(clean.image(state.vertices, rng)).save(images[0])
        frame = noise.frame(state, strokes[0], rng)
        Image.fromarray(frame.image).save(images[1])
        described = np.array(json.dumps([stroke.described() for stroke in strokes]))
        np.savez_compressed(truth, **frame.truth | {"stroke": described})
    relative = [str(path.relative_to(out)) for path in (sensor_file, *images, truth)]
    return dict(
        case=name,
        folder=case.sensor,
        sensor=relative[0],
        images=relative[1:3],
        truth=relative[3],
        bodies=[body.kind for body in case.bodies],
        friction=case.friction,
        depth=case.depth,
        slide=case.slide,
        material=case.material,
    )


def _followed(simulator: Simulator, case: Case, rng: np.random.Generator) -> tuple[Press, list[Stroke]]:
    """Strokes that the membrane can follow; others are drawn again."""
    for _ in range(ATTEMPTS):
        try:
            strokes = strokes_of(simulator, case, rng)
            state = pressed(simulator, case, strokes)
        except MembraneError as error:
            reason = str(error)
            continue
        if bool(torch.isfinite(state.contact_points).all()) and float(state.vertices[:, 2].min()) > 0:
            return state, strokes
        reason = "a body does not touch"
    raise MembraneError(f"{case.sensor}: none of {ATTEMPTS} strokes can be followed; the last one: {reason}")


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--grid", type=int, default=48)
    args = parser.parse_args()
    index = []
    for number, case in enumerate(CASES):
        began = time.perf_counter()
        index.append(write(args.out, number, case, args))
        print(f"{index[-1]['case']} {case.sensor} {case.material}: {time.perf_counter() - began:.0f} s", flush=True)
    (args.out / "index.json").write_text(json.dumps(index, indent=1) + "\n")


if __name__ == "__main__":
    main()
