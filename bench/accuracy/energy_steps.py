"""How many steps minimum energy needs.

python -m bench.accuracy.energy_steps CASES [--grid 17] [--steps 6 8 10 12] [--json FILE]

CASES as for accuracy.py; rays from the exact markers of every press. Printed for each material (the sensor's, harmonic),
precision and number of steps: worst and median over the presses of the surface's error against 60 steps in float64, over its
displacement (rms both), and the largest relative step, by which a result counts as converged.
"""

import argparse
import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

import torchmembrane as tm
from bench.accuracy.accuracy import cases_in
from bench.data.record import write
from torchmembrane.estimators.base import Observation

CONVERGED = 60


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("cases", type=Path)
    parser.add_argument("--grid", type=int, default=17)
    parser.add_argument("--steps", type=int, nargs="*", default=[6, 8, 10, 12])
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    warnings.simplefilter("ignore")
    torch.set_num_threads(1)
    cases, found, rows = cases_in(args.cases), {}, []
    for name in sorted({case["sensor"] for case in cases}):
        sensor = tm.Sensor.from_file(args.cases / name)
        sensor = replace(sensor, membrane=sensor.surface.membrane((args.grid, args.grid)))
        pixels = [np.load(args.cases / case["truth"])["uv_deformed"] for case in cases if case["sensor"] == name]
        for model in (None, "harmonic"):
            for key, values in errors(sensor, model, torch.from_numpy(np.array(pixels, float)), args.steps).items():
                found.setdefault((model or "the sensor's", *key), []).append(values)
    for (model, precision, steps), values in found.items():
        error, relative_step = torch.cat(values, 1)
        row = dict(material=model, precision=precision, steps=steps, worst=float(error.max()), median=float(error.median()))
        rows.append(row | dict(relative_step=float(relative_step.max())))
        print("{material:12s} {precision} {steps:2d} steps: {worst:.1e} ({median:.1e}), {relative_step:.1e}".format(**rows[-1]))
    write(args.json, dict(rows=rows))


@torch.no_grad()
def errors(sensor: tm.Sensor, model: str | None, pixels: torch.Tensor, counts: list[int]) -> dict:
    """`[2, presses]` error and relative step for each precision and number of steps."""
    converged, found = with_steps(sensor, model, CONVERGED, torch.float64), {}
    observation = converged.observation(pixels - converged.rest_pixels, torch.ones_like(pixels[..., 0]))
    exact = converged.estimator(observation).vertices
    displacement = rms(exact - converged.estimator.membrane.rest)
    for dtype in (torch.float64, torch.float32):
        for steps in counts:
            estimator = with_steps(sensor, model, steps, dtype).estimator
            got = estimator(Observation(*(None if part is None else part.to(dtype) for part in observation)))
            error = rms(got.vertices.double() - exact) / displacement
            found[str(dtype)[6:], steps] = torch.stack([error, got.relative_step.double()])
    return found


def with_steps(sensor: tm.Sensor, model: str | None, steps: int, dtype: torch.dtype) -> tm.Reconstructor:
    settings = tm.MinimumEnergySettings(steps=steps)
    return tm.Reconstructor(sensor, "minimum-energy", settings=settings, model=model, dtype=dtype)


def rms(x: torch.Tensor) -> torch.Tensor:
    return x.norm(dim=-1).square().mean(-1).sqrt()


if __name__ == "__main__":
    main()
