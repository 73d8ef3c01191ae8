"""The paper's element: one affine map for each quadrilateral (eqs. 11-18)."""

import torch
from torch import Tensor, nn

from ..surface.membrane import Membrane
from ..surface.topology import corners, corners_to_vertices


class AffineQuadrilaterals(nn.Module):
    """The paper's element: one affine map fitted to the four corners (eqs. 15-18), linear in the corner positions.

    The map is fitted in the plane of the quadrilateral (spanned by its diagonals; in space G of eq. 16 is singular), so that
    `A [3, 2] = sum_k x_k g_k^T` with constant `g_k`, and `E = 1/2 tension sum area tr(A^T A)` (eq. 12 with its 1/2).

    Args:
        membrane: the rest surface.
        tension: tension of the rest state, force / length.

    Limitations:
        It is blind to the hourglass mode: use it with the smoother (eq. 28).
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
        """Linear parts `A [..., m-1, n-1, 3, 2]` of the maps from each quadrilateral's rest plane."""
        return corners(x, self.grid).mT @ self.map_weights

    def energy(self, x: Tensor) -> Tensor:
        """`1/2 tension sum area tr(A^T A)`, `[..., V, 3]` to `[...]`; less the rest's, as `ElasticEnergy`'s harmonic energy."""
        maps = self.affine_maps(x)
        return self.tension / 2 * (self.area * ((maps**2).sum((-1, -2)) - 2)).sum((-1, -2))

    def gradient(self, x: Tensor, weight: Tensor | None = None) -> Tensor:
        """`dE/dx`, `[..., V, 3]`; `weight [..., m-1, n-1]`: of each quadrilateral's share, default 1."""
        scale = self.tension * self.area if weight is None else self.tension * self.area * weight
        maps = self.affine_maps(x) * scale[..., None, None]
        return corners_to_vertices(self.map_weights @ maps.mT, self.grid)

    def local_maps(self, directions: Tensor) -> Tensor:
        """What each corner's range adds to the map of its quadrilateral (eqs. 15-17): `A = sum_k t_k A_k`.

        The fit `A = F^T G^-1` is linear in the points `t_k d_k` that it maps to; `G^-1` is in the constant weights.

        Args:
            directions: `[..., V, 3]`, the rays' unit directions.

        Returns:
            `A_k [..., m-1, n-1, 3, 2, 4]`.
        """
        return corners(directions, self.grid).mT[..., :, None, :] * self.map_weights.mT[..., None, :, :]

    def q_blocks(self, directions: Tensor, weight: Tensor | None = None) -> Tensor:
        """The paper's Q (eq. 18) by quadrilaterals, `[..., m-1, n-1, 6, 4]`: the weighted entries of the map, linear in the
        ranges of the four corners. Summed over quadrilaterals `Q^T Q = K`.

        Args:
            directions: `[..., V, 3]`, the rays' unit directions.
            weight: `[..., m-1, n-1]`, of each quadrilateral's energy, default 1.
        """
        scale = self.tension * self.area if weight is None else self.tension * self.area * weight
        return self.local_maps(directions).flatten(-3, -2) * scale.sqrt()[..., None, None]

    def stiffness_along(self, x: Tensor, directions: Tensor) -> Tensor:
        """Corner matrices `[..., m-1, n-1, 4, 4]` of `K = L o (R R^T)`, exactly quadratic: `x` is not looked at."""
        d = corners(directions, self.grid)
        L = (self.tension * self.area)[..., None, None] * (self.map_weights @ self.map_weights.mT)
        return L * (d @ d.mT)

    def q_matrix(self, directions: Tensor) -> Tensor:
        """The paper's `Q` (eq. 18), `[..., 6 (m-1)(n-1), V]`: rows are the weighted entries of all maps, linear in `t`.

        `||Q t||^2 = t^T K t`. Dense: for study and tests, the estimator works with its square.
        """
        one = torch.eye(self.grid[0] * self.grid[1], dtype=directions.dtype, device=directions.device)
        return (self.q_blocks(directions) @ corners(one, self.grid)).flatten(-4, -2)
