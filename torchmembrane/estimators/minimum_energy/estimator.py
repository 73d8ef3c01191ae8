"""The paper's estimator: of all surfaces on the observed rays, the one of least elastic energy at the fluid's volume.

One unknown for each free vertex, its position `t_k` along its ray, `x_k = o_k + t_k d_k`. For the harmonic energy
`E(t) = 1/2 t.K t - g.t` exactly, with `K = L o (R R^T)` (eqs. 14, 18, 64); for a hyperelastic one the same step is repeated.
"""

from dataclasses import dataclass
from typing import ClassVar

import torch
import torch.nn.functional as F
from torch import Tensor

from ...camera.model import Rays
from ...control_flow import traced
from ...errors import MembraneError
from ...mechanics.affine_quadrilateral import AffineQuadrilaterals
from ...mechanics.hyperelastic import ElasticEnergy
from ...solve.anderson import accelerated, first
from ...solve.kkt import constrained_minimum
from ...surface.membrane import Membrane
from ...surface.topology import corners, corners_to_vertices
from ..base import Equilibrium, Observation
from .flow import FLOWS, VertexFlow
from .vertex_rays import VertexRays

ELEMENTS = ("triangle", "quadrilateral")
VOLUMES = ("exact", "linear")
CONVERGED = 1e-5  # largest relative step, and volume error where the volume is exact, of a converged surface

State = tuple[Tensor, Tensor, Tensor]


@dataclass(frozen=True)
class MinimumEnergySettings:
    """Settings of `MinimumEnergy`.

    Args:
        element: "triangle" (linear), or "quadrilateral": the paper's affine quadrilaterals, harmonic.
        smoothing: weight s of `s |S psi|^2`, `psi = t - t_rest` (eq. 28), over the rest tension; S is the grid's Laplacian.
            Default: 0.1 for quadrilaterals, else none.
        volume: "exact", or "linear": linearised once, at the rest ranges (eq. 21).
        flow: of the grid's vertices, "smooth", or "bilinear" between the dots (section 5).
        steps: of the solve.
        linear_steps: of the solve of a linear problem: a harmonic material, the volume linear, no gas.
        relaxed_steps: of the solve where the smoother is relaxed, which the constant inverse knows nothing of.

    Raises:
        MembraneError: a value that is none of these.

    Example:
        >>> MinimumEnergySettings(element="quadrilateral").weight_of_smoother
        0.1
    """

    element: str = "triangle"
    smoothing: float | None = None
    volume: str = "exact"
    flow: str = "smooth"
    steps: int = 10
    linear_steps: int = 4
    relaxed_steps: int = 60

    def __post_init__(self) -> None:
        for name, known in (("element", ELEMENTS), ("volume", VOLUMES), ("flow", FLOWS)):
            if getattr(self, name) not in known:
                value = getattr(self, name)
                raise MembraneError(f"MinimumEnergySettings: {name} = {value!r}; expected one of {', '.join(known)}")

    @property
    def weight_of_smoother(self) -> float:
        """`smoothing`, or its default."""
        return (0.1 if self.element == "quadrilateral" else 0.0) if self.smoothing is None else self.smoothing


class MinimumEnergy(VertexRays):
    """Surface of least energy on given rays (eqs. 18, 22, 28).

    Args:
        membrane: the rest surface on the solver's grid.
        elasticity: its material; of the paper's quadrilaterals only the rest tension is used.
        rest_rays: origins and unit directions `[V, 3]` of the rest rays.
        filling: the cavity, as for `CavityLaw`.
        gas: a gas' absolute pressure at rest and its volume.
        settings: element, smoother, volume constraint, steps.
        flow: what carries the markers' pixels to the grid's vertices; `prepare` alone needs it.

    Limitations:
        Minimum energy says that no force acts along the rays: where something pushes along them it is wrong, and features
        narrower than their distance to the camera are flattened.
    """

    Settings: ClassVar[type[MinimumEnergySettings]] = MinimumEnergySettings
    settings: MinimumEnergySettings
    smoothing: Tensor
    inverse: Tensor

    def __init__(
        self,
        membrane: Membrane,
        elasticity: ElasticEnergy,
        rest_rays: Rays | tuple[Tensor, Tensor],
        filling: str = "liquid",
        gas: tuple[float, float] | None = None,
        settings: MinimumEnergySettings | None = None,
        flow: VertexFlow | None = None,
    ):
        settings = settings or MinimumEnergySettings()
        triangles = settings.element == "triangle"
        energy = elasticity if triangles else AffineQuadrilaterals(membrane, elasticity.tension)
        super().__init__(membrane, energy, rest_rays, filling, gas, flow)
        harmonic = not triangles or elasticity.model == "harmonic"
        linear = harmonic and settings.volume == "linear" and filling != "gas"
        self.settings, self.elasticity = settings, elasticity
        self.steps = settings.linear_steps if linear else settings.steps
        self.smooths = settings.weight_of_smoother > 0
        self.register_buffer("smoothing", elasticity.tension * settings.weight_of_smoother)
        self.register_buffer("inverse", self._rest_inverse(rest_rays[1]))

    @property
    def element(self) -> str:
        """The finite element: "triangle" or "quadrilateral"."""
        return self.settings.element

    @property
    def volume(self) -> str:
        """The volume's constraint: "exact" or "linear"."""
        return self.settings.volume

    @property
    def smoothing_weight(self) -> float:
        """The weight of the smoother of eq. 28."""
        return self.settings.weight_of_smoother

    def is_converged(self, found: Equilibrium) -> Tensor:
        """`[B]` bool: no step is left and, where the constraint is exact, the volume is what the cavity's law asks for."""
        converged = ~(found.relative_step > CONVERGED)
        if self.settings.volume == "linear":
            return converged
        return converged & ~(self.cavity.volume_error(found.volume, found.pressure).abs() > CONVERGED)

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

    def forward(self, observation: Observation) -> Equilibrium:
        """The surface on the rays of the grid's vertices.

        Args:
            observation: the ray of every vertex now, `[..., V, 3]`.
        """
        return self.solve(observation)

    def solve(self, observation: Observation, relaxed: Tensor | None = None) -> Equilibrium:
        """The surface; `relaxed [..., V]` bool: vertices in contact, where the slope may jump: the smoother of eq. 28 leaves
        them alone."""
        origins, directions, *linear = self.rays(observation.origins, observation.directions)
        t, latest, changes = self.start(origins, directions, relaxed, *linear)
        for _ in range((self.steps if relaxed is None else self.settings.relaxed_steps) - 1):
            t, latest, changes = self.step(t, latest, changes, origins, directions, relaxed, *linear)
        return self.equilibrium(t, origins, directions, relaxed, *linear)

    @traced
    def rays(self, origins: Tensor, directions: Tensor) -> tuple[Tensor, ...]:
        """Rays `[..., 3, V]` on which the rim stays: `d = 0`; where the volume is linear also its derivative `v [..., V]`, and
        by how much it is above that at rest at the rest ranges `[...]`."""
        fixed = self.membrane.fixed
        origins = torch.where(fixed, self.membrane.rest.mT, origins.mT).contiguous()
        directions = torch.where(fixed, 0.0, directions.mT).contiguous()
        if self.settings.volume == "exact":
            return origins, directions
        return origins, directions, *self._volume(origins + self.rest_range * directions, directions)

    @traced
    def start(self, origins: Tensor, directions: Tensor, relaxed: Tensor | None = None, *linear: Tensor) -> State:
        """Ranges `[..., V]` and history after the first step, from rest, on rays as `rays` gives them."""
        t = self.rest_range.expand(directions[..., 0, :].shape)
        return first(t, self._move(t, origins, directions, relaxed, *linear)[0])

    @traced
    def step(
        self,
        t: Tensor,
        latest: Tensor,
        changes: Tensor,
        origins: Tensor,
        directions: Tensor,
        relaxed: Tensor | None = None,
        *linear: Tensor,
    ) -> State:
        """One step in the ranges `t [..., V]`; `latest` and `changes` as `accelerated` has them."""
        move, _ = self._move(t, origins, directions, relaxed, *linear)
        return accelerated(t, move, latest, changes)

    @traced
    def equilibrium(
        self, t: Tensor, origins: Tensor, directions: Tensor, relaxed: Tensor | None = None, *linear: Tensor
    ) -> Equilibrium:
        """What these ranges amount to, and how far they are from a solution."""
        x = (origins + t[..., None, :] * directions).mT
        move, pressure = self._move(t, origins, directions, relaxed, *linear)
        error = move.abs().amax(-1) / self.membrane.size
        return Equilibrium.without_tractions(x, pressure, self.membrane.volume(x), error)

    def _move(
        self, t: Tensor, origins: Tensor, directions: Tensor, relaxed: Tensor | None, *linear: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Where the rest's stiffness would have the ranges go, `[..., V]`: zero at the solution; and the pressure `[...]`."""
        x = origins + t[..., None, :] * directions
        if linear:
            v, rise = linear
            rise = rise + (v * (t - self.rest_range)).sum(-1)
        else:
            v, rise = self._volume(x, directions)
        load = self.rest_pressure * v + ((self.rest_load - self.energy.gradient(x.mT)).mT * directions).sum(-2)
        if self.smooths:
            load = load - self._smoothing_force(t, relaxed)
        y, g = F.linear(torch.stack([load, v], -2), self.inverse).unbind(-2)
        if self.cavity.filling == "open":
            return y, self.rest_pressure.expand(rise.shape)
        minimum = constrained_minimum(y, g, v, *self.cavity.condition(rise, self.rest_pressure))
        return minimum.y, self.rest_pressure - minimum.multiplier

    def _volume(self, x: Tensor, directions: Tensor) -> tuple[Tensor, Tensor]:
        """The volume's derivative `v [..., V]` along the rays at `x [..., 3, V]`, and its rise above that at rest `[...]`."""
        gradient = self.membrane.volume_gradient(x.mT).mT
        return (gradient * directions).sum(-2), (gradient * x).sum((-1, -2)) / 3 - self.membrane.rest_volume

    def _smoothing_force(self, t: Tensor, relaxed: Tensor | None) -> Tensor:
        bend = self._smoother((self.free * (t - self.rest_range))[..., None])
        if relaxed is not None:
            bend = torch.where(relaxed[..., None], 0.0, bend)
        return self.smoothing * self.free * self._smoother(bend).squeeze(-1)


def grid_laplacian(psi: Tensor, grid: tuple[int, int]) -> Tensor:
    """S of eq. 28 for `psi [..., V, C]` (symmetric): every vertex against its neighbours along the grid's lines."""
    laplacian = torch.tensor(
        [[2.0, -1, 0, -1], [-1, 2, -1, 0], [0, -1, 2, -1], [-1, 0, -1, 2]], dtype=psi.dtype, device=psi.device
    )
    return 0.5 * corners_to_vertices(laplacian @ corners(psi, grid), grid)
