"""Forces after one known weight: the sensor's modulus and prestretch unknown, one press of known force, others compared.

python bench/weight.py [--sensors fingertip bubble half_cylinder] [--prestretches 1.1 1.3 1.6]

Balls pressed in five ways by the simulator, 0.03 to 0.12 of the size deep, 40 dB; the sensor file says prestretch 1.2 and no
modulus. Each row: which press was the weight, all five forces found over true ones, and what was found of the material.
"""

import argparse
from dataclasses import replace

import numpy as np
import torch

import torchmembrane as tm
from torchmembrane.calibrate.weight import material_from_weight
from torchmembrane.simulate.dataset import stroke_to

PRESSES = [
    (0.10, (0, 0, -1)),
    (0.05, (0.3, 0, -0.95)),
    (0.12, (0, 0.2, -1)),
    (0.08, (-0.3, 0.2, -0.9)),
    (0.03, (0.1, -0.2, -1)),
]
WEIGHTS = (0, 4)  # the presses that are known: a deep one and the lightest


def presses(sensor: tm.Sensor) -> tuple[torch.Tensor, np.ndarray]:
    """Images `[B, 1, H, W]` of the presses, and their forces `[B]`."""
    simulator = tm.simulate.Simulator(sensor, None, tm.simulate.Appearance(noise=40.0))
    rest, size, rng = sensor.membrane.rest, sensor.membrane.size, np.random.default_rng(0)
    aim, images, forces = rest[sensor.membrane.fixed].mean(0).numpy(), [], []
    for depth, direction in PRESSES:
        way = np.array(direction) / np.linalg.norm(direction)
        stroke = stroke_to(simulator, tm.simulate.Sphere(size / 7), aim, way, depth * size)
        *_, state = simulator.presses(stroke, ("push",))
        images.append(simulator.frame(state, stroke, rng).image)
        forces.append(float(state.force.norm()))
    stacked = torch.from_numpy(np.stack(images).astype(np.float64))
    return (stacked / 255 if images[0].dtype == np.uint8 else stacked)[:, None], np.array(forces)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sensors", nargs="+", default=["fingertip", "bubble", "half_cylinder"])
    parser.add_argument("--prestretches", nargs="+", type=float, default=[1.1, 1.3, 1.6])
    args = parser.parse_args()
    torch.set_num_threads(1)
    errors = []
    for name in args.sensors:
        for prestretch in args.prestretches:
            preset = tm.preset(name)
            truth = replace(preset, material=replace(preset.material, prestretch=prestretch))
            images, forces = presses(truth)
            told = replace(truth.material, prestretch=1.2, shear_modulus=None, thickness=None)
            for known in WEIGHTS:
                found = material_from_weight(replace(truth, material=told), images[known : known + 1], forces[known])
                with torch.no_grad():
                    ratio = tm.Reconstructor(found.sensor)(images).force.norm(dim=1).numpy() / forces
                errors += abs(np.delete(ratio, known) - 1).tolist()
                words = " ".join(f"{r:.3f}" for r in ratio)
                stretch = found.sensor.material.prestretch
                print(f"{name} {prestretch}: weight {forces[known]:.2f} N; found / true {words}; prestretch {stretch:.2f}")
    print("other presses' forces off by, median, 90 %, largest:", *(f"{np.quantile(errors, q):.3f}" for q in (0.5, 0.9, 1.0)))


if __name__ == "__main__":
    main()
