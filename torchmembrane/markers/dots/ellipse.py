"""A dot's elliptical outline in the image: pixel = centre + shape @ (unit circle)."""

import numpy as np
import torch
from torch import Tensor

SOFTNESS = 0.6  # px, logistic scale of a dot's blurred outline
TOLERANCE = 0.45
"""Standard deviation of a dot's log radius; for two sizes that differ by less than 1, relative to their difference."""


def half_axes(shapes: np.ndarray) -> np.ndarray:
    """Return the long and short half axes `[D, 2]` of the ellipses `shapes [D, 2, 2]`.

    Example:
        >>> half_axes(np.array([[[0.0, 2.0], [5.0, 0.0]]])).tolist()
        [[5.0, 2.0]]
    """
    return np.linalg.svd(shapes, compute_uv=False)


def log_radii(shapes: np.ndarray) -> np.ndarray:
    """Return the logarithms `[D]` of the radii of circles with the areas of the ellipses `shapes [D, 2, 2]`.

    Example:
        >>> np.exp(log_radii(np.array([[[0.0, 2.0], [8.0, 0.0]]]))).tolist()
        [4.0]
    """
    return 0.5 * np.log(np.abs(np.linalg.det(shapes)))


def rms_half_axes(shapes: np.ndarray) -> np.ndarray:
    """Return the root mean square `[D]` of the two half axes of the ellipses `shapes [D, 2, 2]`."""
    return np.linalg.norm(shapes, axis=(1, 2)) / 2**0.5


def size_tolerance(shapes: np.ndarray, sizes: np.ndarray) -> float:
    """Return the standard deviation of a dot's log radius: large, but less than half of the difference between two sizes.

    Args:
        shapes: shapes of the dots, `[D, 2, 2]`, px.
        sizes: sizes of the dots, `[D]` int, 0 = small, 1 = large.

    Example:
        >>> size_tolerance(np.tile(np.eye(2), (3, 1, 1)), np.ones(3, int))
        0.45
    """
    if sizes.min() == sizes.max():
        return TOLERANCE
    log_radius = log_radii(shapes)
    return TOLERANCE * min(1.0, abs(float(np.median(log_radius[sizes == 1]) - np.median(log_radius[sizes == 0]))))


def draw_dots(pixels: np.ndarray, shapes: np.ndarray, image_size: tuple[int, int]) -> Tensor:
    """Draw the pattern as dark dots on white.

    Args:
        pixels: centres, `[D, 2]`, px.
        shapes: shapes, `[D, 2, 2]`, px.
        image_size: width, height.

    Returns:
        Image `[1, 1, H, W]` in 0..1, float64.

    Example:
        >>> image = draw_dots(np.array([[8.0, 6.0]]), 3 * np.eye(2)[None], (20, 12))
        >>> list(image.shape), [round(float(image[0, 0, 6, u]), 2) for u in (8, 11, 14)]
        ([1, 1, 12, 20], [0.11, 0.55, 0.99])
    """
    width, height = image_size
    image = np.ones((height, width))
    for centre, shape in zip(pixels, shapes, strict=True):
        reach = int(half_axes(shape)[0]) + 4
        low, high = np.round(centre).astype(int) - reach, np.round(centre).astype(int) + reach + 1
        u, v = np.arange(max(low[0], 0), min(high[0], width)), np.arange(max(low[1], 0), min(high[1], height))
        y = (np.stack(np.meshgrid(u, v), -1) - centre) @ np.linalg.inv(shape).T
        depth = (1 - np.linalg.norm(y, axis=-1)) * np.sqrt(abs(np.linalg.det(shape)))
        image[np.ix_(v, u)] -= 0.9 / (1 + np.exp(-depth / SOFTNESS))
    return torch.as_tensor(image.clip(0))[None, None]
