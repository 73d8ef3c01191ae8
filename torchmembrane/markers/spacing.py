"""How far apart markers are, and which are next to one another."""

import numpy as np
from scipy.spatial import cKDTree
from torch import Tensor

FADED = 30.0
"""Exponent of a weight that no longer counts; products with subnormal numbers take fifty times as long."""


def faded(exponent: np.ndarray) -> np.ndarray:
    """`exp(exponent)`, 0 where it no longer counts.

    Example:
        >>> faded(np.array([0.0, -40.0])).tolist()
        [1.0, 0.0]
    """
    return np.where(exponent > -FADED, np.exp(exponent), 0.0)


def spacing(pixels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The local spacing of markers.

    Args:
        pixels: marker centres `[D, 2]`, px.

    Returns:
        Distance of each marker to its nearest neighbour `[D]` and the mean over its four nearest `[D]`, px.

    Example:
        >>> nearest, mean = spacing(np.array([[0.0, 0.0], [3.0, 0.0], [0.0, 4.0]]))
        >>> nearest.tolist(), mean.tolist()
        ([3.0, 3.0, 4.0], [3.5, 4.0, 4.5])
    """
    distance = np.asarray(cKDTree(pixels).query(pixels, k=min(5, len(pixels)))[0])[:, 1:]
    return distance[:, 0], distance.mean(1)


def neighbours(points: np.ndarray, count: int) -> np.ndarray:
    """The points nearest to each of `points`, itself left out.

    Args:
        points: `[N, 2]` or `[N, 3]`.
        count: how many neighbours are wanted; fewer where there are no more points.

    Returns:
        Indices `[N, count]`, the nearest first.

    Example:
        >>> neighbours(np.array([[0.0, 0.0], [3.0, 0.0], [0.0, 4.0]]), 1).tolist()
        [[1], [0], [0]]
    """
    return np.asarray(cKDTree(points).query(points, k=min(count + 1, len(points)))[1])[:, 1:]


def in_view(pixels: np.ndarray, image_size: tuple[int, int]) -> np.ndarray:
    """Which of `pixels [D, 2]` lie in an image of that width and height, `[D]` bool.

    Example:
        >>> in_view(np.array([[0.0, 479.0], [640.0, 3.0], [np.nan, 3.0]]), (640, 480)).tolist()
        [True, False, False]
    """
    return np.all(np.logical_and(pixels >= 0, pixels <= np.array(image_size) - 1), axis=1)


def partly_in_view(pixels: np.ndarray, shapes: np.ndarray, image_size: tuple[int, int]) -> np.ndarray:
    """Which dots reach into an image of that width and height, `[D]` bool, also where the border cuts off a part of them.

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
    """Every point of `points [N, 2]` farther than `gap` from those kept before it: `[M, 2]`."""
    kept: list[np.ndarray] = []
    for point in points:
        if all(np.hypot(*(point - other)) > gap for other in kept):
            kept.append(point)
    return np.array(kept).reshape(-1, 2)


def square_distance(x: Tensor, y: Tensor) -> Tensor:
    """`[..., K, D]` between the points `x [..., K, 2]` and `y [..., D, 2]`."""
    return (x.square().sum(-1)[..., None] + y.square().sum(-1)[..., None, :]).sub(x @ y.mT, alpha=2).clamp_min(0)


def safe_length(x: Tensor, dim: int) -> Tensor:
    """Length of the vectors along `dim`, at least 1e-6: its gradient is finite also where the vector vanishes."""
    return x.square().sum(dim).clamp_min(1e-12).sqrt()
