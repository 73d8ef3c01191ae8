"""The paper's estimator: of all surfaces on the observed rays, the one of least elastic energy at the fluid's volume.

One unknown for each free vertex, its position `t_k` along its ray, `x_k = o_k + t_k d_k`. For the harmonic energy
`E(t) = 1/2 t.K t - g.t` exactly, with `K = L o (R R^T)` (eqs. 14, 18, 64); for a hyperelastic sheet the same step is repeated.
"""

from typing import NamedTuple

import torch
from torch import Tensor, nn

from .energy import AffineQuadrilaterals, Sheet
from .errors import MembraneError
from .membrane import Membrane, corners, corners_to_vertices
from .solve.conjugate_gradient import conjugate_gradient, symmetric_product
from .solve.kkt import constrained_minimum

ELEMENTS = ("triangle", "quadrilateral")
FILLINGS = ("liquid", "gas", "open")
VOLUMES = ("exact", "linear")


class Equilibrium(NamedTuple):
    """`vertices [..., V, 3]`, pressure difference `[...]`, volume `[...]`, last step over the surface's size `[...]`."""

    vertices: Tensor
    pressure: Tensor
    volume: Tensor
    last_step: Tensor


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
        steps       Newton steps; 1 suffices for the harmonic energy with linear volume
        rest_rays   unit directions `[V, 3]` of the rest rays and their origins `[V, 3]`

    The rest load `h = grad U(X) - p0 grad V(X)` is subtracted, so that zero flow gives exactly zero displacement.
    Wrong where something pushes along the rays: minimum energy says that no force acts there. Features narrower than their
    distance to the camera are flattened.
    """

    def __init__(self, membrane: Membrane, sheet: Sheet, rest_rays, element="triangle", smoothing=0.0, filling="liquid",
                 gas: tuple[float, float] | None = None, volume="exact", steps=8, solver_steps=12):  # fmt: skip
        super().__init__()
        for name, value, known in (
            ("element", element, ELEMENTS),
            ("filling", filling, FILLINGS),
            ("volume", volume, VOLUMES),
        ):
            if value not in known:
                raise MembraneError(f"MinimumEnergy: {name} = {value!r}; expected one of {', '.join(known)}")
        if filling == "gas" and gas is None:
            raise MembraneError("MinimumEnergy: filling = 'gas' without gas = (pressure, volume); pass both")
        self.membrane, self.filling, self.volume_constraint = membrane, filling, volume
        self.steps, self.solver_steps = steps, solver_steps
        self.energy = sheet if element == "triangle" else AffineQuadrilaterals(membrane, sheet.tension)
        origins, directions = rest_rays
        self.register_buffer("rest_range", ((membrane.rest - origins) * directions).sum(-1))
        self.register_buffer("smoothing", sheet.tension * smoothing)
        self.register_buffer("gas", torch.tensor(gas if gas else (1.0, 1.0), dtype=torch.float64))
        force, push = self.energy.gradient(membrane.rest), membrane.volume_gradient(membrane.rest)
        normal, free = membrane.rest_normals, membrane.free
        p0 = (force * normal)[free].sum() / (push * normal)[free].sum()
        self.register_buffer("rest_pressure", p0)
        self.register_buffer("rest_load", force - p0 * push)
        self.register_buffer("moves", (~membrane.fixed).double())
        self.register_buffer("inverse", self._rest_inverse(directions))

    def _rest_inverse(self, directions: Tensor) -> Tensor:
        K = self.energy.stiffness_along(self.membrane.rest, directions)
        V, free = len(self.membrane.rest), self.membrane.free
        dense = self._stiffness_product(K, torch.eye(V, dtype=torch.float64))[free][:, free]
        inverse = torch.zeros(V, V, dtype=torch.float64)
        inverse[free[:, None], free] = torch.linalg.inv(dense)
        return inverse

    def _stiffness_product(self, K: Tensor, y: Tensor) -> Tensor:
        moves, grid = self.moves[:, None], self.membrane.grid
        product = corners_to_vertices(K @ corners(moves * y, grid), grid)
        return moves * (product + self.smoothing * self._smoother(self._smoother(moves * y)))

    def _smoother(self, psi: Tensor) -> Tensor:
        """Grid Laplacian `S` of eq. 28 (symmetric): every vertex against its neighbours along the grid's lines."""
        ring = torch.tensor(
            [[2.0, -1, 0, -1], [-1, 2, -1, 0], [0, -1, 2, -1], [-1, 0, -1, 2]], dtype=psi.dtype, device=psi.device
        )
        return 0.5 * corners_to_vertices(ring @ corners(psi, self.membrane.grid), self.membrane.grid)

    def forward(self, origins: Tensor, directions: Tensor) -> Equilibrium:
        """`origins`, `directions [..., V, 3]`: the ray of every grid vertex now. Returns the `Equilibrium`."""
        t = self.rest_range.expand(directions.shape[:-1])
        pressure = self.rest_pressure.expand(directions.shape[:-2])
        start = self._exact_rise(origins, directions, t)
        for _ in range(self.steps):
            if self.volume_constraint == "exact":
                rise, v = self._exact_rise(origins, directions, t)
            else:
                rise, v = start[0] + (start[1] * (t - self.rest_range)).sum(-1), start[1]
            t, pressure, step = self._newton_step(origins, directions, t, pressure, rise, v)
        x = self._surface(origins, directions, t)
        last = step.abs().amax(-1) / self.membrane.rest_area.sum().sqrt()
        return Equilibrium(x, pressure, self.membrane.volume(x), last)

    def _surface(self, origins: Tensor, directions: Tensor, t: Tensor) -> Tensor:
        return torch.where(self.membrane.fixed[:, None], self.membrane.rest, origins + t[..., None] * directions)

    def _exact_rise(self, origins, directions, t):
        """Volume above that at rest, and its derivative in `t`."""
        x = self._surface(origins, directions, t)
        v = self.moves * (self.membrane.volume_gradient(x) * directions).sum(-1)
        return self.membrane.volume(x) - self.membrane.rest_volume, v

    def _newton_step(self, origins, directions, t, pressure, rise, v):
        x = self._surface(origins, directions, t)
        force = ((self.energy.gradient(x) - self.rest_load) * directions).sum(-1)
        load = pressure[..., None] * v - self.moves * force
        psi = (self.moves * (t - self.rest_range))[..., None]
        load = load - self.smoothing * self.moves * self._smoother(self._smoother(psi)).squeeze(-1)
        K = self.energy.stiffness_along(x, directions)
        solved = conjugate_gradient(
            lambda y: self._stiffness_product(K, y),
            lambda y: symmetric_product(self.inverse, y),
            torch.stack([load, v], -1),
            self.solver_steps,
        )
        y, g = solved.unbind(-1)
        if self.filling == "open":
            return t + y, pressure, y
        target, compliance = self._volume_condition(rise, pressure)
        minimum = constrained_minimum(y, g, v, target, compliance)
        return t + minimum.y, pressure - minimum.multiplier, minimum.y

    def _volume_condition(self, rise: Tensor, pressure: Tensor):
        """Target `c` and compliance `C` of the step's volume, `v.y = c + C lambda` with `lambda = -(pressure step)`."""
        if self.filling == "liquid":
            return -rise, 0.0
        absolute, volume = self.gas.unbind()
        ratio = volume / (volume + rise)
        compliance = volume / (absolute * ratio**2)
        gas_pressure = self.rest_pressure + absolute * (ratio - 1)
        return compliance * (gas_pressure - pressure), compliance

    def target_volume(self, volume: Tensor, pressure: Tensor) -> Tensor:
        """The volume that the cavity's law asks for at this pressure, `[...]`."""
        if self.filling == "liquid":
            return self.membrane.rest_volume.expand(volume.shape)
        if self.filling == "open":
            return volume
        absolute, gas = self.gas.unbind()
        return self.membrane.rest_volume + gas * (absolute / (absolute + pressure - self.rest_pressure) - 1)
