"""The rest surface as a structured grid: triangles, rim, areas, normals, enclosed volume and its gradient.

Vertex `k = i n + j` of an `m x n` grid; quadrilateral `(i, j)` has the corners `a = (i, j)`, `b = (i+1, j)`, `c = (i+1, j+1)`,
`d = (i, j+1)` and is split along `a c` everywhere (alternating diagonals bias the pressure). Gathering corners and summing
back to vertices are slices and pads: no index arithmetic, hence cheap to export.
"""

from typing import NamedTuple

import numpy as np
import torch
import torch.nn.functional as F
from scipy.interpolate import CubicSpline, RectBivariateSpline
from scipy.spatial import cKDTree
from torch import Tensor, nn

from ..errors import MembraneError
from .stencil import apply_stencil, stencil_kernels

FINE = 40  # samples a line interval, for arc lengths
TRIANGLE_CORNERS = ((0, 1, 2), (0, 2, 3))


def corners(field: Tensor, grid: tuple[int, int]) -> Tensor:
    """Values at the corners a, b, c, d of every quadrilateral: `[..., V, C]` to `[..., m-1, n-1, 4, C]`."""
    g = field.reshape(*field.shape[:-2], *grid, field.shape[-1])
    return torch.stack(
        [g[..., :-1, :-1, :], g[..., 1:, :-1, :], g[..., 1:, 1:, :], g[..., :-1, 1:, :]],
        dim=-2,
    )


def corners_to_vertices(values: Tensor, grid: tuple[int, int]) -> Tensor:
    """Sum of corner values at every vertex, the adjoint of `corners`: `[..., m-1, n-1, 4, C]` to `[..., V, C]`."""
    a, b, c, d = values.unbind(-2)
    total = F.pad(a, (0, 0, 0, 1, 0, 1)) + F.pad(b, (0, 0, 0, 1, 1, 0)) + F.pad(c, (0, 0, 1, 0, 1, 0))
    total = total + F.pad(d, (0, 0, 1, 0, 0, 1))
    return total.reshape(*total.shape[:-3], grid[0] * grid[1], total.shape[-1])


def triangles_of(values: Tensor) -> Tensor:
    """Corner values of both triangles of every quadrilateral: `[..., 4, C]` to `[..., 2, 3, C]`."""
    return torch.stack([values[..., 0:3, :], torch.stack([values[..., i, :] for i in (0, 2, 3)], -2)], -3)


def triangles_to_corners(values: Tensor) -> Tensor:
    """Adjoint of `triangles_of`: `[..., 2, 3, C]` to `[..., 4, C]`."""
    first, second = values.unbind(-3)
    a, d = first[..., 0, :] + second[..., 0, :], second[..., 2, :]
    return torch.stack([a, first[..., 1, :], first[..., 2, :] + second[..., 1, :], d], -2)


class SurfacePoints(NamedTuple):
    """Material points of the surface: `vertices [D, 3]` (indices of a triangle), `weights [D, 3]`, `distance [D]` to it."""

    vertices: np.ndarray
    weights: np.ndarray
    distance: np.ndarray


class Membrane(nn.Module):
    """A rest surface with a fixed rim, on an `m x n` grid in the camera's frame.

    Arguments: `vertices [m, n, 3]` (length unit), `fixed [m, n]` bool (default: the grid's border; the border is fixed always).
    Either winding is accepted; triangles are oriented outwards, away from the camera.
    Raises `MembraneError` where the grid folds, degenerates, has a free border or cannot be seen from the camera.

    Buffers: `rest [V, 3]`, `triangles [T, 3]`, `fixed [V]`, `rest_area [V]` (lumped), `rest_normals [V, 3]`, `rest_volume []`.
    """

    def __init__(self, vertices, fixed=None):
        super().__init__()
        X, fixed = _checked_grid(vertices, fixed)
        m, n = X.shape[:2]
        self.grid = (m, n)
        index = torch.arange(m * n).reshape(m * n, 1)
        triangles = triangles_of(corners(index, self.grid)).reshape(-1, 3)
        rest = torch.from_numpy(X.reshape(-1, 3).copy())
        self.outward = _orientation(rest.numpy(), triangles.numpy(), fixed.ravel())
        if self.outward < 0:
            triangles = triangles[:, [0, 2, 1]]
        self.register_buffer("rest", rest)
        p = stencil_kernels()[1:]
        around = torch.stack([self.outward / 6 * (p[2] - p[0]), self.outward / 6 * (p[4] - p[0]), p[3] - p[1], p[5] - p[3]])
        self.register_buffer("around", around)
        self.register_buffer("beyond", apply_stencil(torch.ones(m * n, 1).double(), around, self.grid).flatten())
        self.register_buffer("turns", torch.tensor([1, 2, 0, 2, 0, 1]))
        self.register_buffer("volume_third_derivatives", self.outward / 6 * _determinant_derivatives())
        self.register_buffer("volume_cross_products", self.outward / 6 * _cross_products())
        self.register_buffer("triangles", triangles)
        self.register_buffer("fixed", torch.from_numpy(fixed.ravel().copy()))
        self.register_buffer("free", torch.nonzero(~self.fixed).ravel())
        self.register_buffer("rest_area", self.vertex_area(rest))
        self.register_buffer("rest_normals", self.normals(rest))
        self.register_buffer("rest_volume", self.volume(rest))

    def area_vectors(self, x: Tensor) -> Tensor:
        """Outward area vectors of all triangles, `[..., V, 3]` to `[..., m-1, n-1, 2, 3]`."""
        p = triangles_of(corners(x, self.grid))
        edge_1, edge_2 = p[..., 1, :] - p[..., 0, :], p[..., 2, :] - p[..., 0, :]
        return (0.5 * self.outward) * torch.linalg.cross(edge_1, edge_2)

    def _thirds_to_vertices(self, per_triangle: Tensor) -> Tensor:
        thirds = (per_triangle / 3).unsqueeze(-2).expand(*per_triangle.shape[:-1], 3, per_triangle.shape[-1])
        return corners_to_vertices(triangles_to_corners(thirds), self.grid)

    def vertex_area(self, x: Tensor) -> Tensor:
        """Lumped area of every vertex, `[..., V]`: a third of the triangles around it."""
        area = torch.linalg.vector_norm(self.area_vectors(x), dim=-1, keepdim=True)
        return self._thirds_to_vertices(area).squeeze(-1)

    def normals(self, x: Tensor) -> Tensor:
        """Unit outward normals at the vertices, `[..., V, 3]`: of the summed area vectors, as the volume gradient's."""
        beyond = self.beyond * torch.cat([x.transpose(-2, -1)] * 4, -1)  # neighbours beyond the border are the vertex itself
        return F.normalize(self._turns(apply_stencil(x, self.around, self.grid) - beyond), dim=-1)

    def volume(self, x: Tensor) -> Tensor:
        """Volume between the surface and the camera centre, `[...]` (eq. 19): `1/6 sum det [x_a, x_b, x_c]`, of the two
        triangles of a quadrilateral `det [a, b - d, c]`.

        Positive for outward triangles: vertices run clockwise seen from the origin (the paper says counterclockwise).
        With a fixed rim the apex adds a constant.
        """
        g = x.transpose(-2, -1).unflatten(-1, self.grid)
        a, b, c, d = g[..., :-1, :-1], g[..., 1:, :-1], g[..., 1:, 1:], g[..., :-1, 1:]
        return self.outward / 6 * (torch.linalg.cross(a, b - d, dim=-3) * c).sum((-1, -2, -3))

    def volume_gradient(self, x: Tensor) -> Tensor:
        """Derivative of `volume` in the vertices, `[..., V, 3]`; the transposed cofactors of eq. 20.

        The six neighbours `p` in turn give `sum p_i x p_i+1 = (p_2 - p_0) x (p_3 - p_1) + (p_4 - p_0) x (p_5 - p_3)`.
        """
        return self._turns(apply_stencil(x, self.around, self.grid))

    def _turns(self, p: Tensor) -> Tensor:
        """A sixth of `sum p_i x p_i+1` at every vertex, outwards; `p [..., 3, 4 V]` as `around` has them."""
        (u1, u2), (v1, v2) = (a.chunk(2, -2) for a in p.index_select(-2, self.turns).chunk(2, -1))
        return sum((u1 * v2 - u2 * v1).chunk(2, -1)).mT

    def volume_hessian_blocks(self, x: Tensor) -> Tensor:
        """Second derivatives of every triangle's share of the volume, `[..., V, 3]` to `[..., m-1, n-1, 2, 9, 9]`."""
        return (triangles_of(corners(x, self.grid)).flatten(-2) @ self.volume_third_derivatives).unflatten(-1, (9, 9))

    def volume_one_ring(self, edges: Tensor) -> tuple[Tensor, Tensor]:
        """Derivative of `volume` in the inner vertices, `[..., 3, N]`, and the second ones in them and their six neighbours,
        `[..., 3, 3, 6, N]`; those in one vertex alone are zero. `edges [..., 3, 2, 6 N]`, from `one_ring_edges`."""
        first, second = edges.unbind(-2)
        gradient = torch.linalg.cross(first, second, dim=-2).unflatten(-1, (6, -1)).sum(-2)
        before = first.unflatten(-1, (6, -1)).roll(1, -2).flatten(-2)
        turned = (self.volume_cross_products @ (before - second)).unflatten(-2, (3, 3))
        return self.outward / 6 * gradient, turned.unflatten(-1, (6, -1))

    @property
    def cavity_volume(self) -> float:
        """Volume between the rest surface and a fan from the rim's centroid over its rim, in length unit cubed."""
        m, n = self.grid
        index = np.arange(m * n).reshape(m, n)
        loop = np.concatenate([index[:-1, 0], index[-1, :-1], index[:0:-1, -1], index[0, :0:-1]])
        rim = self.rest.cpu().double().numpy()[loop]
        fan = np.cross(rim, np.roll(rim, -1, 0)) @ rim.mean(0)
        return float(self.rest_volume) - abs(float(fan.sum())) / 6

    @property
    def size(self) -> float:
        """Square root of the rest area: the length against which distances on this surface are small or large."""
        return float(self.rest_area.sum()) ** 0.5

    def resampled(self, grid: tuple[int, int]) -> "Membrane":
        """The same rest surface on another grid whose lines are equally spaced along the surface.

        Bicubic in the grid's own coordinates, so that the rim stays where it is; the new lines are at equal steps of the mean
        arc length: steep sides, where a file's grid is often coarse, get their share.
        """
        if min(grid) < 5:
            raise MembraneError(f"Membrane.resampled: grid {grid[0]} x {grid[1]}; expected at least 5 x 5 vertices")
        X = self.rest.cpu().double().numpy().reshape(*self.grid, 3)
        rows, columns = _even_lines(X, grid[0]), _even_lines(X.swapaxes(0, 1), grid[1])
        along = [np.arange(count) for count in self.grid]
        vertices = np.stack([RectBivariateSpline(*along, X[..., c])(rows, columns) for c in range(3)], -1)
        nearest = [
            np.rint(lines[1:-1]).clip(1, count - 2).astype(int) for lines, count in zip((rows, columns), self.grid, strict=True)
        ]
        fixed = np.ones(grid, bool)
        fixed[1:-1, 1:-1] = self.fixed.cpu().numpy().reshape(self.grid)[nearest[0]][:, nearest[1]]
        return Membrane(vertices, fixed)

    def closest_points(self, points) -> SurfacePoints:
        """The material points of the rest surface closest to `points [D, 3]`, with their distances."""
        P = np.asarray(points, dtype=float)
        T = self.triangles.cpu().numpy()
        X = self.rest.cpu().double().numpy()[T]
        near = cKDTree(X.mean(1)).query(P, k=min(24, len(T)))[1]
        weights, distance = _closest_on_triangles(P[:, None], X[near])
        best = distance.argmin(1)
        row = np.arange(len(P))
        return SurfacePoints(T[near[row, best]], weights[row, best], distance[row, best])

    def ray_points(self, origins, directions) -> SurfacePoints:
        """Where rays `[D, 3]` first meet the rest surface; `distance` is the range along the ray, NaN where it misses."""
        T = self.triangles.cpu().numpy()
        triangles = self.rest.cpu().double().numpy()[T]
        rays = (np.asarray(a, dtype=float)[:, None] for a in (origins, directions))
        chunks = [
            _first_hits(o, d, triangles) for o, d in zip(*(np.split(a, range(128, len(a), 128)) for a in rays), strict=True)
        ]
        first, weights, distance = (np.concatenate(part) for part in zip(*chunks, strict=True))
        return SurfacePoints(T[first], weights, distance)


def _checked_grid(vertices, fixed):
    X = np.asarray(vertices, dtype=np.float64)
    if X.ndim != 3 or X.shape[2] != 3 or min(X.shape[:2]) < 3:
        raise MembraneError(f"Membrane: vertices of shape {list(X.shape)}; expected [m, n, 3] with m, n >= 3")
    if not np.isfinite(X).all():
        i, j = np.argwhere(~np.isfinite(X).all(-1))[0]
        raise MembraneError(f"Membrane: vertex ({i}, {j}) is not finite; expected finite coordinates")
    border = np.zeros(X.shape[:2], bool)
    border[[0, -1]] = border[:, [0, -1]] = True
    if fixed is None:
        return X, border
    fixed = np.asarray(fixed)
    if fixed.shape != border.shape or fixed.dtype != bool:
        raise MembraneError(
            f"Membrane: fixed is {fixed.dtype} {list(fixed.shape)}; expected bool {list(border.shape)}, one per vertex"
        )
    if not fixed[border].all():
        i, j = np.argwhere(border & ~fixed)[0]
        raise MembraneError(f"Membrane: border vertex ({i}, {j}) is free; expected every border vertex to be fixed (the rim)")
    if fixed.all():
        raise MembraneError("Membrane: every vertex is fixed; expected free vertices inside the rim")
    return X, fixed


def _orientation(X, triangles, fixed):
    """+1 if the triangles already point away from the camera, -1 if all have to be turned; refuses folded or hidden grids."""
    if X[:, 2].max() <= 0:
        raise MembraneError(
            f"Membrane: the grid lies behind the camera (largest z = {X[:, 2].max():.4g}); expected it at z > 0, "
            "in the camera's frame with +z towards the membrane"
        )
    a, b, c = X[triangles].transpose(1, 0, 2)
    normal = np.cross(b - a, c - a)
    moving = ~fixed[triangles].all(1)
    area = np.linalg.norm(normal, axis=1)
    if (area[moving] < 1e-9 * area.max()).any():
        k = np.flatnonzero(moving & (area < 1e-9 * area.max()))[0]
        raise MembraneError(
            f"Membrane: the triangle of vertices {triangles[k].tolist()} has no area; expected distinct vertices"
        )
    facing = np.sign((normal * (a + b + c)).sum(1))[moving]
    outward = 1 if facing.sum() >= 0 else -1
    hidden = facing != outward
    if hidden.any():
        k = np.flatnonzero(moving)[np.flatnonzero(hidden)[0]]
        raise MembraneError(
            f"Membrane: {hidden.sum()} of {moving.sum()} triangles turn their outside to the camera, the first one at vertices "
            f"{triangles[k].tolist()}; expected a grid without folds whose inside is seen from the camera everywhere"
        )
    return outward


def _levi_civita() -> Tensor:
    e = torch.zeros(3, 3, 3, dtype=torch.float64)
    e[[0, 1, 2], [1, 2, 0], [2, 0, 1]], e[[0, 1, 2], [2, 0, 1], [1, 2, 0]] = 1.0, -1.0
    return e


def _cross_products() -> Tensor:
    """`[9, 3]`: from `u` to the entries of the matrix of `u x`."""
    return _levi_civita().transpose(1, 2).reshape(9, 3)


def _determinant_derivatives() -> Tensor:
    """Third derivatives `[9, 81]` of `det [a, b, c]` in its nine entries."""
    levi_civita = _levi_civita()
    return torch.einsum("uvw,ijk->uivjwk", levi_civita, levi_civita).reshape(9, 81)


def _even_lines(X, count):
    """Coordinates along the first axis of `X [m, n, 3]` of `count` lines at equal rms distance from line to line."""
    fine = np.linspace(0, len(X) - 1, FINE * (len(X) - 1) + 1)
    step = np.diff(CubicSpline(np.arange(len(X)), X)(fine), axis=0)
    length = np.concatenate([[0.0], np.cumsum(((step**2).sum(-1).mean(1)) ** 0.5)])
    return np.interp(np.linspace(0, length[-1], count), length, fine)


def _first_hits(start, d, triangles):
    """First triangle met by every ray `[D, 1, 3]`, barycentric weights there, and the range (NaN: none). Moller-Trumbore."""
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


def _closest_on_triangles(p, triangles):
    """Barycentric weights and distance of the closest point of each triangle `[..., 3, 3]` to `p [..., 3]`."""
    a, b, c = triangles[..., 0, :], triangles[..., 1, :], triangles[..., 2, :]
    ab, ac, ap = b - a, c - a, p - a
    dot = lambda x, y: (x * y).sum(-1)  # noqa: E731
    g11, g12, g22, f1, f2 = dot(ab, ab), dot(ab, ac), dot(ac, ac), dot(ap, ab), dot(ap, ac)
    det = np.maximum(g11 * g22 - g12**2, 1e-300)
    v, w = (g22 * f1 - g12 * f2) / det, (g11 * f2 - g12 * f1) / det
    inside = np.stack([1 - v - w, v, w], -1)
    candidates = [np.where((inside >= 0).all(-1)[..., None], inside, np.nan)]
    for s, e in ((0, 1), (1, 2), (2, 0)):
        start, edge = triangles[..., s, :], triangles[..., e, :] - triangles[..., s, :]
        u = np.clip(dot(p - start, edge) / np.maximum(dot(edge, edge), 1e-300), 0, 1)
        weights = np.zeros(inside.shape)
        weights[..., s], weights[..., e] = 1 - u, u
        candidates.append(weights)
    weights = np.stack(candidates, -2)
    distance = np.linalg.norm(weights @ triangles - p[..., None, :], axis=-1)
    distance = np.where(np.isnan(distance), np.inf, distance)
    best = distance.argmin(-1)[..., None]
    return np.take_along_axis(weights, best[..., None], -2)[..., 0, :], np.take_along_axis(distance, best, -1)[..., 0]
