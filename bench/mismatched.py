"""What wrong matches do and what the screen saves (Fig. 16): 5 % of the markers take the pixel of a neighbour.

python bench/mismatched.py CASES [--draws N] [--json FILE]

CASES as for accuracy.py; exact markers with 0.05 px noise. Printed: for both estimators the surface error over displacement
without mismatches, with, and with them screened; the worst growth; how many mismatches were missed and right markers lost.
"""

import argparse
import warnings
from pathlib import Path

import numpy as np
import torch
from accuracy import cases_in
from record import write
from scipy.spatial import cKDTree

from torchmembrane.markers.screen import MismatchScreen
from torchmembrane.reconstruct import FOUND, Reconstructor

SHARE, NOISE = 0.05, 0.05


def mismatched(rest: np.ndarray, pixels: np.ndarray, rng) -> tuple[np.ndarray, np.ndarray]:
    """The pixels `[D, 2]` with `SHARE` of them taken from one of the four nearest markers, and which those are."""
    bad = rng.choice(len(rest), round(SHARE * len(rest)), replace=False)
    near = cKDTree(rest).query(rest[bad], k=5)[1][:, 1:]
    wrong = pixels.copy()
    wrong[bad] = pixels[near[np.arange(len(bad)), rng.integers(0, 4, len(bad))]]
    return wrong, np.isin(np.arange(len(rest)), bad)


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("cases", type=Path)
    parser.add_argument("--draws", type=int, default=2)
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    warnings.simplefilter("ignore")
    rows, missed, lost, flagged = [], 0, 0, 0
    for case in cases_in(args.cases):
        truth = np.load(args.cases / case["truth"])
        X, Y = truth["dots_nominal"].astype(float), truth["dots_deformed"].astype(float)
        rng = np.random.default_rng(0)
        pixels = truth["uv_deformed"] + NOISE * rng.standard_normal(truth["uv_deformed"].shape)
        for estimator in ("minimum-energy", "force-balance"):
            r = Reconstructor.from_file(args.cases / case["sensor"], estimator=estimator)
            rest = r.rest_pixels.double().numpy()
            screen = MismatchScreen(rest, r.vertex_pixels[r.estimator.membrane.fixed].numpy())
            draws = [mismatched(rest, pixels, np.random.default_rng(draw)) for draw in range(args.draws)]
            seen = torch.from_numpy(np.stack([pixels] + [wrong for wrong, _ in draws]))
            one = torch.ones(seen.shape[:2], dtype=torch.float64)
            with torch.no_grad():
                trust = screen(seen - torch.from_numpy(rest), one)
                results = r.from_pixels(seen), r.from_pixels(seen, trust)
            error = [np.sqrt(((x.markers.numpy() - Y) ** 2).sum((1, 2)) / ((Y - X) ** 2).sum()) for x in results]
            (clean, *wrong), (_, *saved) = error
            row = dict(clean=clean, mismatched=np.mean(wrong), screened=np.mean(saved), growth=max(saved) / clean - 1)
            rows.append(dict(case=case["case"], estimator=estimator) | {key: float(value) for key, value in row.items()})
            suspect = (trust[1:] < FOUND).numpy()
            flags = np.stack([bad for _, bad in draws])
            missed, lost, flagged = missed + (flags & ~suspect).sum(), lost + (suspect & ~flags).sum(), flagged + flags.sum()
            print(
                "{case} {estimator:15s} {clean:.3f} {mismatched:.3f} {screened:.3f} {growth:+.3f}".format(**rows[-1]),
                flush=True,
            )
    for estimator in ("minimum-energy", "force-balance"):
        mine = [row for row in rows if row["estimator"] == estimator]
        clean, wrong, saved, growth = (np.median([row[key] for row in mine]) for key in list(mine[0])[2:])
        print(
            f"{estimator}: {clean:.3f} clean, {wrong:.3f} mismatched, {saved:.3f} screened (medians); growth {growth:+.3f} in "
            f"the median, {max(row['growth'] for row in mine):+.3f} at worst"
        )
    print(f"{flagged} mismatched markers, {missed} missed; {lost} right ones distrusted")
    write(args.json, dict(mismatched=rows))


if __name__ == "__main__":
    main()
