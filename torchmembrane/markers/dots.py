"""Dots in the rest image: found without any prior, or measured where the sensor file says they are."""

from typing import NamedTuple

import numpy as np
import torch
from scipy import ndimage
from scipy.spatial import cKDTree

from ..errors import MembraneError
from .locate import STRAY, EllipseFit, pyramid, size_tolerance
from .match import DotMatcher

SCALES = 1.25  # ratio of neighbouring scales
SMALLEST = 1.2  # px, radius of the smallest dot looked for
LARGEST = 1 / 16  # radius of the largest, of the image's shorter side
ELONGATION = 4.0  # long over short axis of a dot at most
SOLIDITY = 0.75  # of its ellipse that a dot fills, or a dot that its ellipse fills


class DotPattern(NamedTuple):
    """Markers as measured in the rest image.

    pixels: `[D, 2]` centres (u, v); shapes: `[D, 2, 2]`, pixel = centre + shape @ (unit circle);
    sizes: `[D]` int, 0 = small, 1 = large (one size only: all 1).
    """

    pixels: np.ndarray
    shapes: np.ndarray
    sizes: np.ndarray


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


def refine(dark, pixels, shapes, tolerance=0.45):
    """Centres `[D, 2]` fitted to sub-pixel accuracy, the outline's growth `[D]` px, quality `[D]` in 0..1."""
    fit = EllipseFit(pixels, shapes, dark.shape[::-1], tolerance, steps=8)
    levels = pyramid(torch.as_tensor(dark)[None, None])
    return tuple(x[0].numpy() for x in fit(levels, torch.as_tensor(pixels)[None], torch.as_tensor(shapes)[None]))


def population(pixels, shapes, contrasts):
    """Which blobs `[N]` belong to the pattern: their size and contrast is near that of the blobs around them."""
    log_radius = 0.5 * np.log(np.abs(np.linalg.det(shapes)))
    keep = np.ones(len(pixels), bool)
    for _ in range(3):
        tree = cKDTree(pixels[keep])
        near = tree.query(pixels, k=min(9, keep.sum()))[1]
        radius, contrast = np.median(log_radius[keep][near], 1), np.median(contrasts[keep][near], 1)
        keep = (np.abs(log_radius - radius) < np.log(2.2)) & (contrasts > 0.35 * contrast)
    return keep


def size_classes(pixels, shapes):
    """`[D]` 0 small, 1 large: two clusters of log radius about a common quadratic field of the view, else all 1."""
    log_radius = 0.5 * np.log(np.abs(np.linalg.det(shapes)))
    x = (pixels - pixels.mean(0)) / pixels.std()
    field = np.stack([np.ones(len(x)), *x.T, x[:, 0] ** 2, x[:, 1] ** 2, x[:, 0] * x[:, 1]], -1)
    near = cKDTree(pixels).query(pixels, k=min(9, len(pixels)))[1]
    local = log_radius[near]
    large = log_radius > (local.max(1) + local.min(1)) / 2
    for _ in range(20):
        basis = np.column_stack([field, large])
        fit, *_ = np.linalg.lstsq(basis, log_radius, rcond=None)
        rest = log_radius - field @ fit[:-1]
        large = rest > fit[-1] / 2
    noise = np.std(rest - fit[-1] * large)
    bimodal = fit[-1] > max(5 * noise, 0.2) and 0.1 < large.mean() < 0.9
    return large.astype(int) if bimodal else np.ones(len(x), int)


def find_dots(image, polarity, mask=None):
    """All dots of the pattern in the rest image, any arrangement, one size or two.

    image: `[H, W]` grey 0..1; polarity: "dark" or "light"; mask: `[H, W]` bool, where to look.
    Returns a `DotPattern`. Wrong when dots touch one another or the edge of the membrane.
    """
    dark = np.asarray(image, float) if polarity == "dark" else 1 - np.asarray(image, float)
    pixels, shapes, contrasts = find_blobs(dark, mask)
    keep = population(pixels, shapes, contrasts)
    pixels, shapes, contrasts = pixels[keep], shapes[keep], contrasts[keep]
    pixels, growth, quality = refine(dark, pixels, shapes)
    shapes = shapes * (1 + growth / (np.linalg.norm(shapes, axis=(1, 2)) / 2**0.5))[:, None, None]
    keep = population(pixels, shapes, contrasts) & (quality > 0.3)
    pixels, shapes = pixels[keep], shapes[keep]
    order = np.lexsort((pixels[:, 0], pixels[:, 1]))
    return DotPattern(pixels[order], shapes[order], size_classes(pixels, shapes)[order])


def measure_dots(image, pixels, shapes, sizes, polarity):
    """The listed dots measured in the rest image.

    image: `[H, W]` grey 0..1; pixels: `[D, 2]` predicted centres, off by up to half a pitch; shapes: `[D, 2, 2]` px, of
    dots of unit radius; sizes: `[D]` int; polarity: "dark" or "light".
    Returns a `DotPattern`, shapes scaled by each size's radius as found, the centre NaN where a dot is not seen.
    """
    dark = np.asarray(image, float) if polarity == "dark" else 1 - np.asarray(image, float)
    pixels, shapes, sizes = np.asarray(pixels, float), np.asarray(shapes, float), np.asarray(sizes, int)
    found, outlines, contrasts = find_blobs(dark)
    keep = population(found, outlines, contrasts)
    found, outlines = found[keep], outlines[keep]
    unit = 0.5 * np.log(np.abs(np.linalg.det(shapes)))
    log_radius = 0.5 * np.log(np.abs(np.linalg.det(outlines)))
    nearest = cKDTree(found).query(pixels)[1]
    radius = {size: np.median((log_radius[nearest] - unit)[sizes == size]) for size in np.unique(sizes)}
    expected = unit + np.array([radius[size] for size in sizes])
    scaled = shapes * np.exp(expected - unit)[:, None, None]
    tolerance = size_tolerance(scaled, sizes)
    match = DotMatcher(pixels, expected, tolerance)
    blobs, log_radius = torch.as_tensor(found)[None], torch.as_tensor(log_radius)[None]
    place, certainty, strain = match(blobs, log_radius, torch.ones_like(log_radius))
    centre, growth, quality = refine(dark, place[0].numpy(), scaled, tolerance)
    weight = certainty * torch.as_tensor(quality)
    predicted, _, _ = match.predict(weight, torch.as_tensor(centre - pixels)[None], strain)
    stray = np.linalg.norm(centre - pixels - predicted[0].numpy(), axis=1)
    visible = (quality > 0.3) & (stray < STRAY * match.nearest.numpy())
    for size in np.unique(sizes):
        scaled[sizes == size] *= 1 + np.median((growth / np.exp(expected))[visible & (sizes == size)])
    return DotPattern(np.where(visible[:, None], centre, np.nan), scaled, sizes)
