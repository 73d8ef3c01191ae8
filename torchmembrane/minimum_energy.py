"""The paper's estimator: of all surfaces on the observed rays, the one of least elastic energy at the fluid's volume.

One unknown for each free vertex, its position `t_k` along its ray, `x_k = o_k + t_k d_k`. For the harmonic energy
`E(t) = 1/2 t.K t - g.t` exactly, with `K = L o (R R^T)` (eqs. 14, 18, 64); for a hyperelastic sheet the same step is repeated.
"""

import torch
from torch import Tensor, nn

from .cavity import CavityLaw, Equilibrium, rest_balance
from .energy import AffineQuadrilaterals, Sheet
from .errors import MembraneError
from .membrane import Membrane, corners, corners_to_vertices
from .solve.conjugate_gradient import conjugate_gradient, symmetric_product
from .solve.kkt import constrained_minimum

ELEMENTS = ("triangle", "quadrilateral")
VOLUMES = ("exact", "linear")
STEPS = 8
CONVERGED = 1e-5  # largest unbalance, and volume error where the volume is exact, of a converged surface
SINGLE_SOLVE, REPEATED_SOLVE = 12, 4  # conjugate-gradient steps where one solve has to do, and where others follow


class MinimumEnergy(nn.Module):
    """Surface of least energy on given rays (eqs. 18, 22, 28).

    Arguments
        membrane    the rest surface on the solver's grid
        sheet       its material (`Sheet`); with `element = "quadrilateral"` only its rest tension is used
        element     "triangle" (linear), or "quadrilateral": the paper's affine quadrilaterals, harmonic
        smoothing   weight s of `s |S psi|^2`, `psi = t - t_rest` (eq. 28), over the rest tension; S is the grid's Laplacian
        filling     "liquid" (volume kept), "gas" (pressure x volume kept), "open" (pressure stays at rest)
        gas         for a gas: absolute pressure at rest (force / length^2) and volume (length^3)
        volume      "exact", or "linear": linearised once, at the rest ranges (eq. 21)
        steps       Newton steps: 8, or 1 for the harmonic energy with linear volume, where the first is exact
        rest_rays   unit directions `[V, 3]` of the rest rays and their origins `[V, 3]`

    The rest load `h = grad U(X) - p0 grad V(X)` is subtracted, so that zero flow gives exactly zero displacement.
    Wrong where something pushes along the rays: minimum energy says that no force acts there. Features narrower than their
    distance to the camera are flattened.
    """

    def __init__(self, membrane: Membrane, sheet: Sheet, rest_rays, element="triangle", smoothing=0.0, filling="liquid",
                 gas: tuple[float, float] | None = None, volume="exact", steps=None, solver_steps=None):  # fmt: skip
        super().__init__()
        for name, value, known in (("element", element, ELEMENTS), ("volume", volume, VOLUMES)):
            if value not in known:
                raise MembraneError(f"MinimumEnergy: {name} = {value!r}; expected one of {', '.join(known)}")
        self.membrane, self.sheet, self.volume_constraint = membrane, sheet, volume
        self.largest_unbalance, self.largest_volume_error = CONVERGED, CONVERGED if volume == "exact" else float("inf")
        quadratic = volume == "linear" and (element == "quadrilateral" or sheet.model == "harmonic") and filling != "gas"
        self.steps = steps or (1 if quadratic else STEPS)
        self.solver_steps = solver_steps or (SINGLE_SOLVE if self.steps == 1 else REPEATED_SOLVE)
        self.energy = sheet if element == "triangle" else AffineQuadrilaterals(membrane, sheet.tension)
        origins, directions = rest_rays
        self.register_buffer("rest_range", ((membrane.rest - origins) * directions).sum(-1))
        self.register_buffer("smoothing", sheet.tension * smoothing)
        rest_pressure, rest_load = rest_balance(membrane, self.energy)
        self.cavity = CavityLaw(membrane, rest_pressure, filling, gas)
        self.register_buffer("rest_pressure", rest_pressure)
        self.register_buffer("rest_load", rest_load)
        self.register_buffer("moves", (~membrane.fixed).double())
        self.register_buffer("inverse", self._rest_inverse(directions))

    def _rest_inverse(self, directions: Tensor) -> Tensor:
        K = self.energy.stiffness_along(self.membrane.rest, directions)
        V, free = len(self.membrane.rest), self.membrane.free
        dense = self._stiffness_product(K, torch.eye(V, dtype=torch.float64))[free][:, free]
        inverse = torch.zeros(V, V, dtype=torch.float64)
        inverse[free[:, None], free] = torch.linalg.inv(dense)
        return inverse

    def _stiffness_product(self, K: Tensor, y: Tensor, stiff: Tensor | float = 1.0) -> Tensor:
        moves, grid = self.moves[:, None], self.membrane.grid
        product = corners_to_vertices(K @ corners(moves * y, grid), grid)
        return moves * (product + self.smoothing * self._smoother(stiff * self._smoother(moves * y)))

    def _smoother(self, psi: Tensor) -> Tensor:
        return grid_laplacian(psi, self.membrane.grid)

    def forward(self, origins: Tensor, directions: Tensor, relaxed: Tensor | None = None) -> Equilibrium:
        """`origins`, `directions [..., V, 3]`: the ray of every grid vertex now. Returns the `Equilibrium`.

        `relaxed [..., V]` bool: vertices in contact, where the slope may jump: the smoother of eq. 28 leaves them alone.
        """
        t, pressure = self.start(directions)
        state = _State(self, origins, directions, relaxed)
        for _ in range(self.steps):
            t, pressure = self._newton_step(state, t, pressure)
        return self._equilibrium(state, t, pressure)

    def start(self, directions: Tensor) -> tuple[Tensor, Tensor]:
        """The rest ranges `[..., V]` and the rest pressure `[...]`, from which the steps begin."""
        return self.rest_range.expand(directions.shape[:-1]), self.rest_pressure.expand(directions.shape[:-2])

    def step(self, t: Tensor, pressure: Tensor, origins: Tensor, directions: Tensor) -> tuple[Tensor, Tensor]:
        """One Newton step in the ranges `t [..., V]` and the pressure `[...]`."""
        return self._newton_step(_State(self, origins, directions), t, pressure)

    def equilibrium(self, t: Tensor, pressure: Tensor, origins: Tensor, directions: Tensor) -> Equilibrium:
        """What these ranges and this pressure amount to, and how far they are from a solution."""
        return self._equilibrium(_State(self, origins, directions), t, pressure)

    def _equilibrium(self, state: "_State", t: Tensor, pressure: Tensor) -> Equilibrium:
        x = state.surface(t)
        left = symmetric_product(self.inverse, state.load(t, pressure)[..., None])
        error = left.abs().amax((-1, -2)) / self.membrane.rest_area.sum().sqrt()
        return Equilibrium(x, pressure, self.membrane.volume(x), torch.zeros_like(x), error)

    def _newton_step(self, state: "_State", t: Tensor, pressure: Tensor):
        rise, v = state.rise(t)
        K = self.energy.stiffness_along(state.surface(t), state.directions)
        solved = conjugate_gradient(
            lambda y: self._stiffness_product(K, y, state.stiff),
            lambda y: symmetric_product(self.inverse, y),
            torch.stack([state.load(t, pressure), v], -1),
            self.solver_steps,
        )
        y, g = solved.unbind(-1)
        if self.cavity.filling == "open":
            return t + y, pressure
        minimum = constrained_minimum(y, g, v, *self.cavity.condition(rise, pressure))
        return t + minimum.y, pressure - minimum.multiplier


def grid_laplacian(psi: Tensor, grid: tuple[int, int]) -> Tensor:
    """S of eq. 28 for `psi [..., V, C]` (symmetric): every vertex against its neighbours along the grid's lines."""
    ring = torch.tensor([[2.0, -1, 0, -1], [-1, 2, -1, 0], [0, -1, 2, -1], [-1, 0, -1, 2]], dtype=psi.dtype, device=psi.device)
    return 0.5 * corners_to_vertices(ring @ corners(psi, grid), grid)


class _State:
    """One call's rays, and what depends on the ranges `t [..., V]` along them."""

    def __init__(self, estimator: MinimumEnergy, origins: Tensor, directions: Tensor, relaxed: Tensor | None = None):
        self.estimator, self.origins, self.directions = estimator, origins, directions
        self.stiff = 1.0 if relaxed is None else (~relaxed)[..., None].to(directions)
        self.start = self._exact_rise(estimator.rest_range.expand(directions.shape[:-1]))

    def surface(self, t: Tensor) -> Tensor:
        membrane = self.estimator.membrane
        return torch.where(membrane.fixed[:, None], membrane.rest, self.origins + t[..., None] * self.directions)

    def _exact_rise(self, t: Tensor) -> tuple[Tensor, Tensor]:
        membrane, x = self.estimator.membrane, self.surface(t)
        v = self.estimator.moves * (membrane.volume_gradient(x) * self.directions).sum(-1)
        return membrane.volume(x) - membrane.rest_volume, v

    def rise(self, t: Tensor) -> tuple[Tensor, Tensor]:
        """Volume above that at rest `[...]` and its derivative `v [..., V]`: exact, or linear about the rest ranges."""
        if self.estimator.volume_constraint == "exact":
            return self._exact_rise(t)
        rise, v = self.start
        return rise + (v * (t - self.estimator.rest_range)).sum(-1), v

    def load(self, t: Tensor, pressure: Tensor) -> Tensor:
        """Force along the rays that no equilibrium balances, `[..., V]`: zero at the solution (eq. 25)."""
        estimator, x = self.estimator, self.surface(t)
        force = ((estimator.energy.gradient(x) - estimator.rest_load) * self.directions).sum(-1)
        psi = (estimator.moves * (t - estimator.rest_range))[..., None]
        smooth = estimator.smoothing * estimator._smoother(self.stiff * estimator._smoother(psi)).squeeze(-1)
        return estimator.moves * (pressure[..., None] * self.rise(t)[1] - force - smooth)
