"""Where the contacts are: eq. 29 alone, the reconstruct / segment loop, and the tractions of force balance.

python -m bench.accuracy.segmentation CASES [--images] [--json FILE]

CASES as for accuracy.py, with `contact_centroid_each [I, 3]` in the truth. Printed: for each case, then in the median and at
worst, the contact error in the sensor's length unit (the larger of the mean distance from the true contacts to the nearest
found, and back; 10 where none is found), the surface's error over its displacement (rms at the markers), and of the presses by
several bodies how many contacts are found. The loop is run around the paper's estimator, also with the energy over the free
part only (`PaperSettings.free_part_only`); of minimum energy the contacts of its surface are taken. From exact markers with
0.05 px noise, or with --images from the last image of every case, where the paper's estimator finds them by the soft locator.
"""

import argparse
import warnings
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import torch

import torchmembrane as tm
from bench.accuracy.accuracy import cases_in
from bench.data.record import write
from torchmembrane.estimators.paper.estimator import Segmented

LOCATION_NOISE, NONE_FOUND, ROUNDS = 0.05, 10.0, 8
PAPER, FREE, MATERIAL, BALANCE = "loop, paper", "loop, paper, free part only", "minimum energy", "force balance"
OPTIONS = {
    PAPER: {"estimator": "paper", "locator": "soft"},
    MATERIAL: {"estimator": "minimum-energy"},
    BALANCE: {"estimator": "force-balance"},
}


@cache
def reconstructor(path: Path, name: str) -> tm.Reconstructor:
    """The sensor's reconstructor, in double precision but for force balance."""
    return tm.Reconstructor.from_file(path, dtype=torch.float32 if name == BALANCE else torch.float64, **OPTIONS[name])


def contact_error(found: np.ndarray, true: np.ndarray) -> float:
    found = found[np.isfinite(found).all(1)]
    if not len(found):
        return NONE_FOUND
    gap = np.linalg.norm(found[:, None] - true, axis=2)
    return float(max(gap.min(0).mean(), gap.min(1).mean()))


def surface_error(result: tm.Reconstruction, truth) -> float:
    X, Y = truth["dots_nominal"].astype(float), truth["dots_deformed"].astype(float)
    return float(np.sqrt(((result.markers[0].numpy() - Y) ** 2).sum() / ((Y - X) ** 2).sum()))


def segmented(r: tm.Reconstructor, seen: tm.Reconstruction, free_part_only=False) -> tuple[Segmented, tm.Reconstruction]:
    """What the loop ends with from the markers of a result, and that surface as a result."""
    moved, usual = (seen.pixels - r.rest_pixels).nan_to_num(), r.estimator.settings
    if free_part_only:
        r.estimator.settings = replace(usual, free_part_only=True)
    observation = r.observation(moved, seen.confidence)
    got = r.estimator.reconstruct_and_segment(observation, ROUNDS)
    r.estimator.settings = usual
    return got, r.result(got.surface, observation, moved, seen.confidence, seen.status)


def ways(root: Path, case: dict, images: bool) -> dict[str, tuple[float, float, int]]:
    """Of each way the contact error, the surface error, and how many contacts are found."""
    truth = np.load(root / case["truth"])
    place = truth["contact_centroid_each"]
    noise = LOCATION_NOISE * np.random.default_rng(0).standard_normal(truth["uv_deformed"].shape)
    found = {}

    def keep(name: str, points: torch.Tensor, result: tm.Reconstruction) -> None:
        count = int(points[0].isfinite().all(-1).sum())
        found[name] = contact_error(points[0].numpy(), place), surface_error(result, truth), count

    for name in OPTIONS:
        r = reconstructor(root / case["sensor"], name)
        seen = r(r.read(root / case["images"][-1])) if images else r.from_pixels(torch.from_numpy(truth["uv_deformed"] + noise))
        if name != PAPER:
            keep(name, seen.contact_points, seen)
            continue
        got, result = segmented(r, seen)
        keep("eq. 29", got.first.points, result)
        keep(name, got.contacts.points, result)
        got, result = segmented(r, seen, free_part_only=True)
        keep(FREE, got.contacts.points, result)
    return found


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("cases", type=Path)
    parser.add_argument("--images", action="store_true")
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    warnings.simplefilter("ignore")
    rows = []
    for case in sorted(cases_in(args.cases), key=lambda case: case["sensor"]):
        with torch.no_grad():
            found = ways(args.cases, case, args.images)
        true = len(np.load(args.cases / case["truth"])["contact_centroid_each"])
        rows.append(dict(case=case["case"], sensor=case["folder"], contacts=true, **found))
        each = (f"{name} {contact:.2f}, {surface:.3f}" for name, (contact, surface, _) in found.items())
        print(case["case"], case["folder"], *each, sep="; ", flush=True)
    for name in found:
        contact, surface, count = np.array([row[name] for row in rows]).T
        true = np.array([row["contacts"] for row in rows])
        several = [f"{int(n)} of {k}" for n, k in zip(count, true, strict=True) if k > 1]
        shape = f"{np.nanmedian(surface):.3f}, {np.nanmax(surface):.3f}, none in {np.isnan(surface).sum()}"
        of_surface = "" if name == "eq. 29" else f"; surface {shape}"
        print(f"{name}: contacts {np.median(contact):.2f} in the median, {contact.max():.2f} at worst{of_surface}")
        print(f"    of several at once: {', '.join(several)}; none at all in {int((count == 0).sum())} presses")
    write(args.json, dict(segmentation=rows))


if __name__ == "__main__":
    main()
