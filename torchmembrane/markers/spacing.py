"""Distances between markers, and their nearest neighbours."""

import numpy as np
from scipy.spatial import cKDTree
from torch import Tensor

FADED = 30.0
"""Exponent below which a weight is set to zero; products with subnormal numbers take fifty times as long."""


def faded(exponent: np.ndarray) -> np.ndarray:
    """Return `exp(exponent)`, or 0 where it is negligible.

    Example:
        >>> faded(np.array([0.0, -40.0])).tolist()
        [1.0, 0.0]
    """
    return np.where(exponent > -FADED, np.exp(exponent), 0.0)


def spacing(pixels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the local spacing of markers.

    Args:
        pixels: marker centres `[D, 2]`, px.

    Returns:
        The distance of each marker to its nearest neighbour `[D]`, and the mean distance to its four nearest `[D]`, px.

    Example:
        >>> nearest, mean = spacing(np.array([[0.0, 0.0], [3.0, 0.0], [0.0, 4.0]]))
        >>> nearest.tolist(), mean.tolist()
        ([3.0, 3.0, 4.0], [3.5, 4.0, 4.5])
    """
    distance = np.asarray(cKDTree(pixels).query(pixels, k=min(5, len(pixels)))[0])[:, 1:]
    return distance[:, 0], distance.mean(1)


def neighbours(points: np.ndarray, count: int) -> np.ndarray:
    """Return the nearest neighbours of each of `points`, without the point itself.

    Args:
        points: `[N, 2]` or `[N, 3]`.
        count: number of neighbours; fewer if there are not enough points.

    Returns:
        Indices `[N, count]`, the nearest first.

    Example:
        >>> neighbours(np.array([[0.0, 0.0], [3.0, 0.0], [0.0, 4.0]]), 1).tolist()
        [[1], [0], [0]]
    """
    return np.asarray(cKDTree(points).query(points, k=min(count + 1, len(points)))[1])[:, 1:]


def in_view(pixels: np.ndarray, image_size: tuple[int, int]) -> np.ndarray:
    """Return which of `pixels [D, 2]` lie in an image of this width and height, `[D]` bool.

    Example:
        >>> in_view(np.array([[0.0, 479.0], [640.0, 3.0], [np.nan, 3.0]]), (640, 480)).tolist()
        [True, False, False]
    """
    return np.all(np.logical_and(pixels >= 0, pixels <= np.array(image_size) - 1), axis=1)


def partly_in_view(pixels: np.ndarray, shapes: np.ndarray, image_size: tuple[int, int]) -> np.ndarray:
    """Return which dots lie at least partly in an image of this width and height, `[D]` bool.

    Args:
        pixels: centres `[D, 2]`, px.
        shapes: `[D, 2, 2]` px, pixel = centre + shape @ (unit circle).
        image_size: width, height.

    Example:
        >>> pixels, shapes = np.array([[-2.0, 5.0], [8.0, 5.0], [18.0, 5.0], [28.0, 5.0]]), np.tile(4 * np.eye(2), (4, 1, 1))
        >>> partly_in_view(pixels, shapes, (16, 16)).tolist()
        [True, True, True, False]
    """
    extent = np.linalg.norm(shapes, axis=2)
    return np.all((pixels > -extent) & (pixels < np.array(image_size) - 1 + extent), axis=1)


def thin_out(points: np.ndarray, gap: float) -> np.ndarray:
    """Keep each point of `points [N, 2]` that is farther than `gap` from those kept before it: `[M, 2]`."""
    kept: list[np.ndarray] = []
    for point in points:
        if all(np.hypot(*(point - other)) > gap for other in kept):
            kept.append(point)
    return np.array(kept).reshape(-1, 2)


def square_distance(x: Tensor, y: Tensor) -> Tensor:
    """Return the squared distances `[..., K, D]` between points `x [..., K, 2]` and `y [..., D, 2]`."""
    return (x.square().sum(-1)[..., None] + y.square().sum(-1)[..., None, :]).sub(x @ y.mT, alpha=2).clamp_min(0)


def safe_length(x: Tensor, dim: int) -> Tensor:
    """Return the length of vectors along `dim`, at least 1e-6, so that its gradient is finite even at zero."""
    return x.square().sum(dim).clamp_min(1e-12).sqrt()
