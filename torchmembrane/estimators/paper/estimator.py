"""The paper's own estimator, whole: flow, local affine maps, Q, smoother, linear volume, KKT, contact segmentation.

    flow at the grid          bilinear between the dots (section 5)
    local affine maps         of every quadrilateral, with precomputed `G^-1` (eqs. 15-17)
    Q                         their weighted entries, linear in the ranges: energy `1/2 |Q psi - gamma|^2` (eqs. 14, 18)
    smoother                  `s/2 |S psi|^2` (eq. 28), `psi = t - t_rest`, left out where something touches
    volume                    linear, `v.psi = c` (eq. 21)
    solve                     eq. 22 by the KKT system of eqs. 25-27: two solves with one factor of `Q^T Q + s S^T S`
    contacts                  eq. 29, then reconstruct, segment along the normals, reconstruct (section 5.1)

The unknowns are the ranges of the grid's vertices along their rays, so that nothing of the energy is neglected; harmonic.
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
from ..base import Equilibrium, Observation, Problem
from ..minimum_energy.flow import FlowInterpolation, VertexFlow
from ..minimum_energy.segmentation import ContactRegions
from ..minimum_energy.vertex_rays import VertexRays
from .bilinear import BilinearFlow

OCCUPIED = 1e-3  # weight of a quadrilateral that lies wholly in a contact, where the energy is the free part's
FLOWS = {"smooth": FlowInterpolation, "bilinear": BilinearFlow}
CONVERGED = 0.01  # move of the contacts in the last round, over the surface's size, of a converged frame


class QuadraticProgramme(NamedTuple):
    """Eq. 22 on the inner vertices: minimise `1/2 |Q psi - gamma|^2 + s/2 |S psi|^2 - h.psi` subject to `v.psi = c`.

    q         `[B, m-1, n-1, 6, 4]`, Q's rows of every quadrilateral (eq. 18) in the ranges of its four corners
    stencil   `[B, 13, N]`, `Q^T Q + s S^T S` as `GridSystem` has it
    load      `[B, N]`, `Q^T gamma + h + p0 v`: the rest load and the rest pressure's share with it
    v         `[B, N]`, derivative of the volume (eq. 21)
    rise      `[B]`, the volume at the rest ranges above that at rest: `-c` of a liquid
    """

    q: Tensor
    stencil: Tensor
    load: Tensor
    v: Tensor
    rise: Tensor


class Segmented(NamedTuple):
    """What the loop of section 5.1 ends with: the last surface, its contacts, those of eq. 29 alone, and by how much the
    contacts moved in the last round, over the surface's size, `[B]` (infinite where one came or went)."""

    surface: Equilibrium
    contacts: ContactRegions
    first: ContactRegions
    moved: Tensor


@dataclass(frozen=True)
class PaperSettings:
    """Settings of `PaperEstimator`.

    Args:
        smoothing: weight s of `s |S psi|^2` (eq. 28) over the rest tension.
        flow: flow of the grid's vertices, "bilinear" between the dots (section 5), or "smooth".
        rounds: number of rounds of the reconstruct / segment loop (section 5.1).
        free_part_only: take the energy over the free part of the membrane only (section 2, item 1): quadrilaterals that lie
            wholly in a contact weigh next to nothing.

    Raises:
        MembraneError: an unknown flow, a weight that is not positive, no rounds.

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
                f"PaperSettings: smoothing = {self.smoothing}; expected more than 0: the element is blind to the hourglass mode"
            )
        if self.rounds < 1:
            raise MembraneError(f"PaperSettings: rounds = {self.rounds}; expected at least 1")


class PaperEstimator(VertexRays):
    """Surface of least harmonic energy on given rays at the linearised volume, and the contacts (eqs. 14-29, section 5.1).

    Args:
        membrane: the rest surface on the solver's grid.
        elasticity: of which the rest tension alone is used.
        rest_rays: origins and unit directions `[V, 3]` of the rest rays.
        filling: the cavity, as for `CavityLaw`.
        gas: a gas' absolute pressure at rest and its volume.
        settings: smoother, flow, rounds.
        flow: what carries the markers' pixels to the grid's vertices; `prepare` alone needs it.

    Limitations:
        As `MinimumEnergy`: no force is looked for along the rays, so of a press by something hard it finds where, and only a
        part of the depth. Of a press on the optical axis it finds next to none: the contact is then a disc around the axis.
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
        """The flow between the sensor's markers."""
        flow: FlowInterpolation = FLOWS[settings.flow](problem.membrane, problem.markers)
        return flow

    @property
    def flow_kind(self) -> str:
        """The flow between the markers: "bilinear" or "smooth"."""
        return self.settings.flow

    @property
    def element(self) -> str:
        """The paper's affine quadrilaterals."""
        return "quadrilateral"

    @property
    def volume(self) -> str:
        """Linearised once, at the rest ranges (eq. 21)."""
        return "linear"

    def forward(self, observation: Observation) -> Equilibrium:
        """The surface on the rays of the grid's vertices.

        Args:
            observation: the ray of every vertex now, `[B, V, 3]`.
        """
        found = self.reconstruct_and_segment(observation, self.settings.rounds)
        return found.surface._replace(relative_step=found.moved)

    def reconstruct_and_segment(self, observation: Observation, rounds: int) -> Segmented:
        """The loop of section 5.1, a fixed number of times.

        Regions that bulge in by eq. 29 (or the axis, where the flow diverges everywhere); then reconstruct with the smoother
        relaxed there, take the displacement along the surface's normals, and from it the regions.

        Args:
            observation: the rays of the grid's vertices, `[B, V, 3]`.
            rounds: how often, at least once.
        """
        segmentation = self.segmentation
        first = before = contacts = segmentation.by_polar_angle(observation.directions)
        for _ in range(rounds):
            surface = self.solve(observation, segmentation.in_contact(contacts.region))
            before, contacts = contacts, segmentation.by_normals(surface.vertices)
        return Segmented(surface, contacts, first, segmentation.moved(before.points, contacts.points))

    @traced
    def solve(self, observation: Observation, relaxed: Tensor) -> Equilibrium:
        """Eq. 22 once, by two solves with one factor (eqs. 25-27).

        Args:
            observation: the ray of every vertex now, `[B, V, 3]`.
            relaxed: `[B, V]` bool, vertices in contact, where the slope may jump: the smoother leaves them alone.
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
        """Eq. 22 of these rays, and the rays on which the rim stays: direction 0."""
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
        """`[B]` bool: in the last round of the loop the contacts stayed."""
        return found.relative_step <= CONVERGED


def _corner_values(field: Tensor, grid: tuple[int, int]) -> Tensor:
    """`[B, V]` at the corners a, b, c, d of every quadrilateral, `[B, m-1, n-1, 4]`."""
    g = field.unflatten(-1, grid)
    return torch.stack([g[..., :-1, :-1], g[..., 1:, :-1], g[..., 1:, 1:], g[..., :-1, 1:]], -1)


def _quadrilaterals_stencil(K: Tensor, grid: tuple[int, int]) -> Tensor:
    """Corner matrices `[B, m-1, n-1, 4, 4]` summed to the stencil `[B, 13, N]` of the inner vertices."""
    a, b, c, d = range(4)
    at = {a: (0, 1, 0, 1), b: (0, 1, 1, 0), c: (1, 0, 1, 0), d: (1, 0, 0, 1)}  # pads that put a corner's value at its vertex

    def summed(*pairs: tuple[int, int]) -> Tensor:
        return torch.stack([F.pad(K[..., k, other], at[k]) for k, other in pairs]).sum(0)[:, 1:-1, 1:-1].flatten(1)

    none = torch.zeros_like(summed((a, a)))
    own, right = summed((a, a), (b, b), (c, c), (d, d)), summed((a, d), (b, c))
    below, below_left, below_right = summed((a, b), (d, c)), summed((d, b)), summed((a, c))
    return torch.stack([own, right, none, none, below_left, below, below_right, none, *[none] * 5], 1)


def _smoother_stencil(relaxed: Tensor, grid: tuple[int, int], free: Tensor) -> Tensor:
    """`S^T R S` as a stencil `[B, 13, N]`, `R` 0 at `relaxed [B, V]` vertices, else 1; S is the grid's Laplacian (4, -1)."""
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
    """S of eq. 28 for `psi [..., V, C]` (symmetric): every vertex against its neighbours along the grid's lines."""
    laplacian = torch.tensor(
        [[2.0, -1, 0, -1], [-1, 2, -1, 0], [0, -1, 2, -1], [-1, 0, -1, 2]], dtype=psi.dtype, device=psi.device
    )
    return 0.5 * corners_to_vertices(laplacian @ corners(psi, grid), grid)
