"""Projection onto a triangulated surface: the closest point to a given point, and the first point that a ray meets.

It is computed with numpy once for each sensor, and is exact on the linear triangles.
"""

from typing import NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from ..solve.symmetric_2x2 import symmetric_adjugate_product, symmetric_determinant

NEAREST = 24  # triangles, by the distance of their centroids, in which the closest point is searched
CHUNK = 128  # rays that are intersected with all triangles at a time
EDGES = ((0, 1), (1, 2), (2, 0))


class SurfacePoints(NamedTuple):
    """Material points of a surface, each on one triangle.

    Attributes:
        vertices: vertex indices of the triangle, `[D, 3]` int.
        weights: barycentric coordinates, `[D, 3]`.
        distance: distance of the projected point (length unit), or the range along a ray, NaN where the ray misses; `[D]`.

    Example:
        >>> from torchmembrane.surface.shapes import spherical_cap
        >>> points = spherical_cap(12.0, 9.0, 15.0).closest_points([[0.0, 0.0, 25.0]])
        >>> points.vertices.shape, points.weights.sum().round(6).item(), points.distance.round(2).tolist()
        ((1, 3), 1.0, [1.0])
    """

    vertices: np.ndarray
    weights: np.ndarray
    distance: np.ndarray


def closest_points(X: np.ndarray, triangles: np.ndarray, points: np.ndarray) -> SurfacePoints:
    """Return the points of a surface that are closest to given points.

    Args:
        X: vertices `[V, 3]`.
        triangles: vertex indices of the triangles, `[T, 3]`.
        points: `[D, 3]`.

    Returns:
        `SurfacePoints` with the distances.

    Limitations:
        Only the `NEAREST` triangles, by their centroids, are searched, so the triangles must be of similar size.
    """
    corners = X[triangles]
    near = np.asarray(cKDTree(corners.mean(1)).query(points, k=min(NEAREST, len(triangles)))[1])
    weights, distance = _closest_on_triangles(points[:, None], corners[near])
    best = distance.argmin(1)
    row = np.arange(len(points))
    return SurfacePoints(triangles[near[row, best]], weights[row, best], distance[row, best])


def ray_points(X: np.ndarray, triangles: np.ndarray, origins: np.ndarray, directions: np.ndarray) -> SurfacePoints:
    """Return the points of a surface that rays meet first.

    Args:
        X: vertices `[V, 3]`.
        triangles: vertex indices of the triangles, `[T, 3]`.
        origins: origins of the rays, `[D, 3]`.
        directions: unit directions of the rays, `[D, 3]`.

    Returns:
        `SurfacePoints` with the ranges along the rays, NaN for a ray that misses.
    """
    corners = X[triangles]
    chunks = range(CHUNK, len(origins), CHUNK)
    starts, ways = (np.split(a[:, None], chunks) for a in (origins, directions))
    hits = [_first_hits(start, way, corners) for start, way in zip(starts, ways, strict=True)]
    first, weights, distance = (np.concatenate(part) for part in zip(*hits, strict=True))
    return SurfacePoints(triangles[first], weights, distance)


def _first_hits(start: np.ndarray, d: np.ndarray, triangles: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the first triangle that every ray `[D, 1, 3]` meets, the barycentric coordinates there, and the range (NaN if
    there is none), by the method of Moller and Trumbore."""
    a, b, c = triangles.transpose(1, 0, 2)
    normal = np.cross(b - a, c - a)
    with np.errstate(divide="ignore", invalid="ignore"):
        area2 = (d * normal).sum(-1)
        ranges = ((a - start) * normal).sum(-1) / area2
        u = (np.cross(c - a, d) * (start - a)).sum(-1) / area2
        v = (np.cross(d, b - a) * (start - a)).sum(-1) / area2
    w = np.stack([1 - u - v, u, v], -1)
    ranges = np.where((w > -1e-9).all(-1) & (ranges > 0), ranges, np.inf)
    first, row = ranges.argmin(1), np.arange(len(ranges))
    distance = ranges[row, first]
    hit = np.isfinite(distance)
    return first, np.where(hit[:, None], w[row, first], 1 / 3), np.where(hit, distance, np.nan)


def _closest_on_triangles(p: np.ndarray, triangles: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the barycentric coordinates and the distance of the point of each triangle `[..., 3, 3]` closest to `p [..., 3]`.

    It is the orthogonal projection to the triangle's plane if that lies inside, otherwise the closest of the projections to the
    three edges.
    """
    a, b, c = triangles[..., 0, :], triangles[..., 1, :], triangles[..., 2, :]
    ab, ac, ap = b - a, c - a, p - a
    metric = _dot(ab, ab), _dot(ab, ac), _dot(ac, ac)
    v, w = symmetric_adjugate_product(*metric, _dot(ap, ab), _dot(ap, ac))
    det = np.maximum(symmetric_determinant(*metric), 1e-300)
    v, w = v / det, w / det
    inside = np.stack([1 - v - w, v, w], -1)
    candidates = [np.where((inside >= 0).all(-1, keepdims=True), inside, np.nan)]
    for s, e in EDGES:
        start, edge = triangles[..., s, :], triangles[..., e, :] - triangles[..., s, :]
        u = np.clip(_dot(p - start, edge) / np.maximum(_dot(edge, edge), 1e-300), 0, 1)
        on_edge = np.zeros(inside.shape)
        on_edge[..., s], on_edge[..., e] = 1 - u, u
        candidates.append(on_edge)
    weights = np.stack(candidates, -2)
    distance = np.linalg.norm(weights @ triangles - p[..., None, :], axis=-1)
    distance = np.where(np.isnan(distance), np.inf, distance)
    best = distance.argmin(-1)[..., None]
    return np.take_along_axis(weights, best[..., None], -2)[..., 0, :], np.take_along_axis(distance, best, -1)[..., 0]


def _dot(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    product: np.ndarray = (x * y).sum(-1)
    return product
