"""The rim found in rendered photographs: how far centre and half axes are off, px.

python -m bench.accuracy.rim [--json FILE]

Two domes, two caps and a bubble, the lens' centre up to 15 px off the image's (seed 0), each in six lights: darker and lighter
outside, noise of 30 to 40 dB, blur up to 2 px, highlights, vignetting, light from one side.
"""

import argparse
from pathlib import Path

import numpy as np
import torch

import torchmembrane as tm
from bench.data.record import write
from torchmembrane.calibrate.rim import find_rim
from torchmembrane.camera.model import Camera
from torchmembrane.markers.dots.pattern import find_dots
from torchmembrane.presets.draft import drafted_dots, drafted_surface, focal_of_view
from torchmembrane.sensor.parts import Cavity, Markers, Material
from torchmembrane.simulate.appearance import noisy

SENSORS = [
    ("dome", {"radius": 12.0}, 15.0, "fisheye", 120.0),
    ("dome", {"radius": 20.0}, 30.0, "fisheye", 100.0),
    ("cap", {"radius": 15.0, "height": 7.0}, 25.0, "pinhole", 85.0),
    ("cap", {"radius": 25.0, "height": 15.0}, 32.0, "pinhole", 90.0),
    ("bubble", {"radius": 30.0, "height": 18.0}, 60.0, "pinhole", 75.0),
]
LIGHTS = [
    {},
    {"outside": 0.3, "noise": 40.0},
    {"outside": 0.9, "noise": 35.0},
    {"highlight": 0.5, "vignetting": 0.6, "noise": 30.0},
    {"lights": [[8, 0, 0]], "ambient": 0.2, "blur": 1.5, "noise": 35.0},
    {"outside": 0.5, "blur": 2.0, "noise": 30.0},
]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    torch.set_num_threads(1)
    rng, largest, rows = np.random.default_rng(0), 0.0, []
    for shape, lengths, distance, lens, view in SENSORS:
        surface, focal = drafted_surface(shape, lengths, distance), focal_of_view(lens, 640, view)
        u, v = 319.5 + rng.uniform(-15, 15), 239.5 + rng.uniform(-15, 15)
        camera, markers = Camera(lens, (640, 480), (focal, focal), (u, v)), Markers("dots", "dark", *drafted_dots(surface))
        membrane = surface.membrane((17, 17))
        sensor = tm.Sensor(shape, "mm", camera, membrane, Material("neo_hookean", 1.2), Cavity("liquid"), markers, surface)
        radius = float(camera.point_to_pixel(torch.tensor([lengths["radius"], 0.0, distance]).double())[0]) - u
        for light in LIGHTS:
            appearance = tm.simulate.Appearance(**light)
            image = noisy(tm.simulate.Renderer(sensor, appearance=appearance)(membrane.rest), appearance.noise, rng).numpy()
            try:
                rim = find_rim(image, find_dots(image, "dark").pixels)
            except tm.MembraneError as error:
                rows.append(dict(shape=shape, light=light, refused=str(error)))
                print(f"{shape} {radius:.1f} px, {light}: refused: {error}", flush=True)
                continue
            off = np.array([rim.centre[0] - u, rim.centre[1] - v, *(axis - radius for axis in rim.half_axes)])
            rows.append(dict(shape=shape, light=light, off=float(abs(off).max())))
            largest = max(largest, rows[-1]["off"])
            print(f"{shape} {radius:.1f} px, {light}: off by {off.round(2).tolist()}, said {rim.deviation:.2f}", flush=True)
    print(f"largest error: {largest:.2f} px")
    write(args.json, dict(rows=rows))


if __name__ == "__main__":
    main()
