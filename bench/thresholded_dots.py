"""Dots as the paper found them (section 5), beside the locator: threshold, components, nearest of its size, large first.

python bench/thresholded_dots.py CASES [--json FILE]

CASES as for accuracy.py. Printed for each sensor and kind of image, for both: median and 95th percentile of the error in px
over found visible dots, the share found, how many are over 3 px off. Both measure displacements against their own rest image.
"""

import argparse
import warnings
from pathlib import Path

import numpy as np
import torch
from accuracy import cases_in
from record import write
from scipy import ndimage
from scipy.spatial import cKDTree

import torchmembrane as tm
from torchmembrane.markers.observer import FOUND

REACH = 0.75  # of the distance to the nearest dot of its size: how far a dot is looked for
NEIGHBOURS = 4  # matched large dots that predict a small one
SMALLEST = 5  # px, area of a component that is no noise
LARGEST = 4.0  # times the largest dot's area at rest


def otsu(image: np.ndarray) -> float:
    """The grey level that parts an image into two classes of least spread (Otsu 1979)."""
    count, edges = np.histogram(image, 256)
    level, below = (edges[1:] + edges[:-1]) / 2, count.cumsum()
    mean = (count * level).cumsum() / np.maximum(below, 1)
    above = below[-1] - below
    other = ((count * level).sum() - (count * level).cumsum()) / np.maximum(above, 1)
    return float(level[(below * above * (mean - other) ** 2).argmax()])


def components(image: np.ndarray, polarity: str) -> tuple[np.ndarray, np.ndarray]:
    """Centres `[N, 2]` (u, v) and areas `[N]` of the connected dark (light) components."""
    dark = image if polarity == "dark" else 1 - image
    labels, count = ndimage.label(dark < otsu(dark))
    index = np.arange(1, count + 1)
    area = ndimage.sum_labels(np.ones_like(dark), labels, index)
    centre = np.array(ndimage.center_of_mass(np.ones_like(dark), labels, index)).reshape(-1, 2)[:, ::-1]
    return centre[area >= SMALLEST], area[area >= SMALLEST]


class ThresholdedDots:
    """The paper's matching for one sensor: rest components by the listed dots, then frames by proximity and size."""

    def __init__(self, rest_image, model_pixels, large, polarity):
        self.model, self.large, self.polarity = model_pixels, large, polarity
        centre, area = components(rest_image, polarity)
        spacing = cKDTree(model_pixels).query(model_pixels, k=2)[0][:, 1]
        gap, nearest = cKDTree(centre).query(model_pixels)
        known = gap < spacing / 2
        self.rest = np.where(known[:, None], centre[nearest], np.nan)
        sizes = [np.median(area[nearest][known & (large == size)]) for size in (False, True)]
        self.border, self.largest = float(np.sqrt(np.prod(sizes))), LARGEST * sizes[1]

    def __call__(self, image) -> np.ndarray:
        """Displacements `[D, 2]`, NaN where lost."""
        centre, area = components(image, self.polarity)
        kept = area < self.largest
        centre, is_large = centre[kept], area[kept] > self.border
        moved = np.full(self.rest.shape, np.nan)
        usable = np.isfinite(self.rest).all(1)
        for size in (True, False):
            dots, blobs = np.flatnonzero(usable & (self.large == size)), centre[is_large == size]
            if len(dots) < 2 or not len(blobs):
                continue
            expected = self.rest[dots] + (0.0 if size else self._predicted(dots, moved))
            reach = REACH * cKDTree(self.rest[dots]).query(self.rest[dots], k=2)[0][:, 1]
            gap, nearest = cKDTree(blobs).query(expected)
            back = cKDTree(expected).query(blobs)[1]
            mutual = (back[nearest] == np.arange(len(dots))) & (gap < reach)
            moved[dots[mutual]] = (blobs[nearest] - self.rest[dots])[mutual]
        return moved

    def _predicted(self, dots, moved) -> np.ndarray:
        """Mean displacement of the nearest large dots that are matched."""
        matched = np.isfinite(moved).all(1)
        if matched.sum() < NEIGHBOURS:
            return np.zeros((len(dots), 2))
        near = cKDTree(self.rest[matched]).query(self.rest[dots], k=NEIGHBOURS)[1]
        return moved[matched][near].mean(1)


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("cases", type=Path)
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    warnings.simplefilter("ignore")
    errors, cases = {}, cases_in(args.cases)
    for name in sorted({case["sensor"] for case in cases}):
        r = tm.Reconstructor.from_file(args.cases / name)
        markers, model = r.sensor.markers, r.rest_pixels.double().numpy()
        large = np.array([size == "large" for size in markers.sizes])
        paper = ThresholdedDots(markers.rest_image, model, large, markers.polarity)
        for case in (c for c in cases if c["sensor"] == name):
            truth = np.load(args.cases / case["truth"])
            visible = truth["visible_deformed"].astype(bool) if "visible_deformed" in truth else np.ones(len(model), bool)
            for path in case["images"]:
                kind = Path(path).stem.rpartition("_")[2] if len(case["images"]) > 1 else "images"
                image = r.read(args.cases / path)
                with torch.no_grad():
                    pixels, confidence = (a[0].double().numpy() for a in r.observer.locator(image))
                soft = np.where(confidence[:, None] > FOUND, pixels - r.observer.measured_rest.double().numpy(), np.nan)
                for method, moved in (("paper", paper(image[0, 0].numpy())), ("locator", soft)):
                    error = np.linalg.norm(model + moved - truth["uv_deformed"], axis=1)[visible]
                    errors.setdefault((case["folder"], kind, method), []).append(error)
    rows = []
    for (folder, kind, method), parts in sorted(errors.items()):
        error = np.concatenate(parts)
        found = error[np.isfinite(error)]
        row = dict(sensor=folder, images=kind, method=method, median=float(np.median(found)), found=len(found) / len(error))
        rows.append(row | dict(p95=float(np.percentile(found, 95)), wrong=int((found > 3).sum())))
        print(
            "{sensor:16s} {images:6s} {method:8s} median {median:.3f} px, 95 % {p95:.3f} px, found {found:.3f}, "
            "wrong {wrong}".format(**rows[-1])
        )
    write(args.json, dict(dots=rows))


if __name__ == "__main__":
    main()
