"""Forces after one known weight: of sensors whose modulus and prestretch nobody knows, one press is known, others compared.

python -m bench.accuracy.weight [--sensors dome_24 bubble_60 ... | --others] [--json FILE]

Twenty sensors: domes, caps, bubbles of gas, fingertips and half cylinders of 12 to 80 mm across, liquid, gas and open,
prestretched 1.05 to 1.7. Each is pressed by balls in five ways by the simulator, 0.03 to 0.12 of its size deep, and rendered
with 40 dB of noise (seed: the sensor's place in the list), as its rest image is. The sensor file says prestretch 1.2 and no
modulus. Each row: which press was the weight, what was found of the material, how surely the scale is said to be known, and all
five forces found over true ones, in brackets where the reading says itself that it is known worse than that; or why the weight
was refused. The last line counts those without brackets. `--others`: ten more sensors of the same kinds, on which nothing was
chosen.
"""

import argparse
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch

import torchmembrane as tm
from bench.data.record import write
from torchmembrane.calibrate.weight import SURE, material_from_weight
from torchmembrane.camera.model import Camera
from torchmembrane.presets.draft import drafted_dots, drafted_surface, focal_of_view
from torchmembrane.sensor.parts import Cavity, Markers, Material
from torchmembrane.sensor.toml import default_grid
from torchmembrane.simulate.appearance import noisy
from torchmembrane.simulate.dataset import stroke_to

PRESSES = [
    (0.10, (0, 0, -1)),
    (0.05, (0.3, 0, -0.95)),
    (0.12, (0, 0.2, -1)),
    (0.08, (-0.3, 0.2, -0.9)),
    (0.03, (0.1, -0.2, -1)),
]
WEIGHTS = (0, 1, 4)  # the presses that are known: a deep one, one half as deep and the lightest
AIR = 1013.0
IMAGE = (640, 480)


class Drawn(NamedTuple):
    """A sensor as it is drawn: shape, lengths in mm, distance, lens and view, filling, prestretch."""

    shape: str
    lengths: dict
    distance: float
    lens: str
    view: float
    filling: str
    prestretch: float


SENSORS = {
    "dome_24": Drawn("dome", {"radius": 12.0}, 15.0, "fisheye", 120.0, "liquid", 1.35),
    "dome_24_slack": Drawn("dome", {"radius": 12.0}, 15.0, "fisheye", 120.0, "liquid", 1.08),
    "dome_40": Drawn("dome", {"radius": 20.0}, 30.0, "fisheye", 100.0, "liquid", 1.6),
    "dome_16_gas": Drawn("dome", {"radius": 8.0}, 12.0, "fisheye", 110.0, "gas", 1.25),
    "dome_60_open": Drawn("dome", {"radius": 30.0}, 45.0, "fisheye", 100.0, "open", 1.2),
    "cap_30": Drawn("cap", {"radius": 15.0, "height": 7.0}, 25.0, "pinhole", 85.0, "liquid", 1.2),
    "cap_50": Drawn("cap", {"radius": 25.0, "height": 15.0}, 40.0, "pinhole", 85.0, "liquid", 1.45),
    "cap_80_gas": Drawn("cap", {"radius": 40.0, "height": 30.0}, 60.0, "pinhole", 90.0, "gas", 1.15),
    "cap_36_open": Drawn("cap", {"radius": 18.0, "height": 10.0}, 28.0, "pinhole", 90.0, "open", 1.3),
    "bubble_60": Drawn("bubble", {"radius": 30.0, "height": 18.0}, 60.0, "pinhole", 75.0, "gas", 1.1),
    "bubble_60_taut": Drawn("bubble", {"radius": 30.0, "height": 18.0}, 60.0, "pinhole", 75.0, "gas", 1.6),
    "bubble_40": Drawn("bubble", {"radius": 20.0, "height": 10.0}, 45.0, "pinhole", 70.0, "gas", 1.3),
    "bubble_80": Drawn("bubble", {"radius": 40.0, "height": 32.0}, 70.0, "pinhole", 85.0, "gas", 1.4),
    "fingertip_22": Drawn("fingertip", {"semi_axes": [11.0, 9.0, 11.0]}, 14.0, "fisheye", 120.0, "liquid", 1.2),
    "fingertip_16": Drawn("fingertip", {"semi_axes": [8.0, 8.0, 10.0]}, 12.0, "fisheye", 120.0, "liquid", 1.5),
    "fingertip_30_gas": Drawn("fingertip", {"semi_axes": [15.0, 12.0, 13.0]}, 22.0, "fisheye", 110.0, "gas", 1.05),
    "fingertip_24_open": Drawn("fingertip", {"semi_axes": [12.0, 10.0, 9.0]}, 18.0, "fisheye", 110.0, "open", 1.3),
    "cylinder_20": Drawn(
        "half_cylinder", {"radius": 10.0, "length": 40.0, "half_angle": 70.0}, 22.0, "fisheye", 120.0, "liquid", 1.3
    ),
    "cylinder_12": Drawn(
        "half_cylinder", {"radius": 6.0, "length": 20.0, "half_angle": 60.0}, 14.0, "fisheye", 110.0, "liquid", 1.1
    ),
    "cylinder_40_gas": Drawn(
        "half_cylinder", {"radius": 20.0, "length": 60.0, "half_angle": 65.0}, 40.0, "fisheye", 110.0, "gas", 1.7
    ),
}

OTHERS = {
    "dome_30": Drawn("dome", {"radius": 15.0}, 20.0, "fisheye", 110.0, "liquid", 1.18),
    "cap_24_gas": Drawn("cap", {"radius": 12.0, "height": 6.0}, 20.0, "pinhole", 85.0, "gas", 1.35),
    "cap_60": Drawn("cap", {"radius": 30.0, "height": 14.0}, 48.0, "pinhole", 85.0, "liquid", 1.25),
    "cap_44": Drawn("cap", {"radius": 22.0, "height": 18.0}, 36.0, "pinhole", 90.0, "liquid", 1.12),
    "bubble_50": Drawn("bubble", {"radius": 25.0, "height": 12.0}, 55.0, "pinhole", 70.0, "gas", 1.22),
    "bubble_34": Drawn("bubble", {"radius": 17.0, "height": 9.0}, 38.0, "pinhole", 70.0, "gas", 1.42),
    "bubble_70": Drawn("bubble", {"radius": 35.0, "height": 24.0}, 65.0, "pinhole", 80.0, "gas", 1.16),
    "fingertip_26": Drawn("fingertip", {"semi_axes": [13.0, 10.0, 12.0]}, 18.0, "fisheye", 115.0, "liquid", 1.38),
    "cylinder_30": Drawn(
        "half_cylinder", {"radius": 15.0, "length": 50.0, "half_angle": 65.0}, 30.0, "fisheye", 115.0, "liquid", 1.2
    ),
    "cylinder_16_gas": Drawn(
        "half_cylinder", {"radius": 8.0, "length": 26.0, "half_angle": 65.0}, 18.0, "fisheye", 110.0, "gas", 1.45
    ),
}
ALL = SENSORS | OTHERS


def sensor_of(name: str) -> tm.Sensor:
    """The sensor with its rest image, rendered with noise."""
    drawn, size = ALL[name], (IMAGE[0] / 2 - 0.5, IMAGE[1] / 2 - 0.5)
    surface = drafted_surface(drawn.shape, drawn.lengths, drawn.distance)
    camera = Camera(drawn.lens, IMAGE, (focal_of_view(drawn.lens, IMAGE[0], drawn.view),) * 2, size)
    markers = Markers("dots", "dark", *drafted_dots(surface, None))
    membrane = surface.membrane(default_grid(markers))
    material = Material("neo_hookean", drawn.prestretch, None, 0.3, 0.01 * membrane.size)
    cavity = Cavity(drawn.filling, AIR if drawn.filling == "gas" else None)
    sensor = tm.Sensor(name, "mm", camera, membrane, material, cavity, markers, surface)
    rest = noisy(tm.simulate.Renderer(sensor)(membrane.rest), 40.0, np.random.default_rng([1, _seed(name)]))
    return replace(sensor, markers=replace(markers, rest_image=rest.numpy()))


def _seed(name: str) -> int:
    return list(ALL).index(name)


def presses(sensor: tm.Sensor) -> tuple[torch.Tensor, np.ndarray]:
    """Images `[B, 1, H, W]` of the presses, and their forces `[B]`."""
    simulator = tm.simulate.Simulator(sensor, None, tm.simulate.Appearance(noise=40.0))
    rest, size, rng = sensor.membrane.rest, sensor.membrane.size, np.random.default_rng(_seed(sensor.name))
    aim, images, forces = rest[sensor.membrane.fixed].mean(0).numpy(), [], []
    for depth, direction in PRESSES:
        way = np.array(direction) / np.linalg.norm(direction)
        stroke = stroke_to(simulator, tm.simulate.Sphere(size / 7), aim, way, depth * size)
        *_, state = simulator.presses(stroke, ("push",))
        images.append(simulator.frame(state, stroke, rng).image)
        forces.append(float(state.force.norm()))
    stacked = torch.from_numpy(np.stack(images).astype(np.float64))
    return (stacked / 255 if images[0].dtype == np.uint8 else stacked)[:, None], np.array(forces)


def report(name: str) -> list[dict]:
    """Print what each weight gives; returns a row for each weight, with the other presses' forces found over true."""
    truth, rows = sensor_of(name), []
    images, forces = presses(truth)
    told = replace(truth, material=replace(truth.material, prestretch=1.2, shear_modulus=None, thickness=None))
    for known in WEIGHTS:
        begun = f"{name}: weight {forces[known]:.3g} N, {PRESSES[known][0]} of the size deep:"
        try:
            found = material_from_weight(told, images[known : known + 1], forces[known])
        except tm.MembraneError as error:
            print(begun, f"refused: {error}", flush=True)
            rows.append(dict(sensor=name, weight=known, refused=str(error)))
            continue
        with torch.no_grad():
            result = tm.Reconstructor(found.sensor)(images)
        magnitude = result.force.norm(dim=1)
        ratio = magnitude.numpy() / forces
        sure = ((result.force_deviation * result.force).norm(dim=1) / magnitude**2 < SURE).numpy()
        others = np.arange(len(PRESSES)) != known
        row = dict(sensor=name, weight=known, ratios=ratio[sure & others].tolist(), unsure=ratio[~sure & others].tolist())
        rows.append(row | dict(deviation=found.deviation))
        stretch, sigma = found.sensor.material.prestretch, found.material.deviations[0]
        words = " ".join(f"{r:.3f}" if s else f"({r:.3f})" for r, s in zip(ratio, sure, strict=True))
        print(
            begun,
            f"prestretch {stretch:.3f} +- {sigma:.3f} ({truth.material.prestretch}), scale to {found.deviation:.1%};",
            words,
            flush=True,
        )
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sensors", nargs="+", default=list(SENSORS), choices=list(ALL), metavar="NAME")
    parser.add_argument("--others", dest="sensors", action="store_const", const=list(OTHERS))
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    torch.set_num_threads(1)
    rows = [row for name in args.sensors for row in report(name)]
    errors = [abs(ratio - 1) for row in rows for ratio in row.get("ratios", ())]
    words = " ".join(f"{np.quantile(errors, q):.3f}" for q in (0.5, 0.9, 1.0))
    print(f"{len(errors)} forces of other presses, off by, median, 90 %, largest: {words}")
    write(args.json, dict(rows=rows))


if __name__ == "__main__":
    main()
