"""The paper's complete estimator: flow, local affine maps, Q, smoother, linear volume, KKT, contact segmentation.

    flow at the grid          bilinear between the dots (section 5)
    local affine maps         one per quadrilateral, with precomputed `G^-1` (eqs. 15-17)
    Q                         their weighted entries, linear in the ranges: energy `1/2 |Q psi - gamma|^2` (eqs. 14, 18)
    smoother                  `s/2 |S psi|^2` (eq. 28), `psi = t - t_rest`, omitted in contacts
    volume                    linear, `v.psi = c` (eq. 21)
    solution                  of eq. 22 by the KKT system of eqs. 25-27: two solves with one factor of `Q^T Q + s S^T S`
    contacts                  eq. 29, then reconstruct, segment along the normals, reconstruct (section 5.1)

The unknowns are the ranges of the grid's vertices along their rays, so that no part of the harmonic energy is neglected.
"""

from dataclasses import dataclass
from typing import ClassVar, NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from ...camera.model import Rays
from ...control_flow import traced
from ...errors import MembraneError
from ...mechanics.affine_quadrilateral import AffineQuadrilaterals
from ...mechanics.hyperelastic import ElasticEnergy
from ...solve.grid_system import GridSystem
from ...solve.kkt import constrained_minimum
from ...solve.stencil import inner, pad_border
from ...surface.membrane import Membrane
from ...surface.topology import corners, corners_to_vertices
from ...torch_modes import on_cpu
from ..base import Equilibrium, Observation, Problem
from ..minimum_energy.flow import FlowInterpolation, VertexFlow
from ..minimum_energy.segmentation import ContactRegions
from ..minimum_energy.vertex_rays import VertexRays
from .bilinear import BilinearFlow

OCCUPIED = 1e-3  # weight of quadrilaterals entirely in contact, if only the energy of the free part counts
FLOWS = {"smooth": FlowInterpolation, "bilinear": BilinearFlow}
CONVERGED = 0.01  # largest motion of a converged frame's contacts in the last round, relative to the surface's size


class QuadraticProgramme(NamedTuple):
    """Eq. 22 on the inner vertices: minimise `1/2 |Q psi - gamma|^2 + s/2 |S psi|^2 - h.psi` subject to `v.psi = c`.

    q         `[B, m-1, n-1, 6, 4]`, rows of Q of every quadrilateral (eq. 18) for the ranges of its four corners
    stencil   `[B, 13, N]`, `Q^T Q + s S^T S` in the format of `GridSystem`
    load      `[B, N]`, `Q^T gamma + h + p0 v`, including the rest load and the rest pressure
    v         `[B, N]`, derivative of the volume (eq. 21)
    rise      `[B]`, volume at the rest ranges minus that at rest: `-c` for a liquid
    """

    q: Tensor
    stencil: Tensor
    load: Tensor
    v: Tensor
    rise: Tensor


class Segmented(NamedTuple):
    """Result of the loop of section 5.1.

    Attributes:
        surface: the last surface.
        contacts: contacts of the last surface.
        first: contacts by eq. 29 alone.
        moved: largest motion of a contact in the last round, relative to the surface's size, `[B]`; infinite if a contact
            appeared or disappeared.
    """

    surface: Equilibrium
    contacts: ContactRegions
    first: ContactRegions
    moved: Tensor


@dataclass(frozen=True)
class PaperSettings:
    """Settings of `PaperEstimator`.

    Args:
        smoothing: weight s of `s |S psi|^2` (eq. 28) relative to the rest tension.
        flow: interpolation of the flow between the dots: "bilinear" (section 5) or "smooth".
        rounds: number of rounds of the reconstruct / segment loop (section 5.1).
        free_part_only: whether to count the energy of the free part of the membrane only (section 2, item 1): quadrilaterals
            entirely in contact get a very small weight.

    Raises:
        MembraneError: the flow is unknown, the weight is not positive, or the number of rounds is less than 1.

    Example:
        >>> PaperSettings(rounds=1).smoothing
        0.1
    """

    smoothing: float = 0.1
    flow: str = "bilinear"
    rounds: int = 2
    free_part_only: bool = False

    def __post_init__(self) -> None:
        if self.flow not in FLOWS:
            raise MembraneError(f"PaperSettings: flow = {self.flow!r}; expected one of {', '.join(FLOWS)}")
        if not self.smoothing > 0:
            raise MembraneError(
                f"PaperSettings: smoothing = {self.smoothing}; expected more than 0: the element has no hourglass stiffness"
            )
        if self.rounds < 1:
            raise MembraneError(f"PaperSettings: rounds = {self.rounds}; expected at least 1")


@on_cpu
class PaperEstimator(VertexRays):
    """Finds the surface with the least harmonic energy at the linearised volume, and its contacts (eqs. 14-29, section 5.1).

    Args:
        membrane: the rest surface on the solver's grid.
        elasticity: elastic energy of the membrane; only its rest tension is used.
        rest_rays: origins and unit directions of the rest rays, `[V, 3]`.
        filling: filling of the cavity, as for `CavityLaw`.
        gas: absolute pressure and volume of a gas at rest.
        settings: settings of smoother, flow and rounds.
        flow: interpolates the markers' pixels to the vertices of the grid; only `prepare` needs it.

    Limitations:
        Like `MinimumEnergy`, it assumes that no force acts along the rays. It finds the location of a press by a hard object,
        but only a part of its depth; on the optical axis it finds almost no depth, and reports a disc around the axis.
    """

    Settings: ClassVar[type[PaperSettings]] = PaperSettings
    default_locator: ClassVar[str] = "soft"
    settings: PaperSettings
    energy: AffineQuadrilaterals

    def __init__(
        self,
        membrane: Membrane,
        elasticity: ElasticEnergy,
        rest_rays: Rays | tuple[Tensor, Tensor],
        filling: str = "liquid",
        gas: tuple[float, float] | None = None,
        settings: PaperSettings | None = None,
        flow: VertexFlow | None = None,
    ):
        energy = AffineQuadrilaterals(membrane, elasticity.tension)
        super().__init__(membrane, energy, rest_rays, filling, gas, flow)
        self.settings, self.elasticity = settings or PaperSettings(), elasticity
        self.system = GridSystem(membrane.grid, inner(self.free[:, None], membrane.grid).squeeze(-1) > 0)

    @classmethod
    def interpolation(cls, problem: Problem, settings: PaperSettings) -> FlowInterpolation:
        """Return the interpolation of the flow between the sensor's markers."""
        flow: FlowInterpolation = FLOWS[settings.flow](problem.membrane, problem.markers)
        return flow

    @property
    def flow_kind(self) -> str:
        """Name of the flow interpolation between the markers: "bilinear" or "smooth"."""
        return self.settings.flow

    @property
    def element(self) -> str:
        """Name of the paper's finite element."""
        return "quadrilateral"

    @property
    def volume(self) -> str:
        """Name of the volume constraint, which is linearised once, at the rest ranges (eq. 21)."""
        return "linear"

    def forward(self, observation: Observation) -> Equilibrium:
        """Reconstruct the surface from the rays of the grid's vertices.

        Args:
            observation: measured rays of all vertices, `[B, V, 3]`.
        """
        found = self.reconstruct_and_segment(observation, self.settings.rounds)
        return found.surface._replace(relative_step=found.moved)

    def reconstruct_and_segment(self, observation: Observation, rounds: int) -> Segmented:
        """Run the loop of section 5.1 a fixed number of times.

        The first contacts are the regions that bulge inwards by eq. 29, or the axis if the flow diverges everywhere. Each round
        reconstructs the surface with the smoother relaxed in the contacts, and segments the displacement along its normals.

        Args:
            observation: measured rays of the grid's vertices, `[B, V, 3]`.
            rounds: number of rounds, at least 1.
        """
        segmentation = self.segmentation
        first = before = contacts = segmentation.by_polar_angle(observation.directions)
        for _ in range(rounds):
            surface = self.solve(observation, segmentation.in_contact(contacts.region))
            before, contacts = contacts, segmentation.by_normals(surface.vertices)
        return Segmented(surface, contacts, first, segmentation.moved(before.points, contacts.points))

    @traced
    def solve(self, observation: Observation, relaxed: Tensor) -> Equilibrium:
        """Solve eq. 22 once, by two solves with one factor (eqs. 25-27).

        Args:
            observation: measured rays of all vertices, `[B, V, 3]`.
            relaxed: which vertices are in contact, `[B, V]` bool; they are not smoothed, because the slope may jump there.
        """
        programme, rays = self.programme(observation, relaxed)
        loads = torch.stack([programme.load, programme.v], 1)
        y, g = self.system.substitute(self.system.factor(programme.stencil), loads).unbind(1)
        psi, pressure = y, self.rest_pressure.expand(programme.rise.shape)
        if self.cavity.filling != "open":
            condition = self.cavity.condition(programme.rise, self.rest_pressure)
            psi, multiplier = constrained_minimum(y, g, programme.v, *condition)
            pressure = self.rest_pressure - multiplier
        t = self.rest_range + pad_border(psi[..., None], self.membrane.grid).squeeze(-1)
        x = rays[0] + t[..., None] * rays[1]
        return Equilibrium.without_tractions(x, pressure, self.membrane.volume(x), torch.zeros_like(pressure))

    def programme(self, observation: Observation, relaxed: Tensor) -> tuple[QuadraticProgramme, tuple[Tensor, Tensor]]:
        """Return eq. 22 for these rays, and the rays with zero directions at fixed vertices, so that the rim does not move."""
        membrane, grid, free = self.membrane, self.membrane.grid, self.free[:, None]
        directions = observation.directions * free
        origins = torch.where(free > 0, observation.origins, membrane.rest)
        start = origins + self.rest_range[:, None] * directions
        weight, rest_load = None, self.rest_load
        if self.settings.free_part_only:
            weight = torch.where(_corner_values(relaxed.to(start.dtype), grid).amin(-1) > 0, OCCUPIED, 1.0)
            rest_load = rest_load + self.energy.gradient(membrane.rest, weight) - self.energy.gradient(membrane.rest)
        q = self.energy.q_blocks(directions, weight)
        stencil = _quadrilaterals_stencil(q.mT @ q, grid)
        stencil = stencil + self.settings.smoothing * self.elasticity.tension * _smoother_stencil(relaxed, grid, self.free)
        of_fluid = membrane.volume_gradient(start)
        v, rise = (of_fluid * directions).sum(-1), (of_fluid * start).sum((-1, -2)) / 3 - membrane.rest_volume
        load = self.rest_pressure * v + ((rest_load - self.energy.gradient(start, weight)) * directions).sum(-1)

        def within(field: Tensor) -> Tensor:
            return inner(field[..., None], grid).squeeze(-1)

        return QuadraticProgramme(q, stencil, within(load), within(v), rise), (origins, directions)

    def is_converged(self, found: Equilibrium) -> Tensor:
        """Return where the contacts did not move in the last round of the loop, `[B]` bool."""
        return found.relative_step <= CONVERGED


def _corner_values(field: Tensor, grid: tuple[int, int]) -> Tensor:
    """Return the values of a field `[B, V]` at the corners a, b, c, d of every quadrilateral, `[B, m-1, n-1, 4]`."""
    g = field.unflatten(-1, grid)
    return torch.stack([g[..., :-1, :-1], g[..., 1:, :-1], g[..., 1:, 1:], g[..., :-1, 1:]], -1)


def _quadrilaterals_stencil(K: Tensor, grid: tuple[int, int]) -> Tensor:
    """Sum corner matrices `[B, m-1, n-1, 4, 4]` to the stencil `[B, 13, N]` of the inner vertices."""
    a, b, c, d = range(4)
    at = {a: (0, 1, 0, 1), b: (0, 1, 1, 0), c: (1, 0, 1, 0), d: (1, 0, 0, 1)}  # pads that move a corner's value to its vertex

    def summed(*pairs: tuple[int, int]) -> Tensor:
        return torch.stack([F.pad(K[..., k, other], at[k]) for k, other in pairs]).sum(0)[:, 1:-1, 1:-1].flatten(1)

    none = torch.zeros_like(summed((a, a)))
    own, right = summed((a, a), (b, b), (c, c), (d, d)), summed((a, d), (b, c))
    below, below_left, below_right = summed((a, b), (d, c)), summed((d, b)), summed((a, c))
    return torch.stack([own, right, none, none, below_left, below, below_right, none, *[none] * 5], 1)


def _smoother_stencil(relaxed: Tensor, grid: tuple[int, int], free: Tensor) -> Tensor:
    """Return `S^T R S` as a stencil `[B, 13, N]`; `R` is 0 at `relaxed [B, V]` vertices, else 1, and S the grid's Laplacian."""
    m, n = grid
    kept = F.pad((~relaxed).to(free.dtype).unflatten(-1, grid), (1, 1, 1, 1))

    def at(i: int, j: int) -> Tensor:
        return kept[:, 2 + i : m + i, 2 + j : n + j].flatten(1)

    own = at(0, 0)
    sides = {side: at(*side) for side in ((0, 1), (1, 0), (0, -1), (-1, 0))}
    none = torch.zeros_like(own)
    return torch.stack(
        [
            16 * own + sides[0, 1] + sides[1, 0] + sides[0, -1] + sides[-1, 0],
            -4 * (own + sides[0, 1]),
            sides[0, 1],
            none,
            sides[1, 0] + sides[0, -1],
            -4 * (own + sides[1, 0]),
            sides[1, 0] + sides[0, 1],
            none,
            none,
            none,
            sides[1, 0],
            none,
            none,
        ],
        1,
    )


def grid_laplacian(psi: Tensor, grid: tuple[int, int]) -> Tensor:
    """Apply the symmetric S of eq. 28 to `psi [..., V, C]`: differences between every vertex and its four grid neighbours."""
    laplacian = torch.tensor(
        [[2.0, -1, 0, -1], [-1, 2, -1, 0], [0, -1, 2, -1], [-1, 0, -1, 2]], dtype=psi.dtype, device=psi.device
    )
    return 0.5 * corners_to_vertices(laplacian @ corners(psi, grid), grid)
