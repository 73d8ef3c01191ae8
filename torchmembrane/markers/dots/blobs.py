"""Detection of compact dark blobs in one image, without prior knowledge of the pattern."""

from typing import NamedTuple

import numpy as np
from scipy import fft, ndimage

from ...errors import MembraneError

SCALES = 1.25  # ratio of neighbouring scales
SMALLEST = 1.2  # px, radius of the smallest dot
LARGEST = 1 / 16  # radius of the largest dot, relative to the image's shorter side
ELONGATION = 4.0  # largest ratio of a dot's long and short axes
FEWEST = 6
LONG_FILTER = 2.0  # px, standard deviation of a Gaussian above which cosine series are exact and faster
SOLIDITY = 0.75  # smallest ratio of the areas of a dot and its ellipse, either way


class Blob(NamedTuple):
    """Statistics of the pixels of one blob: their number, mean, second moments `[2, 2]` and contrast."""

    area: int
    centre: np.ndarray
    moments: np.ndarray
    contrast: float


def blob_seeds(dark: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the maxima `[S, 2]` (u, v) of the Hessian's determinant over position and scale, and their radii `[S]`, best
    first."""
    count = max(1, int(np.log(min(dark.shape) * LARGEST / SMALLEST) / np.log(SCALES)) + 1)
    radii = SMALLEST * SCALES ** np.arange(count)
    series = fft.dctn(dark.astype(np.float32))
    responses = np.empty((count, *dark.shape), np.float32)
    for response, sigma in zip(responses, (radii / np.sqrt(2)).tolist(), strict=True):
        vv, uu, uv = second_derivatives(dark, series, sigma)
        response[:] = sigma**2 * np.sqrt(np.maximum(uu * vv - uv**2, 0)) * (uu + vv > 0)
    scale, v, u = _maxima(responses, 0.01).T
    order = np.argsort(-responses[scale, v, u])
    return np.stack([u, v], -1)[order], radii[scale[order]]


def _maxima(values: np.ndarray, least: float) -> np.ndarray:
    """Return the indices `[N, 3]` of the `values [A, B, C]` above `least` (>= 0) that none of their 26 neighbours exceeds."""
    peak = values > least
    for axis in range(3):  # of the six nearest first: few are left for the others
        above, of = np.moveaxis(peak, axis, 0), np.moveaxis(values, axis, 0)
        above[1:] &= of[1:] >= of[:-1]
        above[:-1] &= of[:-1] >= of[1:]
    place, padded = np.argwhere(peak), np.pad(values, 1)
    around = np.max([padded[tuple((place + step).T)] for step in np.ndindex(3, 3, 3)], 0)
    return place[values[peak] >= around]


def second_derivatives(image: np.ndarray, series: np.ndarray, sigma: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the second derivatives vv, uu and uv, `[H, W]` each, of an image smoothed by a Gaussian; borders are mirrored.

    Args:
        image: the image, `[H, W]`.
        series: `scipy.fft.dctn` of the image. If `sigma` is at least `LONG_FILTER`, each of its terms is smoothed and
            differentiated exactly.
        sigma: standard deviation of the Gaussian, px.

    Example:
        >>> image = np.random.default_rng(0).random((30, 40))
        >>> found = second_derivatives(image, fft.dctn(image), 3.0)
        >>> orders = (2, 0), (0, 2), (1, 1)
        >>> max(float(np.abs(a - ndimage.gaussian_filter(image, 3.0, b)).max()) for a, b in zip(found, orders)) < 1e-4
        True
    """
    if sigma < LONG_FILTER:
        vv, uu, uv = (ndimage.gaussian_filter(image, sigma, order) for order in ((2, 0), (0, 2), (1, 1)))
        return vv, uu, uv
    height, width = image.shape
    v, u = (np.pi / size * np.arange(size, dtype=series.dtype) for size in (height, width))
    v = v[:, None]
    smooth = series * np.exp(-(sigma**2) / 2 * v**2) * np.exp(-(sigma**2) / 2 * u**2)
    sines = np.pad((u * v * smooth)[1:, 1:], (0, 1))  # those of a DST begin with one half wave
    return fft.idctn(-(v**2) * smooth), fft.idctn(-(u**2) * smooth), fft.idstn(sines)


def grow_blob(dark: np.ndarray, seed: np.ndarray, radius: float) -> Blob | None:
    """Return the pixels around `seed` (u, v) that are darker than half way to the background; None if they are no blob."""
    reach = int(np.ceil(2.6 * radius)) + 2
    v0, u0 = max(seed[1] - reach, 0), max(seed[0] - reach, 0)
    patch = dark[v0 : seed[1] + reach + 1, u0 : seed[0] + reach + 1]
    v, u = np.mgrid[: patch.shape[0], : patch.shape[1]]
    distance = np.hypot(u + u0 - seed[0], v + v0 - seed[1])
    core = patch[distance <= max(0.5 * radius, 1)].mean()
    around = patch[(distance > 1.5 * radius + 1) & (distance < 2.4 * radius + 2)]
    background = np.median(around) if around.size else core
    if background - core < 0.04:
        return None
    labels, _ = ndimage.label(patch < (core + background) / 2)
    label = labels[seed[1] - v0, seed[0] - u0]
    blob = labels == label
    if label == 0 or blob[[0, -1]].any() or blob[:, [0, -1]].any() or blob.sum() < 4:
        return None
    position = np.stack([u[blob] + u0, v[blob] + v0], -1).astype(float)
    centre = position.mean(0)
    moments = (position - centre).T @ (position - centre) / len(position) + np.eye(2) / 12
    return Blob(len(position), centre, moments, (background - core) / max(background, 0.05))


def is_dot(area: float, moments: np.ndarray, filled: float) -> bool:
    """Whether a blob is a compact ellipse: its area agrees with its moments up to a factor of exp(`filled`).

    Example:
        >>> is_dot(4 * np.pi * 9, 9 * np.eye(2), 0.1), is_dot(4 * np.pi * 6, 9 * np.eye(2), 0.1)
        (True, False)
    """
    small, large = np.linalg.eigvalsh(moments)
    return bool(large < ELONGATION**2 * small and abs(np.log(area / (4 * np.pi * np.sqrt(small * large)))) < filled)


def check_count(count: int) -> None:
    """Refuse fewer than `FEWEST` dots."""
    if count < FEWEST:
        raise MembraneError(
            f"find_dots: {count} dots found, expected at least {FEWEST}; check focus and light, whether the dots are dark or "
            "light (polarity), and the mask if there is one"
        )


def find_blobs(dark: np.ndarray, mask: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Find every compact dark blob of an image.

    Args:
        dark: image `[H, W]` in 0..1, with dark dots.
        mask: where to search, `[H, W]` bool; None: everywhere.

    Returns:
        Centres `[N, 2]` px, shapes `[N, 2, 2]` px, contrasts `[N]`.

    Raises:
        MembraneError: fewer than 6 blobs are found.
    """
    smooth = ndimage.gaussian_filter(dark, 0.6)
    taken = np.zeros(dark.shape, bool)
    blobs = []
    for seed, radius in zip(*blob_seeds(smooth), strict=True):
        if taken[seed[1], seed[0]] or (mask is not None and not mask[seed[1], seed[0]]):
            continue
        blob = grow_blob(smooth, seed, radius)
        if blob is None or not is_dot(blob.area, blob.moments, -np.log(SOLIDITY)):
            continue
        u, v = np.round(blob.centre).astype(int)
        size = np.sqrt(blob.area / np.pi)
        margin = np.minimum(blob.centre, np.array(dark.shape[::-1]) - 1 - blob.centre).min()
        if taken[v, u] or margin < 1.5 * size + 1:
            continue
        reach = np.ceil(size).astype(int)
        taken[max(v - reach, 0) : v + reach + 1, max(u - reach, 0) : u + reach + 1] = True
        blobs.append((blob.centre, _ellipse(blob), blob.contrast))
    check_count(len(blobs))
    centres, shapes, contrasts = (np.array(x) for x in zip(*blobs, strict=True))
    return centres, shapes, contrasts


def _ellipse(blob: Blob) -> np.ndarray:
    """Return the shape `[2, 2]` px of the ellipse with the blob's area and the axes of its moments."""
    values, axes = np.linalg.eigh(blob.moments)
    return axes @ np.diag(2 * np.sqrt(values)) @ axes.T * np.sqrt(blob.area / (4 * np.pi * np.sqrt(values.prod())))
