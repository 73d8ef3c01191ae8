"""Detection of the rim in a rest image without prior knowledge: the ellipse with the strongest edges along it."""

from typing import NamedTuple

import numpy as np
from scipy.ndimage import gaussian_filter, map_coordinates, maximum_filter1d

from ..errors import MembraneError
from ..files.levels import too_few_bits

RAYS = 180
SMOOTH = 1.5  # px, standard deviation of the Gaussian filter before edge detection
FAINT = 0.01  # smallest gradient of an edge, grey per px
FAINTER = 0.1  # smallest gradient of an edge, over the median of the rays' strongest
STRONGEST = 3  # edges of each ray from which trials are drawn
TRIALS = 4000
WIDE = 3.0  # px, largest distance of an edge from the first ellipse
CLOSE = 1.5  # px, largest distance of an edge from the last ellipse
INSIDE = 0.95  # smallest share of the markers that lie within the rim
SMALLEST = 0.15  # shorter half axis, over the image's shorter side
FLATTEST = 0.5  # smallest ratio of the half axes
OFF_CENTRE = 0.25  # largest offset of the rim's centre from the image's centre, over the image's sides
SEEN = 0.6  # smallest share of the outline within the image that shows an edge
IN_IMAGE = 0.5  # smallest share of the outline that lies within the image
LOCATION_ERROR = 0.3  # px, shift of the whole edge by light and blur (docs/own_sensor.md)
ROUNDS = 6


class RimOutline(NamedTuple):
    """The ellipse of the rim in an image.

    Attributes:
        centre: centre `(u, v)`, px.
        half_axes: the longer and the shorter half axis, px.
        deviation: standard deviation of centre and half axes, px.
        share: share of the outline within the image that shows an edge.
    """

    centre: tuple[float, float]
    half_axes: tuple[float, float]
    deviation: float
    share: float


class _Steps(NamedTuple):
    """Derivatives of grey along rays from an inner point, `[RAYS, R]`, one column per pixel; NaN beyond the image."""

    origin: np.ndarray
    directions: np.ndarray
    steps: np.ndarray


def find_rim(image: np.ndarray, inside: np.ndarray | None = None) -> RimOutline:
    """Find the ellipse around the membrane along which the grey changes consistently, from light to dark or dark to light.

    Edges are found on rays from the centre. Ellipses through five random edges, and circles through three, are ranked by the
    share of their length that shows an edge (RANSAC); the best is refined by least squares.

    Args:
        image: grey image of the membrane at rest, `[H, W]`, in 0..1.
        inside: pixels of markers, `[D, 2]`; edges among them are ignored, and the rim encloses them.

    Returns:
        The outline.

    Raises:
        MembraneError: no outline shows an edge over `SEEN` of its length, with `IN_IMAGE` of it in the image.

    Limitations:
        A ring that holds the membrane has an inner and an outer edge; the one with more contrast is found. Check the result
        with `torchmembrane check --out`.

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
    """Return the distance of the farthest marker `[D, 2]` within a twentieth of a turn of each direction `[N, 2]`, `[N]`."""
    reach, along = np.linalg.norm(points, axis=1), points @ directions.T
    near = along > np.cos(np.pi / 10) * reach[:, None]
    return np.where(near, reach[:, None], 0.0).max(0)


def _best(seen: _Steps, sense: int, shape: tuple[int, ...], inside: np.ndarray | None) -> RimOutline | None:
    """Return the best outline with edges of one sign (+1: lighter outside); None if there are too few edges."""
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
    """Return conics `[N, 5]` through random edges, `TRIALS` ellipses and as many circles."""
    strength = steps[ray, radius]
    order = np.lexsort((-strength, ray))
    rank = np.empty(len(ray), int)
    rank[order] = np.arange(len(ray)) - np.searchsorted(ray[order], ray[order])
    pool, rng = points[rank < STRONGEST], np.random.default_rng(0)
    ellipses = _through(pool[rng.integers(len(pool), size=(TRIALS, 5))], slice(None))
    circles = _through(pool[rng.integers(len(pool), size=(TRIALS, 3))], slice(3))
    return np.concatenate([ellipses, circles])


def _through(points: np.ndarray, terms: slice) -> np.ndarray:
    """Return conics `[N, 5]` through points `[N, k, 2]` relative to the origin, using the first `terms` of `_monomials`."""
    matrix = _monomials(points)[..., terms]
    solved = np.zeros((len(points), 5))
    regular = abs(np.linalg.det(matrix / abs(matrix).mean((0, 1)))) > 1e-9
    solved[regular, terms] = np.linalg.solve(matrix[regular], np.ones((regular.sum(), matrix.shape[1], 1)))[..., 0]
    return solved


def _monomials(points: np.ndarray) -> np.ndarray:
    """Return the monomials `[..., 5]` of a conic `a (x^2 + y^2) + b x + c y + d (x^2 - y^2) + e x y = 1`."""
    x, y = points[..., 0], points[..., 1]
    return np.stack([x * x + y * y, x, y, x * x - y * y, x * y], -1)


def _fitted(points: np.ndarray) -> np.ndarray:
    """Fit a conic `[5]` to points `[N, 2]` by least squares."""
    rows = _monomials(points)
    size = abs(rows).mean(0)
    return np.linalg.lstsq(rows / size, np.ones(len(rows)), rcond=None)[0] / size


def _reach(conics: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """Return the distance from the origin at which each conic `[N, 5]` crosses each direction `[R, 2]`, `[N, R]`, px."""
    terms = _monomials(directions)
    square, linear = conics[:, [0, 3, 4]] @ terms[:, [0, 3, 4]].T, conics[:, 1:3] @ directions.T
    with np.errstate(invalid="ignore", divide="ignore"):
        return (-linear + np.sqrt(linear**2 + 4 * square)) / (2 * square)


def _ellipses(conics: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return centres `[N, 2]` and half axes `[N, 2]`, the longer one first, px; NaN if a conic is not an ellipse."""
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
    """Return whether each conic is an ellipse that may be the rim, `[N]` bool."""
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
    """Return the mean of `edges [RAYS, R]` (values from 0 to 1) along each conic within the image, `[N]`."""
    radius = np.rint(np.nan_to_num(_reach(conics, seen.directions)).clip(0, seen.steps.shape[1] - 1)).astype(int)
    rays = np.arange(RAYS)
    within = np.isfinite(seen.steps[rays, radius])
    return (edges[rays, radius] * within).sum(1) / within.sum(1).clip(1)


def _outline(conic: np.ndarray, seen: _Steps, steps: np.ndarray, peaks: np.ndarray) -> RimOutline:
    """Refine a conic with subpixel positions of the edges, and return it as an outline."""
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
