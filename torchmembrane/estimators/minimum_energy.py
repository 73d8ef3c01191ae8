"""The paper's estimator: of all surfaces on the observed rays, the one of least elastic energy at the fluid's volume.

One unknown for each free vertex, its position `t_k` along its ray, `x_k = o_k + t_k d_k`. For the harmonic energy
`E(t) = 1/2 t.K t - g.t` exactly, with `K = L o (R R^T)` (eqs. 14, 18, 64); for a hyperelastic membrane the same step is repeated.
"""

import torch
from torch import Tensor, nn

from ..errors import MembraneError
from ..mechanics.cavity import CavityLaw, Equilibrium, rest_balance
from ..mechanics.hyperelastic import AffineQuadrilaterals, ElasticEnergy
from ..solve.anderson import accelerated, first
from ..solve.kkt import constrained_minimum
from ..surface.membrane import Membrane
from ..surface.topology import corners, corners_to_vertices

ELEMENTS = ("triangle", "quadrilateral")
VOLUMES = ("exact", "linear")
STEPS, RELAXED_STEPS = 10, 60
CONVERGED = 1e-5  # largest relative step, and volume error where the volume is exact, of a converged surface


class MinimumEnergy(nn.Module):
    """Surface of least energy on given rays (eqs. 18, 22, 28).

    Arguments
        membrane    the rest surface on the solver's grid
        elasticity  its material (`ElasticEnergy`); with `element = "quadrilateral"` only its rest tension is used
        element     "triangle" (linear), or "quadrilateral": the paper's affine quadrilaterals, harmonic
        smoothing   weight s of `s |S psi|^2`, `psi = t - t_rest` (eq. 28), over the rest tension; S is the grid's Laplacian
        filling     "liquid" (volume kept), "gas" (pressure x volume kept), "open" (pressure stays at rest)
        gas         for a gas: absolute pressure at rest (force / length^2) and volume (length^3)
        volume      "exact", or "linear": linearised once, at the rest ranges (eq. 21)
        steps       of the solve, default 10; 60 where the smoother is relaxed, which the constant inverse knows nothing of
        rest_rays   unit directions `[V, 3]` of the rest rays and their origins `[V, 3]`

    The rest load `h = grad U(X) - p0 grad V(X)` is subtracted, so that zero flow gives exactly zero displacement.
    Wrong where something pushes along the rays: minimum energy says that no force acts there. Features narrower than their
    distance to the camera are flattened.
    """

    def __init__(self, membrane: Membrane, elasticity: ElasticEnergy, rest_rays, element="triangle", smoothing=0.0, filling="liquid",
                 gas: tuple[float, float] | None = None, volume="exact", steps=None):  # fmt: skip
        super().__init__()
        for name, value, known in (("element", element, ELEMENTS), ("volume", volume, VOLUMES)):
            if value not in known:
                raise MembraneError(f"MinimumEnergy: {name} = {value!r}; expected one of {', '.join(known)}")
        self.membrane, self.elasticity, self.volume_constraint = membrane, elasticity, volume
        self.largest_relative_step, self.largest_volume_error = CONVERGED, CONVERGED if volume == "exact" else float("inf")
        self.steps = steps
        self.energy = elasticity if element == "triangle" else AffineQuadrilaterals(membrane, elasticity.tension)
        origins, directions = rest_rays
        self.register_buffer("rest_range", ((membrane.rest - origins) * directions).sum(-1))
        self.smooths = smoothing > 0
        self.register_buffer("smoothing", elasticity.tension * smoothing)
        rest_pressure, rest_load = rest_balance(membrane, self.energy)
        self.cavity = CavityLaw(membrane, rest_pressure, filling, gas)
        self.register_buffer("rest_pressure", rest_pressure)
        self.register_buffer("rest_load", rest_load)
        self.register_buffer("moves", (~membrane.fixed).double())
        self.register_buffer("inverse", self._rest_inverse(directions))

    def _rest_inverse(self, directions: Tensor) -> Tensor:
        K = self.energy.stiffness_along(self.membrane.rest, directions)
        V, free, grid = len(self.membrane.rest), self.membrane.free_vertices, self.membrane.grid
        one = torch.eye(V, dtype=torch.float64)
        smooth = self.smoothing * self._smoother(self._smoother(one))
        dense = (corners_to_vertices(K @ corners(one, grid), grid) + smooth)[free][:, free]
        inverse = torch.zeros(V, V, dtype=torch.float64)
        inverse[free[:, None], free] = torch.linalg.inv(dense)
        return inverse

    def _smoother(self, psi: Tensor) -> Tensor:
        return grid_laplacian(psi, self.membrane.grid)

    def forward(self, origins: Tensor, directions: Tensor, relaxed: Tensor | None = None) -> Equilibrium:
        """`origins`, `directions [..., V, 3]`: the ray of every grid vertex now. Returns the `Equilibrium`.

        `relaxed [..., V]` bool: vertices in contact, where the slope may jump: the smoother of eq. 28 leaves them alone.
        """
        *state, origins, directions = self.start(origins, directions, relaxed)
        for _ in range((self.steps or (STEPS if relaxed is None else RELAXED_STEPS)) - 1):
            state = self.step(*state, origins, directions, relaxed)
        return self.equilibrium(state[0], origins, directions, relaxed)

    def start(self, origins: Tensor, directions: Tensor, relaxed: Tensor | None = None) -> tuple[Tensor, ...]:
        """Ranges `[..., V]` and history after the first step, from rest; rays `[..., 3, V]` on which the rim stays: `d = 0`."""
        fixed = self.membrane.fixed
        origins, directions = torch.where(fixed, self.membrane.rest.mT, origins.mT), torch.where(fixed, 0.0, directions.mT)
        t = self.rest_range.expand(directions[..., 0, :].shape)
        return *first(t, self._move(t, origins, directions, relaxed)[0]), origins, directions

    def step(self, t: Tensor, latest: Tensor, changes: Tensor, origins: Tensor, directions: Tensor, relaxed=None):
        """One step in the ranges `t [..., V]`; `latest` and `changes` as `accelerated` has them."""
        move, _ = self._move(t, origins, directions, relaxed)
        return accelerated(t, move, latest, changes)

    def equilibrium(self, t: Tensor, origins: Tensor, directions: Tensor, relaxed: Tensor | None = None) -> Equilibrium:
        """What these ranges amount to, and how far they are from a solution."""
        x = (origins + t[..., None, :] * directions).mT
        move, pressure = self._move(t, origins, directions, relaxed)
        error = move.abs().amax(-1) / self.membrane.rest_area.sum().sqrt()
        return Equilibrium(x, pressure, self.membrane.volume(x), torch.zeros_like(x), error)

    def _move(self, t: Tensor, origins: Tensor, directions: Tensor, relaxed: Tensor | None) -> tuple[Tensor, Tensor]:
        """Where the rest's stiffness would have the ranges go, `[..., V]`: zero at the solution; and the pressure `[...]`."""
        x = origins + t[..., None, :] * directions
        rise, v = self._rise(t, x, origins, directions)
        load = self.rest_pressure * v + ((self.rest_load - self.energy.gradient(x.mT)).mT * directions).sum(-2)
        if self.smooths:
            load = load - self._smoothing_force(t, relaxed)
        y, g = (torch.stack([load, v], -2) @ self.inverse).unbind(-2)
        if self.cavity.filling == "open":
            return y, self.rest_pressure.expand(rise.shape)
        minimum = constrained_minimum(y, g, v, *self.cavity.condition(rise, self.rest_pressure))
        return minimum.y, self.rest_pressure - minimum.multiplier

    def _rise(self, t: Tensor, x: Tensor, origins: Tensor, directions: Tensor) -> tuple[Tensor, Tensor]:
        """Volume above that at rest `[...]` and its derivative `v [..., V]`: exact, or linear about the rest ranges."""
        linear = self.volume_constraint == "linear"
        x = origins + self.rest_range * directions if linear else x
        gradient = self.membrane.volume_gradient(x.mT).mT
        v, rise = (gradient * directions).sum(-2), (gradient * x).sum((-1, -2)) / 3 - self.membrane.rest_volume
        return (rise + (v * (t - self.rest_range)).sum(-1) if linear else rise), v

    def _smoothing_force(self, t: Tensor, relaxed: Tensor | None) -> Tensor:
        bend = self._smoother((self.moves * (t - self.rest_range))[..., None])
        if relaxed is not None:
            bend = torch.where(relaxed[..., None], 0.0, bend)
        return self.smoothing * self.moves * self._smoother(bend).squeeze(-1)


def grid_laplacian(psi: Tensor, grid: tuple[int, int]) -> Tensor:
    """S of eq. 28 for `psi [..., V, C]` (symmetric): every vertex against its neighbours along the grid's lines."""
    laplacian = torch.tensor(
        [[2.0, -1, 0, -1], [-1, 2, -1, 0], [0, -1, 2, -1], [-1, 0, -1, 2]], dtype=psi.dtype, device=psi.device
    )
    return 0.5 * corners_to_vertices(laplacian @ corners(psi, grid), grid)
