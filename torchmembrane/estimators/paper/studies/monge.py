"""The paper's own unknowns: heights at fixed (x, y), `z = s(x, y) + psi(x, y)` (eqs. 5-10, 14, 18, 22; Appendix D).

The plane map A moves a piece of the membrane with rest slopes `s_x, s_y` to x', where the surface has the slopes of `s + psi`:

    tr(A^T H A adj G) = m_xx psi_x^2 + m_xy psi_x psi_y + m_yy psi_y^2 + m_x psi_x + m_y psi_y + m_0    (eqs. 55-62)

with G from the rest slopes at x and H from the slopes at x' (eq. 10 prints x for both). The energy is half of this times
`dx dy / sqrt(det G)`. At fixed (x, y) the volume is exactly linear in psi, but the energy is not quadratic, because A depends
on psi too. At fixed material points (`minimum_energy`) the energy is quadratic, and the volume is not linear.
"""

from typing import NamedTuple

import torch
from torch import Tensor, nn

from ....errors import MembraneError
from ....mechanics.cavity import rest_balance
from ....mechanics.hyperelastic import ElasticEnergy
from ....surface.membrane import Membrane
from ....surface.topology import corners, triangles_of
from ...base import Equilibrium
from ..estimator import grid_laplacian

STEEPEST = 20.0  # largest ratio of a piece's area to its footprint on a rest surface that heights can describe


class Coefficients(NamedTuple):
    """The coefficients `m_xx, m_yy, m_xy, m_x, m_y, m_0` of eqs. 57-62, each `[...]`.

    Example:
        >>> m = coefficients(torch.eye(2), torch.zeros(2))
        >>> m(torch.tensor([0.3, 0.4])).item()  # 2 + the squared slope
        2.25
    """

    xx: Tensor
    yy: Tensor
    xy: Tensor
    x: Tensor
    y: Tensor
    one: Tensor

    def __call__(self, psi_slope: Tensor) -> Tensor:
        """Evaluate the quadratic form (56) at the slopes `psi_x, psi_y [..., 2]`."""
        p, q = psi_slope.unbind(-1)
        return self.xx * p**2 + self.xy * p * q + self.yy * q**2 + self.x * p + self.y * q + self.one


def adjugate(matrix: Tensor) -> Tensor:
    """Return the adjugate `adj M = det M M^-1` of matrices `[..., 2, 2]`.

    Example:
        >>> adjugate(torch.tensor([[1.0, 2.0], [3.0, 4.0]])).tolist()
        [[4.0, -2.0], [-3.0, 1.0]]
    """
    (a, b), (c, d) = (row.unbind(-1) for row in matrix.unbind(-2))
    return torch.stack([torch.stack([d, -b], -1), torch.stack([-c, a], -1)], -2)


def metric(slope: Tensor) -> Tensor:
    """Return the first fundamental form `[..., 2, 2]` of a graph with slopes `[..., 2]` (eqs. 9, 10).

    Example:
        >>> metric(torch.tensor([1.0, 2.0])).tolist()
        [[2.0, 2.0], [2.0, 5.0]]
    """
    return torch.eye(2, dtype=slope.dtype, device=slope.device) + slope[..., :, None] * slope[..., None, :]


def coefficients(A: Tensor, rest_slope: Tensor, slope: Tensor | None = None) -> Coefficients:
    """Return the coefficients of eqs. 57-62.

    With `N = A adj(G) A^T`:

        m_xx = N_11, m_yy = N_22, m_xy = 2 N_12, m_x = 2 (N_11 s_x + N_12 s_y), m_y = 2 (N_12 s_x + N_22 s_y),
        m_0 = N_11 (1 + s_x^2) + 2 N_12 s_x s_y + N_22 (1 + s_y^2)

    Args:
        A: plane map, `[..., 2, 2]`.
        rest_slope: slopes of s at x, `[..., 2]`.
        slope: slopes of s at x', `[..., 2]`; default: those at x, as the paper prints it.

    Returns:
        The coefficients, each `[...]`.
    """
    N = A @ adjugate(metric(rest_slope)) @ A.mT
    p, q = (rest_slope if slope is None else slope).unbind(-1)
    xx, xy, yy = N[..., 0, 0], N[..., 0, 1], N[..., 1, 1]
    constant = xx * (1 + p**2) + 2 * xy * p * q + yy * (1 + q**2)
    return Coefficients(xx, yy, 2 * xy, 2 * (xx * p + xy * q), 2 * (xy * p + yy * q), constant)


class MongeMinimumEnergy(nn.Module):
    """Minimum-energy estimator with heights at fixed (x, y) as unknowns, for harmonic material and liquid filling; for studies.

    The unknown `psi [F]` is the height of the free vertices above their rest height `s(x, y)`. The estimator minimises
    `|Q psi - gamma|^2 + w |S psi|^2` at constant volume. Q is the derivative, with respect to psi, of the 3 x 2 maps of the
    pieces, `-gamma` their value at psi = 0, and S the grid's Laplacian. The second-order terms of the maps, from rays that meet
    a tilted surface, are neglected. A rest load in psi is subtracted, so that zero flow gives exactly psi = 0.

    Args:
        membrane: the rest surface.
        elasticity: elastic energy of the membrane; "harmonic".
        rest_rays: rays of the vertices at rest, `(origins, directions)`, `[V, 3]` each.
        steps: number of steps; 1 is the paper's solution (eqs. 18, 22, about psi = 0), more repeat it about the surface found.
        smoothing: weight w relative to the rest tension.

    Raises:
        MembraneError: the surface is not a graph over (x, y).

    Limitations:
        Where rays meet the surface between the fixed points, oscillations with the wavelength of the grid hardly change the
        observation, so the smoother of eq. 28 is needed.

    Example:
        >>> from torchmembrane.surface.shapes import spherical_cap
        >>> cap = spherical_cap(12, 5, 10, (5, 5))
        >>> rays = torch.zeros_like(cap.rest), cap.rest
        >>> estimator = MongeMinimumEnergy(cap, ElasticEnergy(cap, "harmonic"), rays)
        >>> bool((estimator(*rays).vertices - cap.rest).abs().max() < 1e-9)
        True
    """

    v: Tensor

    def __init__(
        self,
        membrane: Membrane,
        elasticity: ElasticEnergy,
        rest_rays: tuple[Tensor, Tensor],
        steps: int = 1,
        smoothing: float = 0.1,
    ) -> None:
        super().__init__()
        self.membrane, self.steps = membrane, steps
        self.rest_pressure, _ = rest_balance(membrane, elasticity)
        edges = _edges(membrane.rest, membrane.grid)
        plane = edges[..., :2]
        footprint = (plane[..., 0, 0] * plane[..., 1, 1] - plane[..., 0, 1] * plane[..., 1, 0]) * membrane.outward / 2
        steepness = torch.linalg.cross(edges[..., 0, :], edges[..., 1, :]).norm(dim=-1) / 2 / footprint
        if ((footprint <= 0) | (steepness > STEEPEST)).any():
            raise MembraneError(
                f"MongeMinimumEnergy: a triangle is {float(steepness.abs().max()):.3g} times its footprint, or folded; "
                f"expected a graph over the x, y plane, at most {STEEPEST:.3g} times; or use MinimumEnergy, with ranges"
            )
        self.rest_plane = torch.linalg.inv(plane)
        self.rest_slope = (self.rest_plane @ edges[..., 2:]).squeeze(-1)
        self.weight = (elasticity.tension * footprint).sqrt()[..., None, None]
        shares = footprint.flatten().repeat_interleave(3) / 3
        self.v = footprint.new_zeros(len(membrane.rest)).index_add(0, membrane.triangles.flatten(), shares)[
            membrane.free_vertices
        ]
        S = grid_laplacian(torch.eye(len(membrane.rest), dtype=torch.float64), membrane.grid)[:, membrane.free_vertices]
        self.smooth = smoothing * elasticity.tension * S.T @ S
        Q, gamma = self._linearised(torch.zeros_like(self.v), *rest_rays)
        self.rest_load = -Q.T @ gamma - self.rest_pressure * self.v

    def forward(self, origins: Tensor, directions: Tensor) -> Equilibrium:
        """Return the equilibrium of one frame.

        Args:
            origins: origins of the vertices' rays, `[V, 3]`.
            directions: directions of the vertices' rays, `[V, 3]`.

        Returns:
            The `Equilibrium`; its vertices are the material points, at which the rays meet the surface found.
        """
        psi, pressure, step = self.heights(origins, directions)
        x = self.material(psi, self._cells(psi, origins, directions), origins, directions)
        return Equilibrium.without_tractions(x, pressure, self.membrane.volume(self.surface(psi)), step)

    def heights(self, origins: Tensor, directions: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return `psi` at the free points, the pressure, and the last step relative to the surface's size (eqs. 22, 27 with
        `v.psi = 0`)."""
        psi, v = torch.zeros_like(self.v), self.v
        for _ in range(self.steps):
            Q, gamma = self._linearised(psi, origins, directions)
            load = Q.T @ gamma + self.rest_load - self.smooth @ psi
            y, z = torch.linalg.solve(Q.T @ Q + self.smooth, torch.stack([load, v], -1)).unbind(-1)
            pressure = -(v @ y) / (v @ z)
            step = y + pressure * z
            psi = psi + step
        return psi, pressure, step.abs().max() / self.membrane.size

    def _linearised(self, psi: Tensor, origins: Tensor, directions: Tensor) -> tuple[Tensor, Tensor]:
        """Return `Q` and `gamma` of `|Q step - gamma|^2` about psi (eq. 18)."""
        cell = self._cells(psi, origins, directions)

        def maps(y: Tensor) -> Tensor:
            return (self.weight * self.maps(self.material(y, cell, origins, directions))).flatten()

        return torch.func.jacfwd(maps)(psi), -maps(psi)

    def surface(self, psi: Tensor) -> Tensor:
        """Return the points `(x, y, s + psi)` over the fixed grid, `[V, 3]`."""
        lift = psi.new_zeros(len(self.membrane.rest)).index_add(0, self.membrane.free_vertices, psi)
        return torch.cat([self.membrane.rest[:, :2], self.membrane.rest[:, 2:] + lift[:, None]], 1)

    def _cells(self, psi: Tensor, origins: Tensor, directions: Tensor) -> Tensor:
        """Return the vertex indices of the triangle that each ray meets, `[V, 3]`."""
        m, n = self.membrane.grid
        now = Membrane(self.surface(psi).reshape(m, n, 3), self.membrane.fixed.numpy().reshape(m, n))
        return torch.from_numpy(now.ray_points(origins, directions).vertices)

    def material(self, psi: Tensor, cell: Tensor, origins: Tensor, directions: Tensor) -> Tensor:
        """Return the material points `[V, 3]`: the intersections of their rays with the planes of the triangles `cell`."""
        a, b, c = self.surface(psi)[cell].unbind(-2)
        normal = torch.linalg.cross(b - a, c - a)
        reach = ((a - origins) * normal).sum(-1, keepdim=True) / (directions * normal).sum(-1, keepdim=True)
        return torch.where(self.membrane.fixed[:, None], self.membrane.rest, origins + reach * directions)

    def maps(self, x: Tensor) -> Tensor:
        """Return the pieces' maps into space, `[A; slope'.A] adj(G)^1/2 / det(G)^1/4`, `[..., 3, 2]`, for vertices `[V, 3]`.

        Half their squared norm is the energy of Appendix D per unit of `dx dy`.
        """
        edges = _edges(x, self.membrane.grid)
        A = (self.rest_plane @ edges[..., :2]).mT
        slope = torch.linalg.solve(edges[..., :2], edges[..., 2:])
        lifted = torch.cat([A, slope.mT @ A], -2)
        G = metric(self.rest_slope)
        scale = torch.linalg.det(G)[..., None, None]
        Q: Tensor = lifted @ torch.linalg.cholesky(adjugate(G)) / scale**0.25
        return Q


def _edges(x: Tensor, grid: tuple[int, int]) -> Tensor:
    """Return both edges from the first corner of every triangle, `[m-1, n-1, 2, 2, 3]`."""
    p = triangles_of(corners(x, grid))
    return p[..., 1:, :] - p[..., :1, :]
