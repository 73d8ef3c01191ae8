"""What wrong matches do and what the screen saves (Fig. 16): 5 % of the markers take the pixel of a neighbour.

python -m bench.robustness.mismatched CASES [--draws N] [--json FILE]

CASES as for accuracy/accuracy.py; exact markers with 0.05 px noise. Printed: for both estimators the surface error over
displacement without mismatches, with them believed, and with them screened as `Reconstructor.from_pixels` does; by how much
mismatches make it grow, and by how much other noise without any; how many mismatches were missed and right markers lost.
"""

import argparse
import warnings
from pathlib import Path

import numpy as np
import torch
from scipy.spatial import cKDTree

import torchmembrane as tm
from bench.accuracy.accuracy import cases_in
from bench.data.record import write
from torchmembrane.markers.observer import FOUND_CONFIDENCE

SHARE, LOCATION_NOISE, ALLOWED = 0.05, 0.05, 0.2


def mismatched(rest: np.ndarray, pixels: np.ndarray, rng) -> tuple[np.ndarray, np.ndarray]:
    """The pixels `[D, 2]` with `SHARE` of them taken from one of the four nearest markers, and which those are."""
    bad = rng.choice(len(rest), round(SHARE * len(rest)), replace=False)
    near = cKDTree(rest).query(rest[bad], k=5)[1][:, 1:]
    wrong = pixels.copy()
    wrong[bad] = pixels[near[np.arange(len(bad)), rng.integers(0, 4, len(bad))]]
    return wrong, np.isin(np.arange(len(rest)), bad)


def believed(r: tm.Reconstructor, flow: torch.Tensor) -> tm.Reconstruction:
    """What `from_pixels` makes of displacements `[B, D, 2]` px, but for its screen."""
    one = torch.ones_like(flow[..., 0])
    observation = r.observation(flow, one)
    return r.result(r.estimator(observation), observation, flow, one, torch.full((len(flow),), tm.Status.OK.value))


def grown(errors: np.ndarray, clean: np.ndarray) -> str:
    growth = errors / clean[:, None] - 1
    return f"{np.median(growth):+.2f} in the median, {growth.max():+.2f} at worst, {np.sum(growth > ALLOWED)} over {ALLOWED}"


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("cases", type=Path)
    parser.add_argument("--draws", type=int, default=2)
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    warnings.simplefilter("ignore")
    rows, counts, n = [], np.zeros(3, int), args.draws
    for case in cases_in(args.cases):
        truth = np.load(args.cases / case["truth"])
        X, Y, exact = (truth[name].astype(float) for name in ("dots_nominal", "dots_deformed", "uv_deformed"))
        pixels, *others = (exact + LOCATION_NOISE * np.random.default_rng(k).standard_normal(exact.shape) for k in range(1 + n))
        for estimator in ("minimum-energy", "force-balance"):
            r = tm.Reconstructor.from_file(args.cases / case["sensor"], estimator)
            rest = r.rest_pixels.double().numpy()
            draws = [mismatched(rest, pixels, np.random.default_rng(k)) for k in range(n)]
            wrong, bad = (np.stack(each) for each in zip(*draws, strict=True))
            observed = torch.from_numpy(np.stack([pixels, *others, *wrong]))
            flow = (observed - torch.from_numpy(rest)).to(r.rest_pixels)
            with torch.no_grad():
                suspect = (r.observer.screen(flow, torch.ones_like(flow[..., 0])) < FOUND_CONFIDENCE).numpy()
                results = r.from_pixels(observed), believed(r, flow[-n:])
            error, spoiled = (np.sqrt(((x.markers.numpy() - Y) ** 2).sum((1, 2)) / ((Y - X) ** 2).sum()) for x in results)
            row = dict(clean=error[0], noise=error[1:-n], believed=np.nan_to_num(spoiled, nan=np.inf), screened=error[-n:])
            rows.append(dict(case=case["case"], estimator=estimator) | {key: value.tolist() for key, value in row.items()})
            counts += (bad & ~suspect[-n:]).sum(), (suspect[-n:] & ~bad).sum(), bad.sum()
            print(case["case"], estimator, *(f"{key} {np.round(value, 3)}" for key, value in row.items()), flush=True)
    for estimator in ("minimum-energy", "force-balance"):
        mine = [row for row in rows if row["estimator"] == estimator]
        clean, noise, spoiled, screened = (np.array([row[key] for row in mine]) for key in list(mine[0])[2:])
        medians = f"{np.median(clean):.3f} clean, {np.median(spoiled):.3f} mismatched, {np.median(screened):.3f} screened"
        means = f"{np.append(clean[:, None], noise, 1).mean():.3f} without mismatches, {screened.mean():.3f} screened"
        print(f"{estimator}: medians {medians}; means {means}; of {screened.size}, growth")
        for what, errors in {"mismatched": spoiled, "screened": screened, "other noise": noise}.items():
            print(f"    {what}: {grown(errors, clean)}")
    print("{2} mismatched markers, {0} missed; {1} right ones distrusted".format(*counts))
    screened = dict(zip(("missed", "distrusted", "mismatched"), counts.tolist(), strict=True))
    write(args.json, dict(mismatched=rows, screened=screened))


if __name__ == "__main__":
    main()
