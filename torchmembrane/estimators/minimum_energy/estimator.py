"""Minimum energy: of all surfaces on the observed rays, the one with the least elastic energy at the fluid's volume.

Every free vertex has one unknown, its range `t_k` along its ray, `x_k = o_k + t_k d_k`. Because the stiffness at rest is close
to that of every frame, the solver repeats the same step with the inverse of the rest stiffness (eqs. 14, 18, 22) until no force
is left along the rays.
"""

from dataclasses import dataclass
from typing import ClassVar

import torch
import torch.nn.functional as F
from torch import Tensor

from ...camera.model import Rays
from ...control_flow import traced
from ...errors import MembraneError
from ...mechanics.hyperelastic import ElasticEnergy
from ...solve.anderson import accelerated, first
from ...solve.kkt import constrained_minimum
from ...surface.membrane import Membrane
from ...surface.topology import corners, corners_to_vertices
from ...torch_modes import on_cpu
from ..base import Equilibrium, Observation
from .flow import VertexFlow
from .vertex_rays import VertexRays

CONVERGED = 1e-5  # largest relative step and volume error of a converged surface

State = tuple[Tensor, Tensor, Tensor]


@dataclass(frozen=True)
class MinimumEnergySettings:
    """Settings of `MinimumEnergy`.

    Args:
        steps: number of steps of the solver.

    Raises:
        MembraneError: the number of steps is less than 1.

    Example:
        >>> MinimumEnergySettings().steps
        10
    """

    steps: int = 10

    def __post_init__(self) -> None:
        if self.steps < 1:
            raise MembraneError(f"MinimumEnergySettings: steps = {self.steps}; expected at least 1")


@on_cpu
class MinimumEnergy(VertexRays):
    """Finds the surface with the least energy on given rays that satisfies the cavity's law (eqs. 18, 22).

    Args:
        membrane: the rest surface on the solver's grid.
        elasticity: elastic energy of the membrane.
        rest_rays: origins and unit directions of the rest rays, `[V, 3]`.
        filling: filling of the cavity, as for `CavityLaw`.
        gas: absolute pressure and volume of a gas at rest.
        settings: settings with the number of steps.
        flow: interpolates the markers' pixels to the vertices of the grid; only `prepare` needs it.

    Limitations:
        Minimum energy assumes that no force acts along the rays. It is wrong where an object pushes along them, and flattens
        features that are narrower than their distance to the camera.
    """

    element: ClassVar[str] = "triangle"
    volume: ClassVar[str] = "exact"
    flow_kind: ClassVar[str] = "smooth"
    smoothing_weight: ClassVar[float] = 0.0
    Settings: ClassVar[type[MinimumEnergySettings]] = MinimumEnergySettings
    settings: MinimumEnergySettings
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
        super().__init__(membrane, elasticity, rest_rays, filling, gas, flow)
        self.settings, self.elasticity = settings or MinimumEnergySettings(), elasticity
        self.steps = self.settings.steps
        self.register_buffer("inverse", self._rest_inverse(rest_rays[1]))

    def is_converged(self, found: Equilibrium) -> Tensor:
        """Return where the next step would be negligible and the volume fulfils the cavity's law, `[B]` bool."""
        volume_error = self.cavity.volume_error(found.volume, found.pressure)
        return ~(found.relative_step > CONVERGED) & ~(volume_error.abs() > CONVERGED)

    def _rest_inverse(self, directions: Tensor) -> Tensor:
        K = self.energy.stiffness_along(self.membrane.rest, directions)
        V, free, grid = len(self.membrane.rest), self.membrane.free_vertices, self.membrane.grid
        one = torch.eye(V, dtype=torch.float64)
        dense = corners_to_vertices(K @ corners(one, grid), grid)[free][:, free]
        inverse = torch.zeros(V, V, dtype=torch.float64)
        inverse[free[:, None], free] = torch.linalg.inv(dense)
        return inverse

    def forward(self, observation: Observation) -> Equilibrium:
        """Reconstruct the surface from the rays of the grid's vertices.

        Args:
            observation: measured rays of all vertices, `[..., V, 3]`.
        """
        origins, directions = self.rays(observation.origins, observation.directions)
        t, latest, changes = self.start(origins, directions)
        for _ in range(self.steps - 1):
            t, latest, changes = self.step(t, latest, changes, origins, directions)
        return self.equilibrium(t, origins, directions)

    @traced
    def rays(self, origins: Tensor, directions: Tensor) -> tuple[Tensor, Tensor]:
        """Return the rays `[..., 3, V]`, with zero directions for fixed vertices, so that the rim does not move."""
        fixed = self.membrane.fixed
        origins = torch.where(fixed, self.membrane.rest.mT, origins.mT).contiguous()
        directions = torch.where(fixed, 0.0, directions.mT).contiguous()
        return origins, directions

    @traced
    def start(self, origins: Tensor, directions: Tensor) -> State:
        """Return the ranges `[..., V]` and the history after the first step from rest, on rays from `rays`."""
        t = self.rest_range.expand(directions[..., 0, :].shape)
        return first(t, self._move(t, origins, directions)[0])

    @traced
    def step(self, t: Tensor, latest: Tensor, changes: Tensor, origins: Tensor, directions: Tensor) -> State:
        """Take one step in the ranges `t [..., V]`; `latest` and `changes` are as for `accelerated`."""
        move, _ = self._move(t, origins, directions)
        return accelerated(t, move, latest, changes)

    @traced
    def equilibrium(self, t: Tensor, origins: Tensor, directions: Tensor) -> Equilibrium:
        """Return the solution with these ranges, and the length of the next step."""
        x = (origins + t[..., None, :] * directions).mT
        move, pressure = self._move(t, origins, directions)
        error = move.abs().amax(-1) / self.membrane.size
        return Equilibrium.without_tractions(x, pressure, self.membrane.volume(x), error)

    def _move(self, t: Tensor, origins: Tensor, directions: Tensor) -> tuple[Tensor, Tensor]:
        """Return the step of the ranges with the rest stiffness, `[..., V]`, zero at the solution, and the pressure `[...]`."""
        x = origins + t[..., None, :] * directions
        v, rise = self._volume(x, directions)
        load = self.rest_pressure * v + ((self.rest_load - self.energy.gradient(x.mT)).mT * directions).sum(-2)
        y, g = F.linear(torch.stack([load, v], -2), self.inverse).unbind(-2)
        if self.cavity.filling == "open":
            return y, self.rest_pressure.expand(rise.shape)
        minimum = constrained_minimum(y, g, v, *self.cavity.condition(rise, self.rest_pressure))
        return minimum.y, self.rest_pressure - minimum.multiplier

    def _volume(self, x: Tensor, directions: Tensor) -> tuple[Tensor, Tensor]:
        """Return the volume's derivative along the rays, `[..., V]`, at `x [..., 3, V]`, and its increase from rest,
        `[...]`."""
        gradient = self.membrane.volume_gradient(x.mT).mT
        return (gradient * directions).sum(-2), (gradient * x).sum((-1, -2)) / 3 - self.membrane.rest_volume
