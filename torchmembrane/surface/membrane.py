"""The rest surface as a structured grid: triangles, rim, areas, normals, enclosed volume and its gradient.

Which vertices form the triangles: `topology`. Sums around a vertex are convolutions of the grid: `stencil`.
"""

import copy

import numpy as np
import torch
from numpy.typing import ArrayLike
from torch import Tensor, nn

from ..errors import MembraneError, check_arguments
from ..pose import ViewPose
from ..solve.stencil import apply_stencil, stencil_kernels
from . import projection
from .checks import checked_grid, checked_orientation
from .projection import SurfacePoints
from .resampling import resampled_grid
from .topology import corners, corners_to_vertices, rim_loop, triangles_of, triangles_to_corners


class Membrane(nn.Module):
    """A rest surface with a fixed rim, on an `m x n` grid in the camera's frame.

    Either winding is accepted; triangles are oriented outwards, away from the camera. Vertex `k = i n + j`, `V = m n` in all,
    `T = 2 (m-1) (n-1)` triangles. In the methods `x [..., V, 3]` are vertices anywhere, of a batch of any shape.

    Args:
        vertices: `[m, n, 3]`, length unit.
        fixed: `[m, n]` bool, vertices that do not move (default: the grid's border; the border is fixed always).

    Attributes:
        grid: `m, n`.
        outward: +1 where the grid as given has its triangles outwards, else -1.
        rest: vertices `[V, 3]`.
        triangles: `[T, 3]` int, their vertices in outward order.
        fixed: `[V]` bool.
        free_vertices: indices of those that are not fixed.
        rest_area: `[V]`, lumped: a third of the triangles around the vertex.
        rest_normals: `[V, 3]`, outward, of length one.
        size: square root of the rest area, length unit: against it distances on this surface are small or large.
        rest_volume: `[]`, between the rest surface and the camera's centre.

    Raises:
        MembraneError: the grid folds, degenerates, has a free border or cannot be seen from the camera.

    Limitations:
        Every point is seen from the camera, the origin: no undercuts.

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
        index = torch.arange(m * n).reshape(m * n, 1)
        triangles = triangles_of(corners(index, self.grid)).reshape(-1, 3)
        rest = torch.from_numpy(X.reshape(-1, 3).copy())
        self.outward = checked_orientation(rest.numpy(), triangles.numpy(), fixed.ravel())
        if self.outward < 0:
            triangles = triangles[:, [0, 2, 1]]
        self.register_buffer("rest", rest)
        chords = self._chord_kernels()
        self.register_buffer("chord_kernels", chords)
        ones = torch.ones(m * n, 1).double()
        self.register_buffer("chords_beyond_border", apply_stencil(ones, chords, self.grid).flatten())
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
        """Outward area vectors of all triangles: the normal times the area.

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
        """Lumped area of every vertex: a third of the triangles around it.

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
        """Unit outward normals at the vertices: of the area vectors summed around them, as the volume gradient's.

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
        beyond = self.chords_beyond_border * torch.cat([x.transpose(-2, -1)] * 4, -1)  # vertices beyond are the vertex itself
        along = self._crossed_chords(apply_stencil(x, self.chord_kernels, self.grid) - beyond)
        return (along * along.square().sum(-2, keepdim=True).clamp_min(torch.finfo(x.dtype).tiny).rsqrt()).mT

    def volume(self, x: Tensor) -> Tensor:
        """Volume between the surface and the camera's centre (eq. 19).

        `1/6 sum det [x_a, x_b, x_c]`, of the two triangles of a quadrilateral `det [a, b - d, c]`. Positive for outward
        triangles: vertices run clockwise seen from the origin (the paper says counterclockwise). With a fixed rim the apex adds
        a constant.

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
        """Derivative of `volume` in the vertices; the transposed cofactors of eq. 20.

        The six neighbours `p` in turn give `sum p_i x p_i+1 = (p_2 - p_0) x (p_3 - p_1) + (p_4 - p_0) x (p_5 - p_3)`.

        Args:
            x: vertices `[..., V, 3]`.

        Returns:
            `[..., V, 3]`, length unit squared; at inner vertices along the outward normal, as long as a third of the area.

        Example:
            >>> from torchmembrane.surface.shapes import heightfield
            >>> plane = heightfield([0, 1, 2], [0, 1, 2], np.full((3, 3), 6.0))
            >>> plane.volume_gradient(plane.rest)[4].round(decimals=9).abs().tolist()
            [0.0, 0.0, 1.0]
        """
        return self._crossed_chords(apply_stencil(x, self.chord_kernels, self.grid)).mT

    def volume_hessian_blocks(self, x: Tensor) -> Tensor:
        """Second derivatives of every triangle's share of the volume in its nine vertex coordinates.

        Args:
            x: vertices `[..., V, 3]`.

        Returns:
            `[..., m-1, n-1, 2, 9, 9]`, vertices as in `TRIANGLE_CORNERS`.
        """
        blocks: Tensor = (triangles_of(corners(x, self.grid)).flatten(-2) @ self.volume_third_derivatives).unflatten(-1, (9, 9))
        return blocks

    def volume_one_ring(self, chords: Tensor) -> Tensor:
        """Second derivatives of `volume` in an inner vertex and its six neighbours; those in one vertex alone are zero.

        Half of what they give of the edges to the neighbours is the gradient.

        Args:
            chords: `[..., 3, 6 N]`, from the neighbour after each to that before it (`one_ring_edges`).

        Returns:
            `[..., 3, 3, 6, N]`.
        """
        blocks: Tensor = (self.volume_cross_products @ chords).unflatten(-2, (3, 3)).unflatten(-1, (6, -1))
        return blocks

    @property
    def cavity_volume(self) -> float:
        """Volume between the rest surface and a fan from the rim's centroid over its rim, in length unit cubed."""
        rim = self.rest.cpu().double().numpy()[rim_loop(self.grid)]
        fan = np.cross(rim, np.roll(rim, -1, 0)) @ rim.mean(0)
        return float(self.rest_volume) - abs(float(fan.sum())) / 6

    @check_arguments
    def resampled(self, grid: tuple[int, int]) -> "Membrane":
        """The same rest surface on another grid whose lines are equally spaced along the surface.

        Bicubic in the grid's own coordinates, so that the rim stays where it is.

        Args:
            grid: the new numbers of lines, at least 5 and 5.

        Returns:
            Another `Membrane`.

        Raises:
            MembraneError: fewer lines.

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
        """The same rest surface, its vertices in the same order, in another frame: of a view that may see a part of it only.

        Args:
            pose: pose of this frame in the other one; it may reflect.
            outside: whether the other view looks at the outer side, which is then away from its triangles' normals.

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
        """The material points of the rest surface closest to given ones.

        Args:
            points: `[D, 3]`, length unit, camera frame.

        Returns:
            `SurfacePoints` with their distances.

        Example:
            >>> from torchmembrane.surface.shapes import spherical_cap
            >>> spherical_cap(12.0, 9.0, 15.0).closest_points([[0.0, 0.0, 26.0]]).distance.tolist()
            [2.0]
        """
        X, triangles = self.rest.cpu().double().numpy(), self.triangles.cpu().numpy()
        return projection.closest_points(X, triangles, np.asarray(points, dtype=float))

    def ray_points(self, origins: ArrayLike, directions: ArrayLike) -> SurfacePoints:
        """Where rays first meet the rest surface.

        Args:
            origins: `[D, 3]`, length unit, camera frame.
            directions: `[D, 3]`, of length one.

        Returns:
            `SurfacePoints`; `distance` is the range along the ray, NaN where it misses.

        Example:
            >>> from torchmembrane.surface.shapes import spherical_cap
            >>> spherical_cap(12.0, 9.0, 15.0).ray_points(np.zeros((1, 3)), [[0.0, 0.0, 1.0]]).distance.tolist()
            [24.0]
        """
        X, triangles = self.rest.cpu().double().numpy(), self.triangles.cpu().numpy()
        return projection.ray_points(X, triangles, np.asarray(origins, dtype=float), np.asarray(directions, dtype=float))

    def _chord_kernels(self) -> Tensor:
        """Kernels for `apply_stencil`, `[4, 3, 3]`: chords across the one-ring `p`, the first two a sixth, outwards."""
        p = stencil_kernels()[1:]
        return torch.stack([self.outward / 6 * (p[2] - p[0]), self.outward / 6 * (p[4] - p[0]), p[3] - p[1], p[5] - p[3]])

    def _crossed_chords(self, chords: Tensor) -> Tensor:
        """A sixth of `sum p_i x p_i+1` at every vertex, outwards, `[..., 3, V]`, from chords `[..., 3, 4 V]` as
        `chord_kernels` has them."""
        (u1, u2), (v1, v2) = (a.chunk(2, -2) for a in chords.index_select(-2, self.xyz_to_yzxzxy).chunk(2, -1))
        first, second = (u1 * v2 - u2 * v1).chunk(2, -1)
        crossed: Tensor = first + second
        return crossed

    def thirds_to_vertices(self, per_triangle: Tensor) -> Tensor:
        """Sums `[..., V, C]` of a third of what the triangles around each vertex have, `[..., m-1, n-1, 2, C]`."""
        thirds = (per_triangle / 3).unsqueeze(-2).expand(*per_triangle.shape[:-1], 3, per_triangle.shape[-1])
        return corners_to_vertices(triangles_to_corners(thirds), self.grid)


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
