"""Minimum energy at fixed (x, y), the paper's unknowns (Appendix D, eq. 22), against fixed material points.

python -m bench.accuracy.monge CASES [--json FILE]

CASES as for accuracy.py; sensors whose rest surface is no graph over (x, y) are left out. Exact markers, harmonic membrane.
Printed for each form: surface error over displacement at the markers, rms distance of its vertices from the first form's, and
its pressure change over the rest pressure.
"""

import argparse
import warnings
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch

import torchmembrane as tm
from bench.accuracy.accuracy import cases_in
from bench.data.record import write
from torchmembrane.estimators.base import Equilibrium, Observation
from torchmembrane.estimators.paper.studies.monge import MongeMinimumEnergy


def forms(reconstructor: tm.Reconstructor) -> dict[str, Callable[[Observation], Equilibrium]]:
    membrane, elasticity = reconstructor.estimator.membrane, reconstructor.estimator.elasticity
    rest_rays = reconstructor.camera.pixel_to_ray(reconstructor.vertex_pixels)

    def at_fixed_points(steps: int) -> Callable[[Observation], Equilibrium]:
        monge = MongeMinimumEnergy(membrane, elasticity, rest_rays, steps)
        return lambda observation: monge(observation.origins[0], observation.directions[0])

    return {
        "material points": reconstructor.estimator,
        "fixed x y, once (eq. 22)": at_fixed_points(1),
        "fixed x y, five times": at_fixed_points(5),
    }


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("cases", type=Path)
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    warnings.simplefilter("ignore")
    rows = []
    for case in cases_in(args.cases):
        r = tm.Reconstructor.from_file(args.cases / case["sensor"], "minimum-energy", model="harmonic", dtype=torch.float64)
        truth = np.load(args.cases / case["truth"])
        X, Y = (torch.from_numpy(truth[key].astype(float)) for key in ("dots_nominal", "dots_deformed"))
        pixels = torch.from_numpy(truth["uv_deformed"].astype(float))[None]
        try:
            estimators = forms(r)
        except tm.MembraneError as error:
            print(f"{case['case']} {case['folder']}: left out, {str(error).partition(';')[0]}")
            continue
        with torch.no_grad():
            observation = r.observation(pixels - r.rest_pixels, torch.ones(pixels.shape[:2], dtype=torch.float64))
            first = r.estimator(observation).vertices
            for name, estimator in estimators.items():
                got = estimator(observation)
                vertices = got.vertices.reshape(first.shape)
                markers = r.rest_markers + r.marker_shares @ (vertices - r.estimator.membrane.rest)[0]
                error = float(((markers - Y).square().sum() / (Y - X).square().sum()).sqrt())
                apart = float((vertices - first).square().sum(-1).mean().sqrt())
                rise = float(got.pressure / r.estimator.rest_pressure - 1)
                rows.append(dict(case=case["case"], form=name, error=error, apart=apart, pressure=rise))
    for name in dict.fromkeys(row["form"] for row in rows):
        mine = [row for row in rows if row["form"] == name]
        median = {key: np.median([abs(row[key]) for row in mine]) for key in ("error", "apart", "pressure")}
        worst = max(row["error"] for row in mine)
        print(
            f"{name:26s} {len(mine)} cases: error {median['error']:.3f} in the median, {worst:.3f} at worst; "
            f"{median['apart']:.3f} from the first; pressure change {median['pressure']:.3f}"
        )
    write(args.json, dict(monge=rows))


if __name__ == "__main__":
    main()
