"""The rest surface as a structured grid: triangles, rim, areas, normals, enclosed volume and its gradient.

`topology` defines the triangles. Sums around a vertex are convolutions on the grid, see `solve.stencil`.
"""

import copy

import numpy as np
import torch
from numpy.typing import ArrayLike
from torch import Tensor, nn

from ..errors import MembraneError, check_arguments
from ..pose import ViewPose
from ..solve.stencil import apply_stencil, stencil_kernels
from ..torch_modes import on_cpu
from . import projection
from .checks import checked_grid, checked_orientation
from .projection import SurfacePoints
from .resampling import resampled_grid
from .topology import corners, corners_to_vertices, rim_loop, triangles_of, triangles_to_corners


@on_cpu
class Membrane(nn.Module):
    """A rest surface with a fixed rim, given as an `m x n` grid of vertices in the camera's frame.

    Either winding is accepted; triangles are oriented outwards, away from the camera. Vertex `(i, j)` has the index `i n + j`;
    there are `V = m n` vertices and `T = 2 (m-1) (n-1)` triangles. The methods take a deformed surface's vertices
    `[..., V, 3]`.

    Args:
        vertices: `[m, n, 3]`, length unit.
        fixed: which vertices do not move, `[m, n]` bool; it must include the grid's border, which is the default.

    Attributes:
        grid: `m, n`.
        outward: +1 if the triangles of the given grid face outwards, otherwise -1.
        rest: vertices `[V, 3]`.
        triangles: vertex indices of the triangles in outward order, `[T, 3]` int.
        fixed: which vertices are fixed, `[V]` bool.
        free_vertices: indices of the vertices that are not fixed.
        rest_area: lumped area of every vertex, `[V]`: a third of the area of the triangles around it.
        rest_normals: unit outward normals, `[V, 3]`.
        size: square root of the rest area, length unit; the length scale of this surface.
        rest_volume: volume between the rest surface and the camera's centre, `[]`.

    Raises:
        MembraneError: the grid folds, degenerates, has a free border or cannot be seen from the camera.

    Limitations:
        Every point must be visible from the camera at the origin: undercuts are not possible.

    Example:
        >>> x, y = np.meshgrid(np.arange(5.0), np.arange(4.0), indexing="ij")
        >>> membrane = Membrane(np.stack([x, y, np.full_like(x, 10.0)], -1))
        >>> membrane.grid, membrane.rest_area.sum().item(), len(membrane.free_vertices)
        ((5, 4), 12.0, 6)
    """

    rest: Tensor
    triangles: Tensor
    fixed: Tensor
    free_vertices: Tensor
    rest_area: Tensor
    rest_normals: Tensor
    rest_volume: Tensor
    size: float
    chord_kernels: Tensor
    chords_beyond_border: Tensor
    xyz_to_yzxzxy: Tensor
    volume_third_derivatives: Tensor
    volume_cross_products: Tensor

    def __init__(self, vertices: ArrayLike, fixed: ArrayLike | None = None) -> None:
        super().__init__()
        X, fixed = checked_grid(vertices, fixed)
        m, n = X.shape[:2]
        self.grid = (m, n)
        triangles = triangles_of(corners(torch.arange(m * n)[:, None], self.grid)).reshape(-1, 3)
        rest = torch.from_numpy(X.reshape(-1, 3).copy())
        self.outward = checked_orientation(rest.numpy(), triangles.numpy(), fixed.ravel())
        if self.outward < 0:
            triangles = triangles[:, [0, 2, 1]]
        self.register_buffer("rest", rest)
        chords = self._chord_kernels()
        self.register_buffer("chord_kernels", chords)
        self.register_buffer("chords_beyond_border", apply_stencil(torch.ones(m * n, 1).double(), chords, self.grid).flatten())
        self.register_buffer("xyz_to_yzxzxy", torch.tensor([1, 2, 0, 2, 0, 1]))
        self.register_buffer("volume_third_derivatives", self.outward / 6 * _determinant_derivatives())
        self.register_buffer("volume_cross_products", self.outward / 6 * _cross_products())
        self.register_buffer("triangles", triangles)
        self.register_buffer("fixed", torch.from_numpy(fixed.ravel().copy()))
        self.register_buffer("free_vertices", torch.nonzero(~self.fixed).ravel())
        self.register_buffer("rest_area", self.vertex_area(rest))
        self.size = float(self.rest_area.sum()) ** 0.5
        self.register_buffer("rest_normals", self.normals(rest))
        self.register_buffer("rest_volume", self.volume(rest))

    def area_vectors(self, x: Tensor) -> Tensor:
        """Return the outward area vectors of all triangles: unit normal times area.

        Args:
            x: vertices `[..., V, 3]`.

        Returns:
            `[..., m-1, n-1, 2, 3]`, length unit squared.

        Example:
            >>> from torchmembrane.surface.shapes import heightfield
            >>> plane = heightfield([0, 1, 2], [0, 1, 2], np.full((3, 3), 5.0))
            >>> plane.area_vectors(plane.rest)[0, 0].tolist()
            [[0.0, 0.0, 0.5], [0.0, 0.0, 0.5]]
        """
        p = triangles_of(corners(x, self.grid))
        edge_1, edge_2 = p[..., 1, :] - p[..., 0, :], p[..., 2, :] - p[..., 0, :]
        vectors: Tensor = (0.5 * self.outward) * torch.linalg.cross(edge_1, edge_2)
        return vectors

    def vertex_area(self, x: Tensor) -> Tensor:
        """Return the lumped area of every vertex: a third of the area of the triangles around it.

        Args:
            x: vertices `[..., V, 3]`.

        Returns:
            `[..., V]`, length unit squared; their sum is the surface's area.

        Example:
            >>> from torchmembrane.surface.shapes import heightfield
            >>> plane = heightfield([0, 1, 2], [0, 1, 2], np.full((3, 3), 5.0))
            >>> round(plane.vertex_area(plane.rest)[4].item(), 9)
            1.0
        """
        area = torch.linalg.vector_norm(self.area_vectors(x), dim=-1, keepdim=True)
        return self.thirds_to_vertices(area).squeeze(-1)

    def normals(self, x: Tensor) -> Tensor:
        """Return unit outward normals at the vertices: the directions of the summed area vectors of the triangles around them.

        Args:
            x: vertices `[..., V, 3]`.

        Returns:
            `[..., V, 3]`.

        Example:
            >>> from torchmembrane.surface.shapes import spherical_cap
            >>> cap = spherical_cap(12.0, 9.0, 15.0)
            >>> cap.normals(cap.rest)[144].abs().round(decimals=6).tolist()
            [0.0, 0.0, 1.0]
        """
        beyond = self.chords_beyond_border * torch.cat([x.transpose(-2, -1)] * 4, -1)  # vertices beyond: the vertex itself
        along = self._crossed_chords(apply_stencil(x, self.chord_kernels, self.grid) - beyond)
        return (along * along.square().sum(-2, keepdim=True).clamp_min(torch.finfo(x.dtype).tiny).rsqrt()).mT

    def volume(self, x: Tensor) -> Tensor:
        """Return the volume between the surface and the camera's centre (eq. 19).

        It is `1/6 sum det [x_a, x_b, x_c]`; the two triangles of a quadrilateral sum to `det [a, b - d, c]`. It is positive for
        outward triangles, whose vertices run clockwise seen from the origin (the paper says counterclockwise). With a fixed
        rim, another apex would change it by a constant.

        Args:
            x: vertices `[..., V, 3]`.

        Returns:
            `[...]`, length unit cubed.

        Example:
            >>> from torchmembrane.surface.shapes import heightfield
            >>> plane = heightfield([0, 1, 2], [0, 1, 2], np.full((3, 3), 6.0))
            >>> round(plane.volume(plane.rest).item(), 9)
            8.0
        """
        g = x.transpose(-2, -1).unflatten(-1, self.grid)
        a, b, c, d = g[..., :-1, :-1], g[..., 1:, :-1], g[..., 1:, 1:], g[..., :-1, 1:]
        sixfold: Tensor = (torch.linalg.cross(a, b - d, dim=-3) * c).sum((-1, -2, -3))
        return self.outward / 6 * sixfold

    def volume_gradient(self, x: Tensor) -> Tensor:
        """Return the gradient of `volume` with respect to the vertices; the transposed cofactors of eq. 20.

        With the six neighbours `p` in cyclic order, `sum p_i x p_i+1 = (p_2 - p_0) x (p_3 - p_1) + (p_4 - p_0) x (p_5 - p_3)`.

        Args:
            x: vertices `[..., V, 3]`.

        Returns:
            `[..., V, 3]`, length unit squared; at inner vertices a third of the sum of the area vectors around the vertex.

        Example:
            >>> from torchmembrane.surface.shapes import heightfield
            >>> plane = heightfield([0, 1, 2], [0, 1, 2], np.full((3, 3), 6.0))
            >>> plane.volume_gradient(plane.rest)[4].round(decimals=9).abs().tolist()
            [0.0, 0.0, 1.0]
        """
        return self._crossed_chords(apply_stencil(x, self.chord_kernels, self.grid)).mT

    def volume_hessian_blocks(self, x: Tensor) -> Tensor:
        """Return the second derivatives of every triangle's share of the volume with respect to its nine vertex coordinates.

        Args:
            x: vertices `[..., V, 3]`.

        Returns:
            `[..., m-1, n-1, 2, 9, 9]`, vertices as in `TRIANGLE_CORNERS`.
        """
        blocks: Tensor = (triangles_of(corners(x, self.grid)).flatten(-2) @ self.volume_third_derivatives).unflatten(-1, (9, 9))
        return blocks

    def volume_one_ring(self, chords: Tensor) -> Tensor:
        """Return the second derivatives of `volume` with respect to an inner vertex and each of its six neighbours.

        The second derivatives with respect to a vertex alone are zero. The gradient is half the sum of the blocks times the
        edges to the neighbours.

        Args:
            chords: vectors from the neighbour after each neighbour to the one before it (`one_ring_edges`), `[..., 3, 6 N]`.

        Returns:
            `[..., 3, 3, 6, N]`.
        """
        blocks: Tensor = (self.volume_cross_products @ chords).unflatten(-2, (3, 3)).unflatten(-1, (6, -1))
        return blocks

    @property
    def cavity_volume(self) -> float:
        """Volume between the rest surface and the fan of triangles from the rim to its centroid, length unit cubed."""
        rim = self.rest.cpu().double().numpy()[rim_loop(self.grid)]
        fan = np.cross(rim, np.roll(rim, -1, 0)) @ rim.mean(0)
        return float(self.rest_volume) - abs(float(fan.sum())) / 6

    @check_arguments
    def resampled(self, grid: tuple[int, int]) -> "Membrane":
        """Return the same rest surface on another grid whose lines are equally spaced along the surface.

        The interpolation is bicubic in the grid's own coordinates, so that the rim stays where it is.

        Args:
            grid: number of vertices in both directions of the new grid, at least 5 each.

        Returns:
            The resampled `Membrane`.

        Raises:
            MembraneError: a grid with fewer than 5 vertices in a direction.

        Example:
            >>> from torchmembrane.surface.shapes import spherical_cap
            >>> spherical_cap(12.0, 9.0, 15.0, (9, 9)).resampled((17, 13)).grid
            (17, 13)
        """
        if min(grid) < 5:
            raise MembraneError(f"Membrane.resampled: grid {grid[0]} x {grid[1]}; expected at least 5 x 5 vertices")
        X = self.rest.cpu().double().numpy().reshape(*self.grid, 3)
        return Membrane(*resampled_grid(X, self.fixed.cpu().numpy().reshape(self.grid), grid))

    def in_frame(self, pose: ViewPose, outside: bool = False) -> "Membrane":
        """Return the same rest surface, with vertices in the same order, in the frame of a view that may see only a part of it.

        Args:
            pose: pose of this frame in the other frame; it may contain a reflection.
            outside: whether the other view sees the outer side of the surface; the normals then point to the inner side.

        Example:
            >>> from torchmembrane.surface.shapes import spherical_cap
            >>> mirrored = spherical_cap(12.0, 9.0, 15.0).in_frame(ViewPose(np.diag([-1.0, 1.0, 1.0]), np.zeros(3)))
            >>> bool((mirrored.rest_normals * mirrored.rest).sum(-1).min() > 0)
            True
        """
        other = copy.deepcopy(self)
        other.rest = pose.points(self.rest)
        if (pose.determinant < 0) != outside:
            other.outward, other.triangles = -self.outward, self.triangles[:, [0, 2, 1]]
            signed = other.chord_kernels[:2], other.chords_beyond_border.chunk(2)[0]
            for constant in (*signed, other.volume_third_derivatives, other.volume_cross_products):
                constant *= -1
        other.rest_normals, other.rest_volume = other.normals(other.rest), other.volume(other.rest)
        return other

    def closest_points(self, points: ArrayLike) -> SurfacePoints:
        """Return the points of the rest surface that are closest to given points.

        Args:
            points: `[D, 3]`, length unit, camera frame.

        Returns:
            `SurfacePoints` with the distances.

        Example:
            >>> from torchmembrane.surface.shapes import spherical_cap
            >>> spherical_cap(12.0, 9.0, 15.0).closest_points([[0.0, 0.0, 26.0]]).distance.tolist()
            [2.0]
        """
        X, triangles = self.rest.cpu().double().numpy(), self.triangles.cpu().numpy()
        return projection.closest_points(X, triangles, np.asarray(points, dtype=float))

    def ray_points(self, origins: ArrayLike, directions: ArrayLike) -> SurfacePoints:
        """Return the points where rays first meet the rest surface.

        Args:
            origins: origins of the rays, `[D, 3]`, length unit, camera frame.
            directions: unit directions of the rays, `[D, 3]`.

        Returns:
            `SurfacePoints`; `distance` is the range along the ray, NaN where the ray misses.

        Example:
            >>> from torchmembrane.surface.shapes import spherical_cap
            >>> spherical_cap(12.0, 9.0, 15.0).ray_points(np.zeros((1, 3)), [[0.0, 0.0, 1.0]]).distance.tolist()
            [24.0]
        """
        X, triangles = self.rest.cpu().double().numpy(), self.triangles.cpu().numpy()
        return projection.ray_points(X, triangles, np.asarray(origins, dtype=float), np.asarray(directions, dtype=float))

    def _chord_kernels(self) -> Tensor:
        """Return kernels for `apply_stencil`, `[4, 3, 3]`: chords of the one-ring `p`, the first two times `outward / 6`."""
        p = stencil_kernels()[1:]
        return torch.stack([self.outward / 6 * (p[2] - p[0]), self.outward / 6 * (p[4] - p[0]), p[3] - p[1], p[5] - p[3]])

    def _crossed_chords(self, chords: Tensor) -> Tensor:
        """Return a sixth of `sum p_i x p_i+1` at every vertex, pointing outwards, `[..., 3, V]`, from the chords
        `[..., 3, 4 V]` of `chord_kernels`."""
        (u1, u2), (v1, v2) = (a.chunk(2, -2) for a in chords.index_select(-2, self.xyz_to_yzxzxy).chunk(2, -1))
        first, second = (u1 * v2 - u2 * v1).chunk(2, -1)
        crossed: Tensor = first + second
        return crossed

    def thirds_to_vertices(self, per_triangle: Tensor) -> Tensor:
        """Return sums `[..., V, C]` of a third of the values `[..., m-1, n-1, 2, C]` of the triangles around each vertex."""
        thirds = (per_triangle / 3).unsqueeze(-2).expand(*per_triangle.shape[:-1], 3, per_triangle.shape[-1])
        return corners_to_vertices(triangles_to_corners(thirds), self.grid)


def _levi_civita() -> Tensor:
    e = torch.zeros(3, 3, 3, dtype=torch.float64)
    e[[0, 1, 2], [1, 2, 0], [2, 0, 1]], e[[0, 1, 2], [2, 0, 1], [1, 2, 0]] = 1.0, -1.0
    return e


def _cross_products() -> Tensor:
    """Return the matrix `[9, 3]` that maps `u` to the entries of its cross-product matrix `[u]x`."""
    return _levi_civita().transpose(1, 2).reshape(9, 3)


def _determinant_derivatives() -> Tensor:
    """Return the third derivatives `[9, 81]` of `det [a, b, c]` with respect to its nine entries."""
    levi_civita = _levi_civita()
    return torch.einsum("uvw,ijk->uivjwk", levi_civita, levi_civita).reshape(9, 81)
