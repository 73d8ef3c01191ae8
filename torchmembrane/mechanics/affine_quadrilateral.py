"""The paper's element: one affine map per quadrilateral (eqs. 11-18)."""

import torch
from torch import Tensor, nn

from ..surface.membrane import Membrane
from ..surface.topology import corners, corners_to_vertices


class AffineQuadrilaterals(nn.Module):
    """The paper's element: one affine map fitted to the four corners (eqs. 15-18), linear in the corner positions.

    The map is fitted in the plane that the diagonals of the quadrilateral span, because in space the matrix G of eq. 16 is
    singular. So `A [3, 2] = sum_k x_k g_k^T` with constant `g_k`, and the energy is `E = 1/2 tension sum area tr(A^T A)` (eq.
    12 with its 1/2).

    Args:
        membrane: the rest surface.
        tension: tension of the rest state, force / length.

    Limitations:
        The hourglass mode has no energy: use the element with the smoother (eq. 28).
    """

    map_weights: Tensor
    tension: Tensor
    area: Tensor

    def __init__(self, membrane: Membrane, tension: float | Tensor = 1.0):
        super().__init__()
        self.grid = membrane.grid
        p = corners(membrane.rest, self.grid)
        diagonal_1, diagonal_2 = p[..., 2, :] - p[..., 0, :], p[..., 3, :] - p[..., 1, :]
        normal = torch.linalg.cross(diagonal_1, diagonal_2)
        area = torch.linalg.vector_norm(normal, dim=-1) / 2
        axis_1 = nn.functional.normalize(diagonal_1, dim=-1)
        axis_2 = nn.functional.normalize(torch.linalg.cross(normal, axis_1), dim=-1)
        centred = p - p.mean(-2, keepdim=True)
        plane = torch.stack([(centred * axis_1[..., None, :]).sum(-1), (centred * axis_2[..., None, :]).sum(-1)], -1)
        g11, g12, g22 = (plane[..., a] * plane[..., b] for a, b in ((0, 0), (0, 1), (1, 1)))
        g11, g12, g22 = g11.sum(-1), g12.sum(-1), g22.sum(-1)
        inverse = torch.stack([torch.stack([g22, -g12], -1), torch.stack([-g12, g11], -1)], -2)
        inverse = inverse / (g11 * g22 - g12**2)[..., None, None]
        self.register_buffer("map_weights", plane @ inverse)
        self.register_buffer("tension", torch.as_tensor(tension, dtype=torch.float64).clone())
        self.register_buffer("area", area)

    def affine_maps(self, x: Tensor) -> Tensor:
        """Return the linear parts `A [..., m-1, n-1, 3, 2]` of the maps from the quadrilaterals' rest planes."""
        return corners(x, self.grid).mT @ self.map_weights

    def energy(self, x: Tensor) -> Tensor:
        """Return the energy `1/2 tension sum area tr(A^T A)` of vertices `x [..., V, 3]`, minus its value at rest, `[...]`.

        `ElasticEnergy` defines its harmonic energy in the same way.
        """
        maps = self.affine_maps(x)
        return self.tension / 2 * (self.area * ((maps**2).sum((-1, -2)) - 2)).sum((-1, -2))

    def gradient(self, x: Tensor, weight: Tensor | None = None) -> Tensor:
        """Return the gradient `dE/dx`, `[..., V, 3]`.

        Args:
            x: vertices `[..., V, 3]`.
            weight: weight of each quadrilateral's energy, `[..., m-1, n-1]`; default 1.
        """
        scale = self.tension * self.area if weight is None else self.tension * self.area * weight
        maps = self.affine_maps(x) * scale[..., None, None]
        return corners_to_vertices(self.map_weights @ maps.mT, self.grid)

    def local_maps(self, directions: Tensor) -> Tensor:
        """Return the derivatives of each quadrilateral's map in the ranges of its corners (eqs. 15-17): `A = sum_k t_k A_k`.

        The fit `A = F^T G^-1` is linear in the corner positions `t_k d_k`; the constant weights contain `G^-1`.

        Args:
            directions: unit directions of the rays, `[..., V, 3]`.

        Returns:
            `A_k [..., m-1, n-1, 3, 2, 4]`.
        """
        return corners(directions, self.grid).mT[..., :, None, :] * self.map_weights.mT[..., None, :, :]

    def q_blocks(self, directions: Tensor, weight: Tensor | None = None) -> Tensor:
        """Return the paper's matrix Q (eq. 18) of every quadrilateral, `[..., m-1, n-1, 6, 4]`.

        It maps the ranges of the four corners to the six entries of the affine map, times `sqrt(tension x area x weight)`. The
        sum of `Q^T Q` over the quadrilaterals is `K`, the stiffness matrix of the energy in the ranges.

        Args:
            directions: unit directions of the rays, `[..., V, 3]`.
            weight: weight of each quadrilateral's energy, `[..., m-1, n-1]`; default 1.
        """
        scale = self.tension * self.area if weight is None else self.tension * self.area * weight
        return self.local_maps(directions).flatten(-3, -2) * scale.sqrt()[..., None, None]

    def stiffness_along(self, x: Tensor, directions: Tensor) -> Tensor:
        """Return the corner matrices `[..., m-1, n-1, 4, 4]` of `K = L o (R R^T)`.

        The energy is quadratic, so they do not depend on `x`.
        """
        d = corners(directions, self.grid)
        L = (self.tension * self.area)[..., None, None] * (self.map_weights @ self.map_weights.mT)
        return L * (d @ d.mT)

    def q_matrix(self, directions: Tensor) -> Tensor:
        """Return the paper's matrix `Q` (eq. 18) as a dense matrix `[..., 6 (m-1)(n-1), V]`.

        It maps the ranges `t` to the weighted entries of all affine maps, so `||Q t||^2 = t^T K t`. It is meant for studies and
        tests; the estimator uses `K`.
        """
        one = torch.eye(self.grid[0] * self.grid[1], dtype=directions.dtype, device=directions.device)
        return (self.q_blocks(directions) @ corners(one, self.grid)).flatten(-4, -2)
