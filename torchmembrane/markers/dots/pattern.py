"""Dots in the rest image: found without any prior, or measured where the sensor file says they are."""

from typing import NamedTuple

import numpy as np
import torch
from scipy.spatial import cKDTree

from .blobs import find_blobs
from .ellipse import size_tolerance
from .fit import EllipseFit
from .locator import STRAY
from .match import DotMatcher
from .pyramid import pyramid


class DotPattern(NamedTuple):
    """Markers as measured in the rest image.

    pixels: `[D, 2]` centres (u, v); shapes: `[D, 2, 2]`, pixel = centre + shape @ (unit circle);
    sizes: `[D]` int, 0 = small, 1 = large (one size only: all 1).
    """

    pixels: np.ndarray
    shapes: np.ndarray
    sizes: np.ndarray


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
    seen = (quality > 0.3) & (stray < STRAY * match.nearest.numpy())
    for size in np.unique(sizes):
        scaled[sizes == size] *= 1 + np.median((growth / np.exp(expected))[seen & (sizes == size)])
    return DotPattern(np.where(seen[:, None], centre, np.nan), scaled, sizes)
