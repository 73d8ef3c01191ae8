"""Where the contacts are, three ways: eq. 29 alone, the paper's loop, and the tractions of force balance.

python bench/segmentation.py CASES [--images] [--json FILE]

CASES as for accuracy.py, with `contact_centroid_each [I, 3]` in the truth. The contact error is the larger of the mean distance
from the true contacts to the nearest found, and back; 10 where none is found. From exact markers with 0.05 px noise, or with
--images from the last image of every case.
"""

import argparse
import warnings
from pathlib import Path

import numpy as np
import torch
from accuracy import cases_in
from record import write

import torchmembrane as tm
from torchmembrane.estimators.segmentation import Segmented, reconstruct_and_segment
from torchmembrane.markers.observer import FOUND

NOISE, NONE_FOUND, ROUNDS = 0.05, 10.0, 8
LOOPS = {
    "loop, paper": dict(estimator="paper"),
    "loop, material": dict(estimator="minimum-energy"),
}


def contact_error(found: np.ndarray, true: np.ndarray) -> float:
    found = found[np.isfinite(found).all(1)]
    if not len(found):
        return NONE_FOUND
    gap = np.linalg.norm(found[:, None] - true, axis=2)
    return float(max(gap.min(0).mean(), gap.min(1).mean()))


def segmented(r: tm.Reconstructor, pixels: torch.Tensor, confidence: torch.Tensor) -> Segmented:
    found = (confidence > FOUND).to(confidence)
    rays = r.observation(torch.where(found[..., None] > 0, pixels - r.rest_pixels, 0.0), found)
    return reconstruct_and_segment(r.estimator, r.estimator.segmentation, rays, ROUNDS)


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("cases", type=Path)
    parser.add_argument("--images", action="store_true")
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    warnings.simplefilter("ignore")
    rows = []
    for case in cases_in(args.cases):
        truth = np.load(args.cases / case["truth"])
        place = truth["contact_centroid_each"]
        balance = tm.Reconstructor.from_file(args.cases / case["sensor"])
        with torch.no_grad():
            if args.images:
                result = balance(balance.read(args.cases / case["images"][-1]))
                pixels, confidence = result.pixels, result.confidence
            else:
                noise = NOISE * np.random.default_rng(0).standard_normal(truth["uv_deformed"].shape)
                pixels = torch.from_numpy(truth["uv_deformed"] + noise)[None]
                confidence = torch.ones(pixels.shape[:2], dtype=torch.float64)
                result = balance.from_pixels(pixels)
            row = dict(case=case["case"], sensor=case["folder"], contacts=len(place))
            for name, options in LOOPS.items():
                path = args.cases / case["sensor"]
                r = tm.Reconstructor.from_file(path, dtype=torch.float64, **options)
                got = segmented(r, pixels.double(), confidence.double())
                row["eq. 29"] = contact_error(got.first.points[0].numpy(), place)
                row[name] = contact_error(got.contacts.points[0].numpy(), place)
        row["traction"] = contact_error(result.contact_points[0].numpy(), place)
        rows.append(row)
        print("  ".join(f"{k} {v:.2f}" if isinstance(v, float) else f"{v}" for k, v in row.items()), flush=True)
    ways = ("eq. 29", *LOOPS, "traction")
    for way in ways:
        error = [row[way] for row in rows]
        print(f"{way}: {np.median(error):.2f} in the median, {np.max(error):.2f} at worst")
    write(args.json, dict(segmentation=rows))


if __name__ == "__main__":
    main()
