"""Closed rims: rectangles with rounded corners, ellipses and curves through points, and the planes through them."""

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from ..errors import MembraneError
from ..surface.checks import FARTHEST

FEWEST_POINTS, MOST_POINTS = 3, 2**14
SAMPLES = 720  # points of a rectangle's or an ellipse's rim
LEAST_AREA = 1e-3  # smallest area that a rim encloses, over its length squared; a circle encloses 0.08


class Outline(NamedTuple):
    """A closed rim, in the frame of its mean plane.

    Attributes:
        points: points once around the rim, counterclockwise, in the plane, `[K, 2]`, relative to `origin`, length unit.
        heights: heights of the points above the plane, `[K]`, length unit.
        origin: centroid of the enclosed area, `[3]`, camera's frame.
        axes: the plane's two axes and its normal, which points away from the camera (z > 0), as rows, `[3, 3]`.
    """

    points: np.ndarray
    heights: np.ndarray
    origin: np.ndarray
    axes: np.ndarray

    @property
    def length(self) -> float:
        """Length of the rim's projection onto the plane."""
        return float(self.steps.sum())

    @property
    def steps(self) -> np.ndarray:
        """Distances from each point to the next one in the plane, `[K]`."""
        return np.linalg.norm(np.roll(self.points, -1, 0) - self.points, axis=1)

    @property
    def is_planar(self) -> bool:
        """Whether the rim lies in its plane, up to rounding."""
        return float(np.abs(self.heights).max()) < 1e-9 * self.length

    def camera_frame(self, points: np.ndarray) -> np.ndarray:
        """Transform points `[..., 3]` from the plane's frame to the camera's."""
        return points @ self.axes + self.origin

    def sampled(self, count: int) -> np.ndarray:
        """Return `count` points at equal steps of arc length, `[count, 3]`: two coordinates in the plane, and the height."""
        at = np.concatenate([[0.0], np.cumsum(self.steps)])
        closed = np.column_stack([self.points, self.heights])[np.r_[: len(self.points), 0]]
        wanted = np.arange(count) / count * at[-1]
        return np.stack([np.interp(wanted, at, column) for column in closed.T], -1)


def rectangle(size: tuple[float, float], corner: float = 0.0) -> np.ndarray:
    """Return a rectangle with rounded corners, centred at the origin.

    Args:
        size: lengths along x and y, length unit.
        corner: radius of the corners, at most half the shorter side.

    Returns:
        Points `[K, 2]`, counterclockwise.

    Raises:
        MembraneError: a length is not positive, or the radius is too large.

    Example:
        >>> rectangle((50.0, 36.0), 4.0).max(0).tolist()
        [25.0, 18.0]
    """
    a, b = _positive("rectangle", size)
    if not 0 <= corner <= min(a, b) / 2:
        raise MembraneError(
            f"rectangle {a:g} x {b:g}: corner = {corner:g}; expected 0 to {min(a, b) / 2:g}, half the shorter side"
        )
    quarter = np.linspace(0, np.pi / 2, SAMPLES // 8 + 1 if corner else 1)
    arcs = []
    for k, (sx, sy) in enumerate(((1, 1), (-1, 1), (-1, -1), (1, -1))):
        angle = quarter + k * np.pi / 2
        centre = np.array([sx * (a / 2 - corner), sy * (b / 2 - corner)])
        arcs.append(centre + corner * np.stack([np.cos(angle), np.sin(angle)], -1))
    points = np.concatenate(arcs)
    return points[np.linalg.norm(points - np.roll(points, 1, 0), axis=1) > 1e-12 * (a + b)]


def ellipse(size: tuple[float, float]) -> np.ndarray:
    """Return an ellipse centred at the origin.

    Args:
        size: diameters along x and y, length unit.

    Returns:
        Points `[K, 2]`, counterclockwise.

    Raises:
        MembraneError: a length is not positive.

    Example:
        >>> ellipse((50.0, 36.0)).max(0).tolist()
        [25.0, 18.0]
    """
    a, b = _positive("ellipse", size)
    angle = 2 * np.pi * np.arange(SAMPLES) / SAMPLES
    return np.stack([a / 2 * np.cos(angle), b / 2 * np.sin(angle)], -1)


def outline_of(points: ArrayLike) -> Outline:
    """Make the rim through points; the last point may repeat the first.

    The plane's normal is along the enclosed area vector, `1/2 sum x_k x x_k+1`, so that the projected area is largest.

    Args:
        points: points once around the rim, `[K, 3]`, camera's frame, length unit.

    Returns:
        The `Outline`.

    Raises:
        MembraneError: there are too few points, two points coincide, or the rim crosses itself or encloses hardly any area.

    Example:
        >>> square = outline_of([[0, 0, 5], [2, 0, 5], [2, 2, 5], [0, 2, 5]])
        >>> square.origin.tolist(), square.axes[2].tolist(), square.is_planar
        ([1.0, 1.0, 5.0], [0.0, 0.0, 1.0], True)
    """
    X = np.asarray(points, float)
    if X.ndim != 2 or X.shape[1] != 3 or len(X) > MOST_POINTS or not (np.abs(X) <= FARTHEST).all():
        raise MembraneError(
            f"outline: an array {list(X.shape)}; expected [K, 3] finite numbers up to {FARTHEST:g}, K at most {MOST_POINTS}"
        )
    if len(X) > 1 and np.allclose(X[0], X[-1], rtol=0, atol=1e-12 * np.ptp(X)):
        X = X[:-1]
    if len(X) < FEWEST_POINTS:
        raise MembraneError(f"outline: {len(X)} points; expected at least {FEWEST_POINTS}, once around the rim")
    step = np.linalg.norm(np.roll(X, -1, 0) - X, axis=1)
    if not step.min() > 1e-9 * step.sum():
        k = int(step.argmin())
        raise MembraneError(
            f"outline: points {k} and {(k + 1) % len(X)} coincide, at {X[k].tolist()}; expected distinct points"
        )
    centred = X - X.mean(0)
    area = np.cross(centred, np.roll(centred, -1, 0)).sum(0) / 2
    if not np.linalg.norm(area) > LEAST_AREA * step.sum() ** 2:
        raise MembraneError(
            "outline: the rim encloses hardly any area; expected points in their order along the rim, once around"
        )
    if area[2] < 0:  # clockwise
        X, centred, area = X[::-1], centred[::-1], -area
    axes = _axes(area / np.linalg.norm(area))
    flat = centred @ axes.T
    if _crosses_itself(flat[:, :2]):
        raise MembraneError(
            "outline: the rim crosses itself, seen along its plane's normal; expected points in their order along it"
        )
    centre = np.array([*_centroid(flat[:, :2]), flat[:, 2].mean()])
    return Outline(flat[:, :2] - centre[:2], flat[:, 2] - centre[2], X.mean(0) + centre @ axes, axes)


def encloses(rim: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Return which points are inside a closed polygon, by the number of sides to their right.

    Args:
        rim: vertices of the polygon, `[K, 2]`, in either orientation.
        points: the points to test, `[D, 2]`.

    Returns:
        Whether each point is inside, `[D]` bool.

    Example:
        >>> encloses(np.array([[0.0, 0], [4, 0], [4, 4], [2, 1], [0, 4]]), np.array([[1.0, 1], [2, 3], [5, 1]])).tolist()
        [True, False, False]
    """
    a, b = rim[None], np.roll(rim, -1, 0)[None]
    x, y = points[:, :1], points[:, 1:]
    crosses = (a[..., 1] > y) != (b[..., 1] > y)
    with np.errstate(divide="ignore", invalid="ignore"):
        at = a[..., 0] + (y - a[..., 1]) / (b[..., 1] - a[..., 1]) * (b[..., 0] - a[..., 0])
    inside: np.ndarray = (crosses & (at > x)).sum(1) % 2 == 1
    return inside


def _axes(normal: np.ndarray) -> np.ndarray:
    """Return the plane's axes as rows; the first one is the projection of the camera's x axis onto the plane (y if x is nearly
    normal to it)."""
    along = np.eye(3)[0 if abs(normal[0]) < 0.9 else 1]
    first = along - (along @ normal) * normal
    first /= np.linalg.norm(first)
    return np.stack([first, np.cross(normal, first), normal])


def _centroid(p: np.ndarray) -> np.ndarray:
    q = np.roll(p, -1, 0)
    cross = p[:, 0] * q[:, 1] - q[:, 0] * p[:, 1]
    centre: np.ndarray = ((p + q) * cross[:, None]).sum(0) / (3 * cross.sum())
    return centre


def _crosses_itself(p: np.ndarray) -> bool:
    """Return whether two non-adjacent sides intersect; all pairs are tested, in blocks."""
    q, K = np.roll(p, -1, 0), len(p)

    def side(a: np.ndarray, b: np.ndarray, c: np.ndarray) -> np.ndarray:
        found: np.ndarray = (b[..., 0] - a[..., 0]) * (c[..., 1] - a[..., 1]) - (b[..., 1] - a[..., 1]) * (
            c[..., 0] - a[..., 0]
        )
        return found

    for start in range(0, K, 512):
        i = np.arange(start, min(start + 512, K))[:, None]
        j = np.arange(K)[None]
        apart = (np.abs(i - j) > 1) & (np.abs(i - j) < K - 1)
        a, b, c, d = p[i], q[i], p[j], q[j]
        meet = (side(a, b, c) * side(a, b, d) < 0) & (side(c, d, a) * side(c, d, b) < 0)
        if (meet & apart).any():
            return True
    return False


def _positive(shape: str, size: tuple[float, float]) -> tuple[float, float]:
    a, b = size
    if not (0 < a <= FARTHEST and 0 < b <= FARTHEST):
        raise MembraneError(f"{shape}: size = {a:g}, {b:g}; expected two positive lengths, up to {FARTHEST:g}")
    return a, b
