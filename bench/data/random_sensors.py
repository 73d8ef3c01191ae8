"""Random sensors, pressed at random, through images: the data of accuracy/range.py and accuracy/light.py.

python -m bench.data.random_sensors OUT [--sensors 250] [--first 0] [--presses 4] [--light 0] [--rest 0]

OUT/sNNNN holds a sensor: sensor.toml with its rest image, press_K.npz (an image with its truth, as of `torchmembrane
simulate`), and with --light N the frames light_K.npz of one stroke whose depth grows quadratically from the first touch; with
--rest N as many images at rest. Caps, ellipsoids and half cylinders of radius 8 to 60, prestretch 1.005 to 1.8, liquid, gas and
open, 40 to 300 dots and (one in ten) speckle, pinhole, fisheye and ports, views that cut the membrane (one in ten). No
body goes through the rim, which something rigid holds. The same for the same numbers. What is there is kept.
"""

import argparse
import signal
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from itertools import islice
from pathlib import Path

import numpy as np
import torch

from torchmembrane.camera.model import Camera
from torchmembrane.errors import MembraneError
from torchmembrane.files.images import to_grey
from torchmembrane.presets.design import cylinder_dots, dome_dots
from torchmembrane.sensor.parts import Cavity, Markers, Material, Surface
from torchmembrane.sensor.sensor import Sensor
from torchmembrane.sensor.toml import default_grid
from torchmembrane.simulate.appearance import Appearance, noisy
from torchmembrane.simulate.dataset import stroke_to
from torchmembrane.simulate.indenters import Box, Cylinder, Indenter, Plane, Sphere
from torchmembrane.simulate.pattern import Speckle
from torchmembrane.simulate.quasi_static import presses
from torchmembrane.simulate.render import Renderer
from torchmembrane.simulate.simulator import SimulatedFrame, Simulator, Stroke

IMAGE = (640, 480)
NOISE_LEVEL = (30.0, 40.0)  # dB
DEPTH = (0.02, 0.3)  # of presses, over the surface's size
LIGHT_DEPTH = (0.06, 0.15)  # at the end of a stroke that begins lightly
RADIUS = (0.08, 0.35)  # of bodies
OFF_RIM = 0.1
BODIES_TRIED = 30  # at a depth
INCREMENT = 0.03  # of the size, of a stroke
PATIENCE = 30  # s, for one equilibrium; a stroke that takes longer is drawn again
DOTS = (40, 300)
PRESTRETCH = (1.005, 1.8)
SHAPES = ("spherical_cap", "ellipsoid_cap", "half_cylinder")
BODIES = ("sphere", "sphere", "cylinder", "box", "plane")


def random_sensor(
    number: int, seed: int = 0, dots: tuple[float, float] = DOTS, prestretch: tuple[float, float] = PRESTRETCH
) -> Sensor:
    """The sensor of that number, with a noisy rest image."""
    rng = np.random.default_rng([seed, number])
    surface, outline = _surface(rng)
    positions, sizes = _dots(surface, outline, dots, rng)
    markers = Markers("dots", "dark", positions, sizes)
    membrane = surface.membrane(default_grid(markers))
    camera, shape = _camera(surface, rng, outline), str(rng.choice(["neo_hookean", "neo_hookean", "mooney_rivlin"]))
    material = Material(
        shape, float(1 + np.exp(rng.uniform(*np.log(np.array(prestretch) - 1)))), 0.1 if shape == "mooney_rivlin" else None
    )
    filling = str(rng.choice(["liquid", "liquid", "gas", "open"]))
    thickness = float(outline * np.exp(rng.uniform(*np.log([0.003, 0.02]))))
    material = replace(material, shear_modulus=0.3, thickness=thickness)
    cavity = Cavity(filling, 1013.0 if filling == "gas" else None)
    sensor = Sensor(f"s{number:04d}", "mm", camera, membrane, material, cavity, markers, surface)
    noise, pattern = rng.uniform(*NOISE_LEVEL), Speckle(0.02 * membrane.size, number) if rng.random() < 0.1 else None
    rest = noisy(Renderer(sensor, pattern=pattern)(membrane.rest), noise, np.random.default_rng([seed, number, 1]))
    rest = to_grey((255 * rest).round().byte().numpy())
    if pattern is not None:
        kept = Markers("texture", rest_image=rest)
        return replace(sensor, markers=kept, membrane=surface.membrane(default_grid(kept)))
    return replace(sensor, markers=replace(markers, rest_image=rest))


def _surface(rng: np.random.Generator) -> tuple[Surface, float]:
    """A rest surface, and the radius of its rim."""
    kind, radius = str(rng.choice(SHAPES, p=[0.5, 0.25, 0.25])), float(np.exp(rng.uniform(*np.log([8, 60]))))
    base = radius * rng.uniform(0.3, 2.0)
    if kind == "spherical_cap":
        return Surface(kind, {"rim_radius": radius, "height": radius * rng.uniform(0.25, 0.95), "base_z": base}), radius
    if kind == "ellipsoid_cap":
        axes = [radius, radius * rng.uniform(0.6, 1.0), radius * rng.uniform(0.5, 1.2)]
        return Surface(kind, {"semi_axes": axes, "base_z": base}), radius
    values = {"radius": radius, "length": radius * float(rng.uniform(1.5, 4)), "half_angle": float(rng.uniform(45, 80))}
    return Surface(kind, values | {"base_z": radius * rng.uniform(0.8, 2.5)}), radius


def _dots(
    surface: Surface, radius: float, least_most: tuple[float, float], rng: np.random.Generator
) -> tuple[np.ndarray, list[str]]:
    """So many dots, at positions of a square pattern."""
    v, count = surface.values, np.exp(rng.uniform(*np.log(least_most)))
    area = float(surface.membrane((17, 17)).rest_area.sum())
    spacing = float(np.sqrt(0.86 * area / count))
    if surface.shape == "half_cylinder":
        return cylinder_dots(radius, v["length"], np.deg2rad(v["half_angle"]), v["base_z"], spacing)
    if surface.shape == "ellipsoid_cap":
        return dome_dots(v["semi_axes"], np.pi / 2, v["base_z"], spacing)
    sphere = (radius**2 + v["height"] ** 2) / (2 * v["height"])
    return dome_dots((sphere,) * 3, float(np.arctan2(radius, sphere - v["height"])), v["base_z"], spacing)


def _camera(surface: Surface, rng: np.random.Generator, radius: float) -> Camera:
    """A camera that sees the surface fill its image, or in one of ten cases more than that."""
    near = float(surface.values["base_z"])
    centre = (IMAGE[0] / 2 + float(rng.uniform(-8, 8)), IMAGE[1] / 2 + float(rng.uniform(-8, 8)))
    lens = "fisheye" if near < 0.9 * radius else str(rng.choice(["pinhole", "fisheye"]))
    behind = bool(near > 0.6 * radius and rng.random() < 0.2)
    options = dict(ports=[(0.1 * near, 0.08 * near, 1.49)], medium_index=1.33) if behind else {}
    share = rng.uniform(1.1, 1.4) if rng.random() < 0.1 else rng.uniform(0.85, 0.97)
    rest = surface.membrane((17, 17)).rest
    focal = 0.5 * min(IMAGE)
    for _ in range(20):  # behind a port the image does not grow as the focal length
        seen = Camera(lens, IMAGE, (focal, focal), centre, **options).point_to_pixel(rest).numpy() - np.array(centre)
        focal *= float(share) / np.nanmax(abs(seen) / (np.array(IMAGE) / 2))
    return Camera(lens, IMAGE, (focal, focal), centre, **options)


def random_body(size: float, rng: np.random.Generator) -> Indenter:
    """A body that presses."""
    kind, radius = str(rng.choice(BODIES)), size * float(np.exp(rng.uniform(*np.log(RADIUS))))
    if kind == "sphere":
        return Sphere(radius)
    if kind == "cylinder":
        return Cylinder(radius)
    if kind == "box":
        return Box(torch.from_numpy(size * rng.uniform(0.15, 0.4, 3)), size * rng.uniform(0.02, 0.05))
    return Plane()


def random_stroke(simulator: Simulator, depths: tuple[float, float], rng: np.random.Generator) -> Stroke:
    """A stroke towards a point off the rim that the camera sees, up to 20 degrees off the normal there.

    Raises:
        MembraneError: every body drawn goes through the rim at that depth, which what holds the membrane keeps it from.
    """
    membrane, size = simulator.membrane, simulator.membrane.size
    X, normals, fixed = (a.numpy() for a in (membrane.rest, membrane.rest_normals, membrane.fixed))
    off_rim = np.linalg.norm(X[:, None] - X[fixed], axis=-1).min(1) > OFF_RIM * size
    seen = simulator.sensor.camera.point_to_pixel(membrane.rest).numpy()
    in_view = ((seen > 10) & (seen < np.array(IMAGE) - 10)).all(1)
    weight = np.where(off_rim & in_view, membrane.rest_area.numpy(), 0.0)
    depth, friction = size * np.exp(rng.uniform(*np.log(depths))), float(rng.choice([0.0, 0.0, 0.3, 0.6]))
    for _ in range(BODIES_TRIED):
        target = rng.choice(len(X), p=weight / weight.sum())
        across = np.cross(normals[target], rng.normal(size=3))
        travel = -normals[target] + np.tan(np.deg2rad(20 * rng.random())) * across / np.linalg.norm(across)
        body, turn = random_body(size, rng), rng.uniform(0, 2 * np.pi)
        stroke = stroke_to(simulator, body, X[target], travel, depth, turn=turn, friction=friction)
        if stroke.indenter.moved(depth * stroke.travel).distance(membrane.rest[membrane.fixed]).min() > 0:
            return stroke
    raise MembraneError(f"none of {BODIES_TRIED} bodies stays clear of the rim at {depth / size:.3g} of the size")


def press(simulator: Simulator, rng: np.random.Generator, depths: tuple[float, float] = DEPTH) -> SimulatedFrame:
    """One press that the membrane can follow."""
    (frame,) = stroke_frames(simulator, rng, depths, [1.0])
    return frame


def light_frames(simulator: Simulator, rng: np.random.Generator, count: int) -> list[SimulatedFrame]:
    """A stroke from the first touch on, its depth growing quadratically."""
    return stroke_frames(simulator, rng, LIGHT_DEPTH, [(k / count) ** 2 for k in range(1, count + 1)])


def stroke_frames(
    simulator: Simulator, rng: np.random.Generator, depths: tuple[float, float], shares: list[float]
) -> list[SimulatedFrame]:
    """Frames at these shares of a stroke's depth."""
    for _ in range(12):
        try:
            stroke = random_stroke(simulator, depths, rng)
            poses = [stroke.indenter, *(stroke.indenter.moved(stroke.depth * share * stroke.travel) for share in shares)]
            options = dict(friction=stroke.friction, increment=INCREMENT * simulator.membrane.size, **simulator.cavity)
            with patience(PATIENCE + 2 * len(shares)):
                states = list(islice(presses(simulator.membrane, simulator.elasticity, [poses], **options), 1, None))
        except (MembraneError, TimeoutError):
            continue
        if states[-1].contact.any() and min(float(state.vertices[:, 2].min()) for state in states) > 0:
            return [simulator.frame(state, stroke, rng) for state in states]
    raise MembraneError(f"{simulator.sensor.name}: no stroke can be followed")


@contextmanager
def patience(seconds: float) -> Iterator[None]:
    """Raise `TimeoutError` where what is done within takes longer."""

    def give_up(*_: object) -> None:
        raise TimeoutError

    signal.signal(signal.SIGALRM, give_up)
    signal.setitimer(signal.ITIMER_REAL, seconds)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)


def write(folder: Path, number: int, args: argparse.Namespace) -> None:
    """One sensor's files."""
    folder.mkdir(parents=True, exist_ok=True)
    if not (folder / "sensor.toml").exists():
        random_sensor(number, args.seed).to_file(folder / "sensor.toml")
    sensor = Sensor.from_file(folder / "sensor.toml")
    noise = np.random.default_rng([args.seed, number, 2]).uniform(*NOISE_LEVEL)
    simulator = Simulator(sensor, appearance=Appearance(noise=noise))

    def keep(name: str, frame: SimulatedFrame) -> None:
        np.savez_compressed(folder / name, image=frame.image, **frame.truth)

    for k in range(args.presses):
        if not (folder / f"press_{k}.npz").exists():
            keep(f"press_{k}.npz", press(simulator, np.random.default_rng([args.seed, number, 3, k])))
    if args.light and not (folder / "light_000.npz").exists():
        frames = light_frames(simulator, np.random.default_rng([args.seed, number, 4]), args.light)
        for k, frame in reversed(list(enumerate(frames))):
            keep(f"light_{k:03d}.npz", frame)
    for k in range(args.rest):
        image = simulator.image(simulator.membrane.rest, np.random.default_rng([args.seed, number, 5, k]))
        np.savez_compressed(folder / f"rest_{k:03d}.npz", image=image)


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path)
    parser.add_argument("--sensors", type=int, default=250)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--presses", type=int, default=4)
    parser.add_argument("--light", type=int, default=0)
    parser.add_argument("--rest", type=int, default=0)
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args()
    warnings.simplefilter("ignore")
    for number in range(args.first, args.first + args.sensors):
        try:
            write(args.out / f"s{number:04d}", number, args)
        except MembraneError as error:
            print(f"s{number:04d}: {error}", flush=True)


if __name__ == "__main__":
    main()
