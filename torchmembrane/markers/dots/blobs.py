"""Compact dark blobs in one image, found without any prior."""

import numpy as np
from scipy import ndimage

from ...errors import MembraneError

SCALES = 1.25  # ratio of neighbouring scales
SMALLEST = 1.2  # px, radius of the smallest dot looked for
LARGEST = 1 / 16  # radius of the largest, of the image's shorter side
ELONGATION = 4.0  # long over short axis of a dot at most
SOLIDITY = 0.75  # of its ellipse that a dot fills, or a dot that its ellipse fills


def blob_seeds(dark):
    """Maxima `[S, 2]` (u, v) over place and scale of the Hessian's determinant, and their radii `[S]`, best first."""
    count = int(np.log(min(dark.shape) * LARGEST / SMALLEST) / np.log(SCALES)) + 1
    radii = SMALLEST * SCALES ** np.arange(count)
    responses = []
    for sigma in radii / np.sqrt(2):
        vv, uu, uv = (ndimage.gaussian_filter(dark, sigma, order) for order in ((2, 0), (0, 2), (1, 1)))
        responses.append(sigma**2 * np.sqrt(np.maximum(uu * vv - uv**2, 0)) * (uu + vv > 0))
    responses = np.array(responses)
    peak = (responses == ndimage.maximum_filter(responses, (3, 3, 3))) & (responses > 0.01)
    scale, v, u = np.nonzero(peak)
    order = np.argsort(-responses[peak])
    return np.stack([u, v], -1)[order], radii[scale[order]]


def outline(dark, seed, radius):
    """The pixels about `seed` darker than half way to the background: area, centre, moments, contrast, or None."""
    reach = int(np.ceil(2.6 * radius)) + 2
    v0, u0 = max(seed[1] - reach, 0), max(seed[0] - reach, 0)
    patch = dark[v0 : seed[1] + reach + 1, u0 : seed[0] + reach + 1]
    v, u = np.mgrid[: patch.shape[0], : patch.shape[1]]
    distance = np.hypot(u + u0 - seed[0], v + v0 - seed[1])
    core = patch[distance <= max(0.5 * radius, 1)].mean()
    background = np.median(patch[(distance > 1.5 * radius + 1) & (distance < 2.4 * radius + 2)])
    if background - core < 0.04:
        return None
    labels, _ = ndimage.label(patch < (core + background) / 2)
    label = labels[seed[1] - v0, seed[0] - u0]
    blob = labels == label
    if label == 0 or blob[[0, -1]].any() or blob[:, [0, -1]].any() or blob.sum() < 4:
        return None
    place = np.stack([u[blob] + u0, v[blob] + v0], -1).astype(float)
    centre = place.mean(0)
    moments = (place - centre).T @ (place - centre) / len(place) + np.eye(2) / 12
    return len(place), centre, moments, (background - core) / max(background, 0.05)


def is_dot(area, moments, filled):
    """An ellipse: compact, and its area what its moments say."""
    small, large = np.linalg.eigvalsh(moments)
    return large < ELONGATION**2 * small and abs(np.log(area / (4 * np.pi * np.sqrt(small * large)))) < filled


def find_blobs(dark, mask=None):
    """Every compact dark blob: centres `[N, 2]`, shapes `[N, 2, 2]`, contrasts `[N]`."""
    smooth = ndimage.gaussian_filter(dark, 0.6)
    taken = np.zeros(dark.shape, bool)
    blobs = []
    for seed, radius in zip(*blob_seeds(smooth), strict=True):
        if taken[seed[1], seed[0]] or (mask is not None and not mask[seed[1], seed[0]]):
            continue
        found = outline(smooth, seed, radius)
        if found is None or not is_dot(found[0], found[2], -np.log(SOLIDITY)):
            continue
        area, centre, moments, contrast = found
        u, v = np.round(centre).astype(int)
        margin = np.minimum(centre, np.array(dark.shape[::-1]) - 1 - centre).min()
        if taken[v, u] or margin < 1.5 * np.sqrt(area / np.pi) + 1:
            continue
        values, axes = np.linalg.eigh(moments)
        shape = axes @ np.diag(2 * np.sqrt(values)) @ axes.T * np.sqrt(area / (4 * np.pi * np.sqrt(values.prod())))
        reach = np.ceil(np.sqrt(area / np.pi)).astype(int)
        taken[max(v - reach, 0) : v + reach + 1, max(u - reach, 0) : u + reach + 1] = True
        blobs.append((centre, shape, contrast))
    if len(blobs) < 6:
        raise MembraneError(
            f"find_dots: {len(blobs)} dots found, expected at least 6; check the polarity, the rest image and the mask"
        )
    return tuple(np.array(x) for x in zip(*blobs, strict=True))
