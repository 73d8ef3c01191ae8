"""How far off a result's force and depth may be: the markers' noise spread by the equations, and the model's own error.

A small change of the markers changes the force and the depth by their sensitivities, which the transposed equations give: one
solve for each wanted number, not for each marker,

    K y = g,    spread^2 = sum_d |w_d (J_d y - K_d T^-1 B y)|^2

with `g` the wanted number's derivative in surface and pressure and the symmetric `K` of `covariance`. On the estimator's second
finest grid, which costs little and knows as much. Every marker's noise is what the solve took it for, with a share of the
displacements in it for the grid and the material; but these err together over many markers, so the spread is too small. What is
missing was fitted to presses of random sensors (`bench/intervals.py`), as standard deviations that add up:

    of the force    FORCE x spread,  FORCE_SHARE of the force along itself,  AT_RIM of it where a contact reaches the rim,
                    where no contact is found UNSEEN of what a patch as pushed as the noise pushes would bear
    of the depth    spread,  DEPTH sqrt(spread gap),  DIP gap (gap + 2 depth) / size

with `gap` the distance to the markers around the deepest point. What lies between them is not seen: it may dip as much further
as the surface's curvature and the dent's make of `gap`. The mean of spread and gap has no such reason: it is what fits.
"""

import torch
from torch import Tensor

from ..mechanics.cavity import CavityLaw
from ..solve.kkt import solve_bordered
from ..surface.membrane import Membrane
from ..surface.stencil import inner
from .base import Contacts, Deviations, Observation
from .bearings import Bearings
from .covariance import LinearisedSolution, linearise
from .descent import Descent, State
from .normal_equations import BalanceEquations, NormalEquations
from .settings import ForceBalanceSettings

FORCE, FORCE_SHARE, AT_RIM, UNSEEN = 0.85, 0.026, 0.12, 0.002
DEPTH, DIP = 0.43, 0.23
AROUND = 4
"""Markers around a point."""
FINE = 25
"""Lines of the grids that it was fitted on, at least; on coarser ones the spreads count for more, as the square of the step."""


def of_presses(
    noise: tuple[Tensor, Tensor],
    force: Tensor,
    depth: Tensor,
    gap: Tensor,
    contacts: Contacts,
    membrane: Membrane,
    unseen: Tensor,
) -> Deviations:
    """With the model's error.

    Args:
        noise: of force and depth, as `spreads` gives it.
        force: `[B, 3]`, as found.
        depth: `[B]`, as found.
        gap: `[B]`, to the markers around the deepest point, as of `gap_around`.
        contacts: as found.
        membrane: the rest surface on the solver's grid.
        unseen: the force `[]` that noise alone makes, over the whole surface.
    """
    coarse = max(1.0, (FINE - 1) / (min(membrane.grid) - 1)) ** 2
    of_force, of_depth = (coarse * spread for spread in noise)
    none = (~contacts.points[..., 0].isfinite().any(1)).to(depth.dtype)
    at_rim = (contacts.at_rim == 1).any(1).to(depth.dtype)
    around = (AT_RIM * at_rim).square() * force.square().sum(-1) + (UNSEEN * unseen * none).square()
    dip = DIP * gap * (gap + 2 * depth) / membrane.size
    return Deviations(
        ((FORCE * of_force).square() + FORCE_SHARE**2 * force.square() + around[:, None]).sqrt(),
        (of_depth.square() + DEPTH**2 * of_depth * gap + dip.square()).sqrt(),
    )


def depths(membrane: Membrane, u: Tensor) -> Tensor:
    """Displacements `u [B, V, 3]` along the inward rest normals, `[B, V]`."""
    depth: Tensor = -(u * membrane.rest_normals).sum(-1)
    return depth


def gap_around(deepest: Tensor, positions: Tensor, confidence: Tensor, membrane: Membrane) -> Tensor:
    """How far off the markers around a point are, `[B]`, length unit, at rest: the `AROUND` nearest that are seen, in the mean.

    Args:
        deepest: `[B, V]`, the vertices' shares in the point.
        positions: `[D, 3]`, of the markers at rest.
        confidence: `[B, D]`, 0 for those not seen.
        membrane: the rest surface on this grid.
    """
    distance = torch.linalg.vector_norm(positions - (deepest @ membrane.rest)[:, None], dim=-1)
    distance = torch.where(confidence > 0, distance, membrane.size)
    gap: Tensor = distance.topk(min(AROUND, len(positions)), largest=False).values.mean(-1)
    return gap


def shares_of_deepest(depth: Tensor) -> Tensor:
    """Of the vertices in the deepest point, by their `depth [B, V]`: where several are, all alike."""
    deepest = (depth == depth.amax(-1, keepdim=True)).to(depth.dtype)
    shares: Tensor = deepest / deepest.sum(-1, keepdim=True)
    return shares


def spreads(descent: Descent, settings: ForceBalanceSettings, state: State, observation: Observation) -> tuple[Tensor, Tensor]:
    """Of the force `[B, 3]` and the depth `[B]` at a solution, by the noise that the solve takes the markers to have."""
    measured = descent.equations.bearings.measured(observation)
    if descent.is_native(*state, *measured):
        both = descent.native.spread(descent.equations, descent.cavity, state, measured, settings.outlier)
        return both[:, :3], both[:, 3]
    return spreads_by_tensors(descent.equations, descent.cavity, settings, state, measured)


def spreads_by_tensors(
    equations: BalanceEquations, cavity: CavityLaw, settings: ForceBalanceSettings, state: State, measured: Bearings
) -> tuple[Tensor, Tensor]:
    """The same by tensor operations."""
    membrane = equations.forces.membrane
    scales, play = (settings.tau[1], settings.outlier), settings.camera_motion
    _, normal, solution = linearise(equations, cavity, state, measured, scales, play, curvature=True)
    depth = inner(depths(membrane, state.u)[..., None], membrane.grid)[..., 0]
    inwards = -inner(membrane.rest_normals, membrane.grid).mT
    of_depth = shares_of_deepest(depth)[:, None] * inwards
    wanted = torch.cat([solution.force.expand(of_depth.shape[0], -1, -1), of_depth.flatten(1)[:, None]], 1)
    by_pressure = torch.cat([-solution.of_pressure, torch.zeros_like(state.pressure)[:, None]], 1)
    both = spreads_of(equations, normal, solution, measured, wanted, by_pressure)
    return both[:, :3], both[:, 3]


def spreads_of(
    equations: BalanceEquations,
    normal: NormalEquations,
    solution: LinearisedSolution,
    measured: Bearings,
    wanted: Tensor,
    by_pressure: Tensor,
) -> Tensor:
    """Standard deviations `[B, L]` of numbers whose derivatives in the inner vertices are `wanted [B, L, 3 N]` and in the
    pressure `by_pressure [B, L]`, where all angles `across` have a standard deviation of 1, and a gauge its own."""
    solved = solution.solve(torch.cat([wanted, solution.borders], 1))
    y, of_gauge = solved[:, :-2], torch.zeros_like(by_pressure)
    if solution.corner is not None:
        (c, compliance), (m, n) = solution.corner, solution.borders.unbind(1)
        of_m, of_n = solved[:, -2:].unbind(1)
        loads, solutions = (
            torch.stack([b[:, None].expand_as(a), -a, d[:, None].expand_as(a)], 2)
            for a, b, d in ((wanted, n, m), (y, of_n, of_m))
        )
        zero = torch.zeros_like(by_pressure)
        y, rise = solve_bordered(loads, solutions, c[:, None], by_pressure, compliance[:, None], zero)
        of_gauge = of_gauge if solution.gauge is None else rise * solution.gauge[:, None]
    at_markers = y.unflatten(-1, (3, -1)) @ equations.bearings.vertex_shares.mT
    of_angles = (normal.weighted_jacobian[:, None] * at_markers[:, :, None]).sum(3)
    of_camera = solution.motion.turning(y)[..., None, :, None] * normal.marker_weights[:, None, None, None]
    of_markers = (of_angles - (measured.motion[:, None] * of_camera).sum(3)).square().sum((2, 3))
    spread: Tensor = (of_markers + of_gauge.square()).sqrt()
    return spread
