"""Dots in the rest image: found without prior knowledge, or measured at the positions of the sensor file."""

from typing import NamedTuple

import numpy as np
import torch
from scipy.spatial import cKDTree

from ...files.levels import telling_bits
from ...torch_modes import on_cpu
from ..spacing import neighbours, partly_in_view
from .blobs import check_count, find_blobs
from .ellipse import TOLERANCE, log_radii, rms_half_axes, size_tolerance
from .fit import EllipseFit, FittedDots
from .match import DotMatcher
from .probability import alone, among_neighbours
from .pyramid import mean_pyramid
from .scales import FAINT, NEIGHBOURS, STEPS


class DotPattern(NamedTuple):
    """Markers as measured in the rest image.

    Attributes:
        pixels: centres (u, v), `[D, 2]`, px.
        shapes: shapes, `[D, 2, 2]`; pixel = centre + shape @ (unit circle).
        sizes: sizes, `[D]` int, 0 = small, 1 = large (all 1 if there is one size only).
    """

    pixels: np.ndarray
    shapes: np.ndarray
    sizes: np.ndarray


def refine(dark: np.ndarray, pixels: np.ndarray, shapes: np.ndarray, tolerance: float = TOLERANCE) -> FittedDots:
    """Fit the dots to sub-pixel accuracy, as a batch of one."""
    fit = EllipseFit(pixels, shapes, dark.shape[::-1], tolerance)
    levels = mean_pyramid(torch.as_tensor(dark)[None, None])
    found: FittedDots = fit(levels, torch.as_tensor(pixels)[None], torch.as_tensor(shapes)[None], torch.zeros(1), 8)
    return found


def population(pixels: np.ndarray, shapes: np.ndarray, contrasts: np.ndarray) -> np.ndarray:
    """Return which blobs `[N]` belong to the pattern: those with size and contrast similar to the surrounding blobs."""
    log_radius = log_radii(shapes)
    keep = np.ones(len(pixels), bool)
    for _ in range(STEPS):
        near = cKDTree(pixels[keep]).query(pixels, k=min(1 + NEIGHBOURS, keep.sum()))[1]
        radius, contrast = np.median(log_radius[keep][near], 1), np.median(contrasts[keep][near], 1)
        keep = (np.abs(log_radius - radius) < np.log(2.2)) & (contrasts > FAINT * contrast)
    return keep


def size_classes(pixels: np.ndarray, shapes: np.ndarray) -> np.ndarray:
    """Return the sizes `[D]`, 0 small, 1 large: two clusters of log radius about a common quadratic function of position;
    without two clusters all are 1."""
    log_radius = log_radii(shapes)
    x = (pixels - pixels.mean(0)) / pixels.std()
    field = np.stack([np.ones(len(x)), *x.T, x[:, 0] ** 2, x[:, 1] ** 2, x[:, 0] * x[:, 1]], -1)
    local = np.column_stack([log_radius, log_radius[neighbours(pixels, NEIGHBOURS)]])
    large = log_radius > (local.max(1) + local.min(1)) / 2
    for _ in range(20):
        basis = np.column_stack([field, large])
        fit, *_ = np.linalg.lstsq(basis, log_radius, rcond=None)
        rest = log_radius - field @ fit[:-1]
        large = rest > fit[-1] / 2
    noise = np.std(rest - fit[-1] * large)
    bimodal = fit[-1] > max(5 * noise, 0.2) and 0.1 < large.mean() < 0.9
    return large.astype(int) if bimodal else np.ones(len(x), int)


@telling_bits
@on_cpu
def find_dots(image: np.ndarray, polarity: str, mask: np.ndarray | None = None) -> DotPattern:
    """Find all dots of the pattern in the rest image, in any arrangement and of one or two sizes.

    Args:
        image: the rest image, `[H, W]`, grey in 0..1.
        polarity: "dark" or "light".
        mask: where to search, `[H, W]` bool; None: everywhere.

    Returns:
        The pattern, in rows from top to bottom.

    Raises:
        MembraneError: fewer than 6 dots are found.

    Limitations:
        Dots that touch each other or the edge of the membrane are not found.

    Example:
        >>> from torchmembrane.markers.dots.ellipse import draw_dots
        >>> drawn = 20.0 * np.stack(np.meshgrid([1, 2, 3, 4], [1, 2, 3]), -1).reshape(-1, 2)
        >>> image = draw_dots(drawn, np.tile(4.0 * np.eye(2), (12, 1, 1)), (100, 80))[0, 0].numpy()
        >>> pattern = find_dots(image, "dark")
        >>> len(pattern.pixels), bool(np.abs(np.sort(pattern.pixels, 0) - np.sort(drawn, 0)).max() < 0.05)
        (12, True)
    """
    dark = _dark(image, polarity)
    pixels, shapes, contrasts = find_blobs(dark, mask)
    keep = population(pixels, shapes, contrasts)
    check_count(int(keep.sum()))
    pixels, shapes, contrasts = pixels[keep], shapes[keep], contrasts[keep]
    found = refine(dark, pixels, shapes)
    pixels, growth = found.centre[0].numpy(), found.growth[0].numpy()
    shapes = shapes * (1 + growth / rms_half_axes(shapes))[:, None, None]
    keep = population(pixels, shapes, contrasts) & (alone(found)[0].numpy() > 0.5)
    check_count(int(keep.sum()))
    pixels, shapes = pixels[keep], shapes[keep]
    order = np.lexsort((pixels[:, 0], pixels[:, 1]))
    return DotPattern(pixels[order], shapes[order], size_classes(pixels, shapes)[order])


@telling_bits
@on_cpu
def measure_dots(image: np.ndarray, pixels: np.ndarray, shapes: np.ndarray, sizes: np.ndarray, polarity: str) -> DotPattern:
    """Measure the listed dots in the rest image.

    Args:
        image: the rest image, `[H, W]`, grey in 0..1.
        pixels: predicted centres, `[D, 2]`, px; errors of up to half a pitch are allowed.
        shapes: shapes of dots of unit radius, `[D, 2, 2]` px.
        sizes: sizes, `[D]` int, 0 = small, 1 = large.
        polarity: "dark" or "light".

    Returns:
        The pattern in the given order, with the shapes scaled by the measured radius of each size; the centre is NaN for dots
        that are not visible.

    Raises:
        MembraneError: fewer than 6 dots are found.

    Example:
        >>> from torchmembrane.markers.dots.ellipse import draw_dots
        >>> drawn = 20.0 * np.stack(np.meshgrid([1, 2, 3, 4], [1, 2, 3]), -1).reshape(-1, 2)
        >>> shapes = np.tile(np.eye(2), (12, 1, 1))
        >>> image = draw_dots(drawn, 4 * shapes, (100, 80))[0, 0].numpy()
        >>> pattern = measure_dots(image, drawn + [3, -2], shapes, np.ones(12, int), "dark")
        >>> bool(np.abs(pattern.pixels - drawn).max() < 0.05), round(float(pattern.shapes[0, 0, 0]), 1)
        (True, 4.0)
    """
    dark = _dark(image, polarity)
    pixels, shapes, sizes = np.asarray(pixels, float), np.asarray(shapes, float), np.asarray(sizes, int)
    found, outlines, contrasts = find_blobs(dark)
    keep = population(found, outlines, contrasts)
    check_count(int(keep.sum()))
    found, outlines = found[keep], outlines[keep]
    unit, log_radius = log_radii(shapes), log_radii(outlines)
    nearest = cKDTree(found).query(pixels)[1]
    back = np.asarray(cKDTree(pixels).query(found)[1])
    own = back[nearest] == np.arange(len(pixels))  # not of dots out of view, or cut by its border
    own |= ~np.isin(sizes, sizes[own])
    radius = {size: np.median((log_radius[nearest] - unit)[own & (sizes == size)]) for size in np.unique(sizes)}
    expected = unit + np.array([radius[size] for size in sizes])
    scaled = shapes * np.exp(expected - unit)[:, None, None]
    tolerance = size_tolerance(scaled, sizes)
    match = DotMatcher(pixels, expected, tolerance, partly_in_view(pixels, scaled, dark.shape[::-1]))
    blob_radius = torch.as_tensor(log_radius)[None]
    position, _, strain = match(torch.as_tensor(found)[None], blob_radius, torch.ones_like(blob_radius))
    refined = refine(dark, position[0].numpy(), scaled, tolerance)
    centre, growth = refined.centre[0].numpy(), refined.growth[0].numpy()
    steps = match.neighbour_steps(refined.centre.mT, alone(refined), strain.movedim(1, -1))
    visible = among_neighbours(refined, *steps)[0].numpy() > 0.5
    check_count(int(visible.sum()))
    for size in np.unique(sizes[visible]):
        scaled[sizes == size] *= 1 + np.median((growth / np.exp(expected))[visible & (sizes == size)])
    return DotPattern(np.where(visible[:, None], centre, np.nan), scaled, sizes)


def _dark(image: np.ndarray, polarity: str) -> np.ndarray:
    """Return the image, or its negative if the dots are light."""
    return np.asarray(image, float) if polarity == "dark" else 1 - np.asarray(image, float)
