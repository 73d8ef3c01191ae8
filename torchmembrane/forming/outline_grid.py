"""A structured grid within a closed rim, without folds: corners where the rim turns, cells as uniform as possible.

Border vertices slide along the rim and inner vertices move freely to minimise the distortion of all triangles. With `J` the
map from a right-angled triangle with the mean side lengths to a triangle of the grid, the measure is

    sum [ |J|^2 / (2 det J)  +  SIZE (det J / mean + mean / det J) / 2 ] ^ POWER

The first term is 1 if the triangle has that shape; the second is smallest if its area equals the mean. Both are unbounded as a
triangle folds. Triangles whose corners all lie on the rim are left out. Within a concave rim the initial grid may have folds;
`det J` is then first replaced by smooth positive functions that approach it.
"""

from functools import lru_cache, partial
from itertools import combinations
from typing import Any, NamedTuple

import numpy as np
import torch
from scipy.sparse import coo_array
from scipy.sparse.linalg import spsolve
from torch import Tensor

from ..errors import MembraneError
from ..surface.topology import grid_triangles, rim_loop

PLACES = 40  # number of candidates for the grid's corners along the rim
SHIFTS, WINDOW = 4, 1.5  # iterations that move the candidates; half width of the window around each, over their spacing
POWER = 2  # of the distortion, so that the worst triangles have more weight
SIZE = 0.3
STEPS = (60, 60, 400)
"""Steps of the minimisation: two rounds that remove folds, and the final round."""
BLUNT = (0.5, 0.05)  # width of the smoothing of det J over its mean, in the rounds that remove folds


class OutlineGrid(NamedTuple):
    """A grid within a rim.

    Attributes:
        places: positions of border vertices along the rim, 0 to 1 from its first point, `[m, n]`; NaN inside.
        vertices: vertices in the rim's plane, `[m, n, 2]`.
        angle: smallest angle of all triangles that are not wholly on the rim, degrees; 45 is optimal.
        worst: centroid of the triangle with that angle, `[2]`.
    """

    places: np.ndarray
    vertices: np.ndarray
    angle: float
    worst: np.ndarray


def outline_grid(points: np.ndarray, lines: int) -> OutlineGrid:
    """Return a grid of `lines` x `lines` vertices within a rim.

    Args:
        points: points of the rim, `[K, 2]`, counterclockwise.
        lines: number of vertices per side, odd.

    Returns:
        The `OutlineGrid`.

    Raises:
        MembraneError: no grid without folds was found.

    Example:
        >>> from torchmembrane.forming.outline import ellipse
        >>> outline_grid(ellipse((2.0, 2.0)), 9).angle > 20
        True
    """
    points = np.ascontiguousarray(points)
    return _outline_grid(points.tobytes(), len(points), lines)


@lru_cache(maxsize=32)
@torch.inference_mode(False)  # gradients are needed whatever the caller's mode
@torch.enable_grad()
def _outline_grid(content: bytes, count: int, lines: int) -> OutlineGrid:
    from scipy.optimize import minimize  # takes long to load, and only these sensors need it

    problem = _GridProblem(np.frombuffer(content).reshape(count, 2), lines)
    z = problem.start()
    blunt = [*BLUNT, 0.0] if problem.smallest(z) <= 0 else [0.0]
    for width, steps in zip(blunt, STEPS[-len(blunt) :], strict=True):
        if width == 0 and problem.smallest(z) <= 0:
            break
        options: Any = {"maxiter": steps, "maxcor": 30}
        z = minimize(partial(problem.value, width=width), z, jac=True, method="L-BFGS-B", options=options).x
    return problem.grid(z)


class _GridProblem:
    """The distortion measure and its gradient.

    The unknowns are logarithms of the border's steps, and the inner vertices over the rim's length.
    """

    def __init__(self, points: np.ndarray, lines: int) -> None:
        self.lines, self.border = lines, rim_loop((lines, lines))
        inside = np.ones(lines * lines, bool)
        inside[self.border] = False
        self.inner = np.flatnonzero(inside)
        closed = np.concatenate([points, points[:1]])
        at = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(closed, axis=0), axis=1))])
        self.length, self.rim, self.at = at[-1], torch.from_numpy(closed), torch.from_numpy(at / at[-1])
        index = np.arange(lines * lines).reshape(lines, lines)
        a, b, c, d = (x.ravel() for x in (index[:-1, :-1], index[1:, :-1], index[1:, 1:], index[:-1, 1:]))
        ends = np.stack([(a, b, a, d), (a, b, b, c), (d, c, b, c), (d, c, a, d)], -1).reshape(4, -1)  # ends of edges along u, v
        free = inside[ends].any(0)
        self.ends = torch.from_numpy(ends[:, free])
        places = _corner_places(points)
        self.corners_at = torch.from_numpy(np.append(places, places[0] + 1))
        sides = self.corners_at.diff().tolist()
        self.aspect = (sides[0] + sides[2]) / (sides[1] + sides[3])  # length along u over length along v

    def start(self) -> np.ndarray:
        """Return equal steps on each side, and inner vertices at the mean of their neighbours."""
        steps = np.zeros(len(self.border))
        x = np.zeros((self.lines**2, 2))
        x[self.border] = self._on_rim(self._along(torch.from_numpy(steps))).numpy()
        m = self.lines
        i, j = np.divmod(self.inner, m)
        around = np.stack([(i + di) * m + j + dj for di, dj in ((1, 0), (-1, 0), (0, 1), (0, -1))], 1)
        number = np.full(m * m, -1)
        number[self.inner] = np.arange(len(self.inner))
        rows, columns = np.repeat(np.arange(len(self.inner)), 4), number[around].ravel()
        known = columns < 0
        load = np.zeros((len(self.inner), 2))
        np.add.at(load, rows[known], x[around.ravel()[known]])
        one = np.arange(len(self.inner))
        entries = np.concatenate([np.full(len(one), 4.0), -np.ones((~known).sum())])
        at = np.concatenate([one, rows[~known]]), np.concatenate([one, columns[~known]])
        inner = spsolve(coo_array((entries, at)).tocsc(), load)
        return np.concatenate([steps, (inner / self.length).ravel()])

    def _along(self, steps: Tensor) -> Tensor:
        """Return the positions of border vertices along the rim, `[4 (lines - 1)]`, from logarithms of their relative steps."""
        share = torch.softmax(steps.reshape(4, -1), 1)
        first, length = self.corners_at[:-1, None], self.corners_at.diff()[:, None]
        return (first + length * (torch.cumsum(share, 1) - share)).flatten()

    def _on_rim(self, places: Tensor) -> Tensor:
        wrapped = places - torch.floor(places.detach())
        k = (torch.searchsorted(self.at, wrapped.detach().contiguous(), right=True) - 1).clamp(0, len(self.at) - 2)
        share = (wrapped - self.at[k]) / (self.at[k + 1] - self.at[k])
        return self.rim[k] + share[:, None] * (self.rim[k + 1] - self.rim[k])

    def vertices(self, z: Tensor) -> Tensor:
        """Return the vertices of the grid for the unknowns `z`, `[V, 2]`."""
        count = len(self.border)
        x = z.new_zeros(self.lines**2, 2)
        x = x.index_put((torch.from_numpy(self.border),), self._on_rim(self._along(z[:count])))
        return x.index_put((torch.from_numpy(self.inner),), self.length * z[count:].reshape(-1, 2))

    def _edges(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """Return the edges along u (divided by the aspect) and v of every triangle, `[T, 2]` each."""
        p, q, r, s = x[self.ends]
        return (q - p) / self.aspect, s - r

    def smallest(self, z: np.ndarray) -> float:
        """Return the smallest `det J`."""
        with torch.no_grad():
            return float(_determinant(*self._edges(self.vertices(torch.from_numpy(z)))).min())

    def value(self, z: np.ndarray, width: float) -> tuple[float, np.ndarray]:
        unknown = torch.from_numpy(z).requires_grad_()
        u, v = self._edges(self.vertices(unknown))
        det = _determinant(u, v)
        mean = det.mean().detach().clamp_min(1e-12)
        if width:
            det = (det + (det**2 + (width * mean) ** 2).sqrt()) / 2
        elif float(det.detach().min()) <= 0:
            return np.inf, np.zeros_like(z)
        distortion = (u.square().sum(1) + v.square().sum(1)) / (2 * det) + SIZE / 2 * (det / mean + mean / det)
        total = (distortion**POWER).mean()
        (gradient,) = torch.autograd.grad(total, unknown)
        return float(total.detach()), gradient.numpy()

    def grid(self, z: np.ndarray) -> OutlineGrid:
        if self.smallest(z) <= 0:
            raise MembraneError(
                "outline: no grid without folds was found within this rim; expected a simpler one: without narrow necks, bays "
                "deeper than they are wide, or loops"
            )
        with torch.no_grad():
            x = self.vertices(torch.from_numpy(z))
        m = self.lines
        split = grid_triangles((m, m))
        split = split[np.isin(split, self.inner).any(1)]
        p, q, r = x[split].unbind(1)
        angles = torch.stack([_angle(q - p, r - p), _angle(r - q, p - q), _angle(p - r, q - r)]).amin(0)
        worst = x[split[int(angles.argmin())]].mean(0)
        places = np.full(self.lines**2, np.nan)
        count = len(self.border)
        places[self.border] = self._along(torch.from_numpy(z[:count])).numpy()
        return OutlineGrid(places.reshape(m, m), x.reshape(m, m, 2).numpy(), float(angles.min()), worst.numpy())


def _determinant(u: Tensor, v: Tensor) -> Tensor:
    return u[:, 0] * v[:, 1] - u[:, 1] * v[:, 0]


def _angle(a: Tensor, b: Tensor) -> Tensor:
    return torch.rad2deg(torch.atan2(_determinant(a, b).abs(), (a * b).sum(1)))


def _corner_places(points: np.ndarray) -> np.ndarray:
    """Choose the grid's four corners along the rim, increasing: where the rim turns by right angles, between straight sides.

    Candidates are `PLACES` evenly spaced positions, each moved to the centre of the curvature around it. The chosen corners
    minimise the sum of squares of three terms: deviations of the corners' turns from a right angle, total turning of each side,
    and logarithms of the length ratios of opposite sides.
    """
    edges = np.roll(points, -1, 0) - points
    at = np.concatenate([[0.0], np.cumsum(np.linalg.norm(edges, axis=1))])
    at /= at[-1]
    direction = np.arctan2(edges[:, 1], edges[:, 0])
    turns = (np.roll(direction, -1) - direction + np.pi) % (2 * np.pi) - np.pi  # at the end of each edge
    bends = np.abs(turns)

    def away(places: np.ndarray) -> np.ndarray:
        found: np.ndarray = (at[1:][None] - places[:, None] + 0.5) % 1 - 0.5
        return found.round(9)  # so that ties do not depend on the unit of length

    places = (np.arange(PLACES) + 0.5) / PLACES
    for _ in range(SHIFTS):
        weight = (np.abs(away(places)) <= WINDOW / PLACES) * bends
        places = places + (weight * away(places)).sum(1) / weight.sum(1).clip(1e-9)
    places = np.unique((places % 1).round(9))
    near = np.abs(away(places)) <= WINDOW / PLACES
    turn, bent, twice = near @ turns, near @ bends, np.concatenate([places, places + 1])
    total = np.interp(twice, np.concatenate([at, at[1:] + 1]), np.concatenate([[0.0], np.cumsum(np.tile(bends, 2))]))
    sets = np.array(list(combinations(range(len(places)), 4)))
    following = np.roll(sets, -1, 1) + len(places) * (np.arange(4) == 3)
    sides = twice[following] - twice[sets]
    sets, following, sides = (a[sides.min(1) > WINDOW / PLACES] for a in (sets, following, sides))
    lacking = ((turn[sets] - np.pi / 2) ** 2).sum(1)
    between = total[following] - total[sets] - (bent[sets] + bent[np.roll(sets, -1, 1)]) / 2
    uneven = (np.log(sides[:, :2] / sides[:, 2:]) ** 2).sum(1)
    chosen = sets[int(np.round(lacking + (between**2).sum(1) + uneven, 6).argmin())]  # the first of equal minima
    corners = places[chosen]
    if int(turn[chosen].round(6).argmin()) in (1, 3):  # the diagonals split corners 0 and 2: the flattest is one of them
        corners = np.concatenate([corners[1:], corners[:1] + 1])
    return corners
