"""Which mistakes in a sensor file or in handling end in status 7, and how often.

python -m bench.robustness.mistakes [--presses 4] [--json FILE]

Three sensors (dome, fingertip, half cylinder) are pressed in the simulator; the true camera sees the markers, with 0.05 px
noise, and a sensor reconstructs them that is wrong in one thing: the rest shape (height, radius or semi-axis), the camera
(focal length, distance to the rim, centre) or the rest image (of a camera that has moved or turned since, of another zoom).
Printed: of each mistake the statuses of the presses and by how much forces are off; then, of each kind of mistake, the
share of presses with status 7, with status ok, and with status ok though the force is off by over a quarter.
"""

import argparse
import json
import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

import torchmembrane as tm
from bench.data.record import write
from torchmembrane.presets.design import cylinder_dots, dome_dots
from torchmembrane.sensor.parts import Cavity, Markers, Material, Surface
from torchmembrane.simulate.dataset import stroke_to
from torchmembrane.simulate.indenters import Sphere
from torchmembrane.simulate.simulator import Simulator

CLOSE, LOCATION_NOISE, DEPTH = 0.25, 0.05, 0.1
SURFACES = {
    "dome": Surface("spherical_cap", {"rim_radius": 12.0, "height": 7.0, "base_z": 14.0}),
    "fingertip": Surface("ellipsoid_cap", {"semi_axes": [10.0, 8.0, 12.0], "base_z": 10.0}),
    "half cylinder": Surface("half_cylinder", {"radius": 10.0, "length": 24.0, "half_angle": 65.0, "base_z": 16.0}),
}
SHAPE = {"dome": "height", "fingertip": "semi_axes", "half cylinder": "radius"}


def sensor_of(name: str) -> tm.Sensor:
    """A sensor of this surface with some 80 dots."""
    surface = SURFACES[name]
    v = surface.values
    if name == "half cylinder":
        positions, sizes = cylinder_dots(v["radius"], v["length"], np.deg2rad(v["half_angle"]), v["base_z"], 2.6)
    elif name == "fingertip":
        positions, sizes = dome_dots(v["semi_axes"], np.pi / 2, v["base_z"], 2.6)
    else:
        radius = (v["rim_radius"] ** 2 + v["height"] ** 2) / (2 * v["height"])
        positions, sizes = dome_dots((radius,) * 3, float(np.arcsin(v["rim_radius"] / radius)), v["base_z"], 2.6)
    camera = tm.Camera("pinhole", (640, 480), (320.0, 320.0), (319.5, 239.5))
    material = Material("neo_hookean", 1.2, shear_modulus=0.3, thickness=0.4)
    markers = Markers("dots", "dark", positions, sizes)
    return tm.Sensor(name, "mm", camera, surface.membrane((17, 17)), material, Cavity("liquid"), markers, surface)


def with_surface(sensor: tm.Sensor, values: dict) -> tm.Sensor:
    """The sensor with another rest surface, its dots moved onto it along their rays."""
    surface = Surface(sensor.surface.shape, sensor.surface.values | values)
    membrane = surface.membrane(sensor.membrane.grid)
    fine = surface.membrane((129, 129)).rest
    found = []
    for dot in torch.from_numpy(sensor.markers.positions):
        ray = dot / dot.norm()
        off = torch.linalg.cross(fine, ray.expand_as(fine)).norm(dim=-1)
        near = fine[off.argsort()[:4]]
        found.append((near @ ray).mean() * ray)
    return replace(
        sensor, membrane=membrane, surface=surface, markers=replace(sensor.markers, positions=torch.stack(found).numpy())
    )


def with_camera(sensor: tm.Sensor, focal: float = 1.0, shift: float = 0.0) -> tm.Sensor:
    """The sensor with another focal length and centre in its file."""
    camera = sensor.camera
    found = tm.Camera("pinhole", camera.image_size, (focal * camera.focal).tolist(), (camera.centre + shift).tolist())
    return replace(sensor, camera=found)


def moved(pixels: torch.Tensor, shift: float = 0.0, turn: float = 0.0, zoom: float = 1.0) -> torch.Tensor:
    """Pixels as a camera saw them that was elsewhere when the rest image was taken."""
    centre, angle = pixels.new_tensor([319.5, 239.5]), np.deg2rad(turn)
    rotation = pixels.new_tensor([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    return zoom * (pixels - centre) @ rotation.T + centre + shift


def mistakes(sensor: tm.Sensor) -> dict[tuple[str, str], tuple[tm.Sensor, dict]]:
    """The wrong sensor, and how the rest image is wrong, by kind and description."""
    key, base = SHAPE[sensor.name], sensor.surface.values["base_z"]
    found: dict = {("none", "none"): (sensor, {})}
    for by in (0.8, 0.9, 1.1, 1.2):
        value = np.array(sensor.surface.values[key], float)
        changed = (value * [1, 1, by] if key == "semi_axes" else value * by).tolist()
        found["rest shape", f"{key} x {by}"] = with_surface(sensor, {key: changed}), {}
    for by in (0.9, 0.95, 1.05, 1.1):
        found["camera", f"focal x {by}"] = with_camera(sensor, focal=by), {}
        found["camera", f"base_z x {by}"] = with_surface(sensor, {"base_z": base * by}), {}
    found["camera", "centre + 10 px"] = with_camera(sensor, shift=10.0), {}
    for px in (3.0, 10.0, 30.0):
        found["rest image", f"shift {px:g} px"] = sensor, dict(shift=px)
    for degrees in (1.0, 4.0):
        found["rest image", f"turned {degrees:g} degrees"] = sensor, dict(turn=degrees)
    for zoom in (1.02, 1.06):
        found["rest image", f"zoom {zoom:g}"] = sensor, dict(zoom=zoom)
    return found


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--presses", type=int, default=4)
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    warnings.simplefilter("ignore")
    rows = []
    for name in SURFACES:
        sensor = sensor_of(name)
        simulator, rng = Simulator(sensor), np.random.default_rng(0)
        rest, seen, truths = sensor.camera.point_to_pixel(torch.from_numpy(sensor.markers.positions)), [], []
        for _ in range(args.presses):
            top = sensor.membrane.rest[~sensor.membrane.fixed]
            point = top[rng.integers(len(top))].numpy()
            stroke = stroke_to(simulator, Sphere(3.0), point, -point / np.linalg.norm(point), DEPTH * sensor.membrane.size)
            state = list(simulator.presses(stroke, ["push"], frames=1))[-1]
            dots = simulator.renderer.dots(state.vertices).pixels
            seen.append(dots + LOCATION_NOISE * torch.from_numpy(rng.standard_normal(dots.shape)))
            truths.append(state)
        for (kind, what), (wrong, camera) in mistakes(sensor).items():
            try:
                r = tm.Reconstructor(wrong)
                result = r.from_pixels(torch.stack(seen).to(r.rest_pixels), rest_pixels=moved(rest, **camera).to(r.rest_pixels))
                statuses, forces = result.status.tolist(), result.force.double()
            except tm.MembraneError as error:
                print(f"{name}, {what}: {error}")
                continue
            off = [float((f - t.force).norm() / t.force.norm()) for f, t in zip(forces, truths, strict=True)]
            rows += [dict(sensor=name, kind=kind, what=what, status=s, force=o) for s, o in zip(statuses, off, strict=True)]
            print(json.dumps(dict(sensor=name, what=what, statuses=statuses, off=np.round(off, 2).tolist())), flush=True)
    for kind in dict.fromkeys(row["kind"] for row in rows):
        mine = [row for row in rows if row["kind"] == kind]
        shares = [np.mean([row["status"] == s for row in mine]) for s in (7, 0)]
        bad = np.mean([row["status"] == 0 and not row["force"] < CLOSE for row in mine])
        print(f"{kind}: {len(mine)} presses, status 7 in {shares[0]:.2f}, ok in {shares[1]:.2f}, of which wrong {bad:.2f}")
    write(args.json, dict(rows=rows))


if __name__ == "__main__":
    main()
