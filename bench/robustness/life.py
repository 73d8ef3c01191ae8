"""A sensor's life: the membrane softens, a weight stands on it now and then, and what that tells.

python -m bench.robustness.life [--softening 0.2] [--presses 10000] [--every 500] [--lives 50] [--json FILE]

The modulus falls evenly over the presses. A weight is a ball pressed 0.05 to 0.09 of the size deep near the top of a dome
of liquid, in the simulator; the markers are seen with 0.05 px noise and reconstructed with the modulus of the first day. A
liquid's shape under a given dent does not depend on the modulus, so what is found of a weight is off by the
reconstruction's own error and by the modulus: forty such errors are simulated, and drawn for each weight of each life.
Printed: at which press `StiffnessWatch` says that a calibration is due, how wrong forces are by then, and how often it says
so of a membrane that does not soften.
"""

import argparse
import warnings
from pathlib import Path

import numpy as np
import torch

import torchmembrane as tm
from bench.data.record import write
from bench.robustness.mistakes import LOCATION_NOISE, sensor_of
from torchmembrane.simulate.dataset import stroke_to
from torchmembrane.simulate.indenters import Sphere
from torchmembrane.simulate.simulator import Simulator
from torchmembrane.stiffness import StiffnessWatch

WEIGHTS, NEAR, DEPTHS = 40, 0.15, (0.05, 0.09)


def weights() -> np.ndarray:
    """Found over true force and the frame's own deviation over the true force, `[WEIGHTS, 2]`."""
    sensor, rng, rows = sensor_of("dome"), np.random.default_rng(0), []
    simulator, r = Simulator(sensor), tm.Reconstructor(sensor)
    rest, size = sensor.membrane.rest, sensor.membrane.size
    top = rest[(rest - rest[rest[:, 2].argmax()]).norm(dim=-1) < NEAR * size]
    clean = r.rest_pixels.double()
    for _ in range(WEIGHTS):
        point = top[rng.integers(len(top))].numpy()
        depth = rng.uniform(*DEPTHS) * size
        stroke = stroke_to(simulator, Sphere(3.0), point, np.array([0.0, 0.0, -1.0]), depth)
        state = list(simulator.presses(stroke, ["push"], frames=1))[-1]
        dots = simulator.renderer.dots(state.vertices).pixels
        seen = dots + LOCATION_NOISE * torch.from_numpy(rng.standard_normal(dots.shape))
        result = r.from_pixels(seen[None].to(r.rest_pixels), rest_pixels=clean.to(r.rest_pixels))
        if int(result.status[0]) == 0 and not (result.contact_at_rim == 1).any():
            known = float(state.force.norm())
            rows.append((float(result.force.norm()) / known, float(result.force_deviation.norm()) / known))
    return np.array(rows)


def life(found: np.ndarray, softening: float, presses: int, every: int, rng: np.random.Generator) -> tuple[int, float] | None:
    """At which press a calibration is said to be due, and by how much forces are off then; None where it is not said."""
    watch = StiffnessWatch()
    for press in range(every, presses + 1, every):
        modulus = 1 - softening * press / presses
        ratio, deviation = found[rng.integers(len(found))]
        watch.add(ratio / modulus, 1.0, deviation / modulus)
        if watch.is_due:
            return press, 1 / modulus - 1
    return None


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--softening", type=float, default=0.2)
    parser.add_argument("--presses", type=int, default=10_000)
    parser.add_argument("--every", type=int, default=500)
    parser.add_argument("--lives", type=int, default=50)
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    warnings.simplefilter("ignore")
    found, rng = weights(), np.random.default_rng(1)
    off = np.abs(found[:, 0] - 1)
    print(f"{len(found)} weights: forces off by {np.median(off):.3f} in the median, {np.quantile(off, 0.9):.3f} at 90 %")
    rows = []
    for softening in (args.softening, 0.0):
        lives = [life(found, softening, args.presses, args.every, rng) for _ in range(args.lives)]
        said = np.array([each for each in lives if each is not None]).reshape(-1, 2)
        print(f"softening {softening:g}: said in {len(said)} of {args.lives} lives")
        if len(said):
            quantiles = [np.quantile(said[:, k], (0, 0.5, 1)).round(3).tolist() for k in (0, 1)]
            print(f"    at press (least, median, most) {quantiles[0]}, forces then too large by {quantiles[1]}")
        rows.append(dict(softening=softening, lives=lives))
    write(args.json, dict(weights=found.tolist(), lives=rows))


if __name__ == "__main__":
    main()
