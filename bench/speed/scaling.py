"""What a frame costs against grid lines, dots, image size and batch, with exponents.

python -m bench.speed.scaling [--turns 5] [--json FILE]

A dome of radius 20 with a fisheye camera in it, pressed by a ball; of 33 x 33 lines, some 150 dots and 640 x 480 pixels but for
what is varied. Markers (image to flow) and solve (flow to result, from rest) apart, one thread, processor time, the least of
several turns. The exponent is the slope of a line through the logarithms of the upper half of a row.
"""

import argparse
import time
import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

import torchmembrane as tm
from bench.data.record import write
from bench.measure.scaling_tables import PARTS, exponent
from torchmembrane.camera.model import Camera
from torchmembrane.files.images import to_grey
from torchmembrane.presets.design import dome_dots
from torchmembrane.sensor.parts import Cavity, Markers, Material, Surface
from torchmembrane.sensor.sensor import Sensor
from torchmembrane.simulate.appearance import noisy
from torchmembrane.simulate.dataset import stroke_to
from torchmembrane.simulate.indenters import Sphere
from torchmembrane.simulate.render import Renderer
from torchmembrane.simulate.simulator import Simulator

RADIUS, BASE_Z, NOISE_LEVEL = 20.0, 4.0, 35.0
USUAL = dict(lines=33, dots=150, width=640, batch=1)
SWEEPS = dict(
    lines=(9, 13, 17, 25, 33, 49, 65),
    dots=(20, 40, 80, 150, 300, 600, 1000),
    width=(320, 640, 1280, 1920),
    batch=(1, 2, 4, 8, 16, 32, 64),
)
HEIGHT = {320: 240, 640: 480, 1280: 960, 1920: 1200}


def dome(lines: int, dots: int, width: int) -> Sensor:
    """The dome without a rest image, with about so many dots."""
    height, spacing = HEIGHT[width], RADIUS * np.pi / 2 * (np.pi / 4 / dots) ** 0.5 * 1.8
    camera = Camera("fisheye", (width, height), (0.36 * height,) * 2, (width / 2 - 0.5, height / 2 - 0.5))
    surface = Surface("spherical_cap", dict(rim_radius=RADIUS, height=0.95 * RADIUS, base_z=BASE_Z))
    material = Material("neo_hookean", prestretch=1.2, shear_modulus=0.3, thickness=0.4)
    positions, sizes = dome_dots((RADIUS,) * 3, 1.5, BASE_Z, spacing)
    markers = Markers("dots", "dark", positions, sizes)
    return Sensor("dome", "mm", camera, surface.membrane((lines, lines)), material, Cavity("liquid"), markers, surface)


def measured(settings: dict, base: Simulator, pressed: torch.Tensor, turns: int) -> dict:
    """Milliseconds a frame."""
    bare, batch = dome(*(settings[key] for key in ("lines", "dots", "width"))), settings["batch"]
    renderer = Renderer(bare, base.grid)
    at_rest, image = (
        torch.from_numpy(to_grey((255 * noisy(renderer(x), NOISE_LEVEL, np.random.default_rng(seed))).round().byte().numpy()))
        for seed, x in enumerate((base.membrane.rest, pressed))
    )
    sensor = replace(bare, markers=replace(bare.markers, rest_image=at_rest.numpy()))
    reconstructor = tm.Reconstructor(sensor)
    images = image.expand(batch, 1, -1, -1).contiguous()
    with torch.no_grad():
        flow = reconstructor.observer(images)
        pixels = reconstructor.rest_pixels + flow.displacement
        parts = dict(
            markers=lambda: reconstructor.observer(images), solve=lambda: reconstructor.from_pixels(pixels, flow.confidence)
        )
        row = {name: 1e3 * least_seconds(part, turns) / batch for name, part in parts.items()}
        status = int(reconstructor(images).status[0])
    return dict(settings, dots=len(sensor.markers.positions), status=status, **row)


def least_seconds(function, turns: int) -> float:
    """Return the smallest processor time of `turns` calls, in seconds, after one call that is not counted."""
    times = []
    for _ in range(turns + 1):
        start = time.process_time()
        function()
        times.append(time.process_time() - start)
    return min(times[1:])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--turns", type=int, default=5)
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    warnings.simplefilter("ignore")
    torch.set_num_threads(1)
    base = Simulator(dome(33, 150, 640))
    stroke = stroke_to(base, Sphere(6.0), base.membrane.rest[len(base.membrane.rest) // 2], np.array([-0.2, 0.1, -1.0]), 3.0)
    pressed, table = list(base.presses(stroke, ["push"]))[-1].vertices, {}
    for sweep, values in SWEEPS.items():
        table[sweep] = [measured(USUAL | {sweep: value}, base, pressed, args.turns) for value in values]
        for row in table[sweep]:
            print(f"{sweep:6s} {row[sweep]:5d}: " + ", ".join(f"{part} {row[part]:.1f} ms" for part in PARTS), flush=True)
        print(f"exponents of {sweep}: " + ", ".join(f"{part} {exponent(table[sweep], sweep, part):.2f}" for part in PARTS))
    write(args.json, dict(rows=table))


if __name__ == "__main__":
    main()
