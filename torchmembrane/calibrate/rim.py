"""The outline of the rim in a rest image, without anything known before: the ellipse along which the grey steps most."""

from typing import NamedTuple

import numpy as np
from scipy.ndimage import gaussian_filter, map_coordinates, maximum_filter1d

from ..errors import MembraneError
from ..files.levels import too_few_bits

RAYS = 180
SMOOTH = 1.5  # px, of the image before its edges are taken
FAINT = 0.01  # grey per px: fainter steps are no edges
FAINTER = 0.1  # nor are those so much fainter than the strongest
STRONGEST = 3  # edges of each ray that are tried
TRIALS = 4000
WIDE = 3.0  # px, by which an edge may be off the first ellipse
CLOSE = 1.5  # px, off the last
INSIDE = 0.95  # of the markers, at least, lie within the rim
SMALLEST = 0.15  # half axis, of the image's shorter side
FLATTEST = 0.5  # half axes' ratio
OFF_CENTRE = 0.25  # of the image's sides, that the rim's middle is from the image's
SEEN = 0.6  # of the outline within the image shows an edge, at least
IN_IMAGE = 0.5  # of the outline lies within the image, at least
LOCATION_ERROR = 0.3  # px, of an edge as a whole: what light and blur shift (docs/own_sensor.md)
ROUNDS = 6


class RimOutline(NamedTuple):
    """The rim as an image shows it.

    Attributes:
        centre: `(u, v)` px.
        half_axes: the longer and the shorter one, px.
        deviation: standard deviation of centre and half axes, px.
        share: share of the outline within the image along which an edge is seen.
    """

    centre: tuple[float, float]
    half_axes: tuple[float, float]
    deviation: float
    share: float


class _Steps(NamedTuple):
    """Steps of grey along rays from a point within: `[RAYS, R]`, one column a pixel; NaN beyond the image."""

    origin: np.ndarray
    directions: np.ndarray
    steps: np.ndarray


def find_rim(image: np.ndarray, inside: np.ndarray | None = None) -> RimOutline:
    """The ellipse around the membrane along which the grey steps in one sense, from light to dark or from dark to light.

    Edges are found on rays from the middle. Ellipses through five of them at random, and circles through three, are judged by
    how much of their length shows an edge (RANSAC); the best is fitted to its edges by least squares.

    Args:
        image: `[H, W]` grey in 0..1, of the membrane at rest.
        inside: `[D, 2]` px, markers; their edges are passed over, and the rim encloses them.

    Returns:
        The outline.

    Raises:
        MembraneError: no outline shows an edge over `SEEN` of its length, with `IN_IMAGE` of it in the image.

    Limitations:
        A ring that holds the membrane has an inner and an outer edge: the one that is seen better is found. Look at it
        (`torchmembrane check --out`).

    Example:
        >>> v, u = np.mgrid[:120, :160]
        >>> rim = find_rim((np.hypot(u - 82, v - 61) < 50).astype(float))
        >>> [round(number) for number in (*rim.centre, *rim.half_axes)]
        [82, 61, 50, 50]
    """
    seen = _steps(image, inside)
    found = [outline for sense in (1, -1) if (outline := _best(seen, sense, image.shape, inside)) is not None]
    best = max(found, key=lambda outline: outline.share, default=None)
    if best is None or best.share < SEEN:
        share = 0.0 if best is None else best.share
        raise MembraneError(
            f"no rim is seen in the rest image: the best outline shows an edge along {share:.0%} of its length; expected a rim "
            f"of which half is in the image and {SEEN:.0%} stands out from what is around it: read it off, --rim U,V,RADIUS"
            f"{too_few_bits(image)}"
        )
    return best


def _steps(image: np.ndarray, inside: np.ndarray | None) -> _Steps:
    height, width = image.shape
    smooth = gaussian_filter(image.astype(float), SMOOTH)
    origin = np.array([width - 1, height - 1]) / 2 if inside is None else (inside.min(0) + inside.max(0)) / 2
    angle = 2 * np.pi * np.arange(RAYS) / RAYS
    directions = np.stack([np.cos(angle), np.sin(angle)], -1)
    radii = np.arange(int(np.hypot(height, width)))
    u, v = (origin + radii[:, None] * directions[:, None]).transpose(2, 0, 1)
    grey = map_coordinates(smooth, [v, u], order=1, cval=np.nan)
    steps = np.gradient(grey, axis=1)
    if inside is not None:
        steps[radii < _hull(inside - origin, directions)[:, None]] = 0.0
    return _Steps(origin, directions, steps)


def _hull(points: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """How far markers `[D, 2]` reach along each direction `[N, 2]`, those within a twentieth of a turn."""
    reach, along = np.linalg.norm(points, axis=1), points @ directions.T
    near = along > np.cos(np.pi / 10) * reach[:, None]
    return np.where(near, reach[:, None], 0.0).max(0)


def _best(seen: _Steps, sense: int, shape: tuple[int, ...], inside: np.ndarray | None) -> RimOutline | None:
    """The outline of one sense, +1: lighter outside; None where there are no edges."""
    steps = np.nan_to_num(sense * seen.steps)
    strong = float(np.quantile(steps.max(1), 0.5))
    peaks = (steps > max(FAINT, FAINTER * strong)) & (steps == maximum_filter1d(steps, 5, axis=1))
    ray, radius = np.nonzero(peaks)
    if len(np.unique(ray)) < 5:
        return None
    points = radius[:, None] * seen.directions[ray]
    conics = _trials(steps, points, ray, radius)
    conics = conics[_is_possible(conics, seen, shape, inside)]
    if not len(conics):
        return None
    contrast = maximum_filter1d(np.where(peaks, (steps / strong).clip(0, 1), 0.0), 2 * int(WIDE) + 1, axis=1)
    conic = conics[_share(conics, seen, contrast).argmax()]
    for tolerance in np.linspace(WIDE, CLOSE, ROUNDS):
        off = abs(_reach(conic[None], seen.directions)[0, ray] - radius)
        kept = off < tolerance
        if kept.sum() < 10:
            return None
        conic = _fitted(points[kept])
    if not _is_possible(conic[None], seen, shape, inside)[0]:
        return None
    return _outline(conic, seen, steps, peaks)


def _trials(steps: np.ndarray, points: np.ndarray, ray: np.ndarray, radius: np.ndarray) -> np.ndarray:
    """Conics `[N, 5]` through edges at random, `TRIALS` ellipses and as many circles."""
    strength = steps[ray, radius]
    order = np.lexsort((-strength, ray))
    rank = np.empty(len(ray), int)
    rank[order] = np.arange(len(ray)) - np.searchsorted(ray[order], ray[order])
    pool, rng = points[rank < STRONGEST], np.random.default_rng(0)
    ellipses = _through(pool[rng.integers(len(pool), size=(TRIALS, 5))], slice(None))
    circles = _through(pool[rng.integers(len(pool), size=(TRIALS, 3))], slice(3))
    return np.concatenate([ellipses, circles])


def _through(points: np.ndarray, terms: slice) -> np.ndarray:
    """Conics `[N, 5]` through points `[N, k, 2]` about the origin, of the first `terms` of `_monomials`."""
    matrix = _monomials(points)[..., terms]
    solved = np.zeros((len(points), 5))
    regular = abs(np.linalg.det(matrix / abs(matrix).mean((0, 1)))) > 1e-9
    solved[regular, terms] = np.linalg.solve(matrix[regular], np.ones((regular.sum(), matrix.shape[1], 1)))[..., 0]
    return solved


def _monomials(points: np.ndarray) -> np.ndarray:
    """Of a conic `a (x^2 + y^2) + b x + c y + d (x^2 - y^2) + e x y = 1`, `[..., 5]`."""
    x, y = points[..., 0], points[..., 1]
    return np.stack([x * x + y * y, x, y, x * x - y * y, x * y], -1)


def _fitted(points: np.ndarray) -> np.ndarray:
    """The conic `[5]` near points `[N, 2]`, by least squares."""
    rows = _monomials(points)
    size = abs(rows).mean(0)
    return np.linalg.lstsq(rows / size, np.ones(len(rows)), rcond=None)[0] / size


def _reach(conics: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """How far from the origin each conic `[N, 5]` cuts each direction `[R, 2]`, px."""
    terms = _monomials(directions)
    square, linear = conics[:, [0, 3, 4]] @ terms[:, [0, 3, 4]].T, conics[:, 1:3] @ directions.T
    with np.errstate(invalid="ignore", divide="ignore"):
        return (-linear + np.sqrt(linear**2 + 4 * square)) / (2 * square)


def _ellipses(conics: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Centres `[N, 2]` and half axes `[N, 2]`, the longer one first, px; NaN where a conic is no ellipse."""
    a, b, c, d, e = conics.T
    form = np.stack([np.stack([a + d, e / 2], -1), np.stack([e / 2, a - d], -1)], -2)
    proper = a > np.hypot(d, e / 2)
    centre, axes = np.full((2, len(conics), 2), np.nan)
    gradient = np.stack([b, c], -1)[proper]
    middle = -0.5 * np.linalg.solve(form[proper], gradient[..., None])[..., 0]
    level = 1 - 0.5 * (gradient * middle).sum(-1)
    with np.errstate(invalid="ignore"):
        centre[proper], axes[proper] = middle, np.sqrt(level[:, None] / np.linalg.eigvalsh(form[proper]))
    return centre, axes


def _is_possible(conics: np.ndarray, seen: _Steps, shape: tuple[int, ...], inside: np.ndarray | None) -> np.ndarray:
    """Whether a conic `[N]` is an ellipse that may be the rim."""
    centre, axes = _ellipses(conics)
    with np.errstate(invalid="ignore"):
        possible = (axes[:, 1] > SMALLEST * min(shape)) & (axes[:, 1] > FLATTEST * axes[:, 0])
        possible &= (abs(centre + seen.origin - np.array(shape[::-1]) / 2) < OFF_CENTRE * np.array(shape[::-1])).all(1)
    if inside is not None:
        possible &= (_monomials(inside - seen.origin) @ conics.T < 1).mean(0) >= INSIDE
    radius = np.nan_to_num(_reach(conics, seen.directions), nan=0.0).clip(0, seen.steps.shape[1] - 1).astype(int)
    within = np.isfinite(seen.steps[np.arange(RAYS), radius])
    return possible & (within.mean(1) >= IN_IMAGE)


def _share(conics: np.ndarray, seen: _Steps, edges: np.ndarray) -> np.ndarray:
    """Mean `[N]` of the edges `[RAYS, R]`, 0 or 1 or between, along the conics within the image."""
    radius = np.rint(np.nan_to_num(_reach(conics, seen.directions)).clip(0, seen.steps.shape[1] - 1)).astype(int)
    rays = np.arange(RAYS)
    within = np.isfinite(seen.steps[rays, radius])
    return (edges[rays, radius] * within).sum(1) / within.sum(1).clip(1)


def _outline(conic: np.ndarray, seen: _Steps, steps: np.ndarray, peaks: np.ndarray) -> RimOutline:
    """The outline, fitted to the edges' places between pixels."""
    for _ in range(2):
        ray, radius = np.nonzero(peaks)
        kept = (
            (abs(_reach(conic[None], seen.directions)[0, ray] - radius) < CLOSE) & (radius > 0) & (radius < steps.shape[1] - 1)
        )
        ray, radius = ray[kept], radius[kept]
        before, at, after = (steps[ray, radius + k] for k in (-1, 0, 1))
        edge = radius + (before - after) / (2 * np.minimum(before - 2 * at + after, -1e-12))
        conic = _fitted(edge[:, None] * seen.directions[ray])
    off = edge - _reach(conic[None], seen.directions)[0, ray]
    (centre,), (axes,) = _ellipses(conic[None])
    near = maximum_filter1d(peaks.astype(np.int8), 3, axis=1) > 0
    deviation = float(np.hypot(LOCATION_ERROR, off.std() * (2 / len(off)) ** 0.5))
    u, v = (seen.origin + centre).tolist()
    return RimOutline((u, v), (float(axes[0]), float(axes[1])), deviation, float(_share(conic[None], seen, near)[0]))
