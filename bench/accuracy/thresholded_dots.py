"""Dots as the paper found them (section 5): threshold, components, nearest of its size, large ones first."""

import numpy as np
from scipy import ndimage
from scipy.spatial import cKDTree

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
