"""Standard deviations of force balance: propagation of the markers' noise to the surface, the total force and the pressure.

At the solution a small change `e` of the measured angles changes surface and pressure by

    [M  m  n] [dx    ]   [J^T w e]
    [m' c  C] [dp    ] = [   0   ],    M = A^T W A + J^T w J,
    [n' C  0] [lambda]   [   0   ]

where the camera's motion (`camera_motion`) is eliminated as in a step. If a gauge reads the pressure, `c + 1 / sigma^2`
replaces `c`, and the gauge's own noise of one sigma adds `1 / sigma` to the second row. `W` is the curvature of a push's loss
(zero where it is negative) and the parabola's weight of the shear loss, so that noise of covariance S gives the sandwich
`H^-1 J^T w S w J H^-1`. There is one load per marker and direction of its noise, all solved with one factor.

**Deviations of force and depth in every result.** The transposed equations give the sensitivities of force and depth to the
markers with one solve per wanted number instead of one per marker,

    K y = g,    spread^2 = sum_d |w_d (J_d y - K_d T^-1 B y)|^2

with the derivative `g` of the wanted number in surface and pressure and the symmetric matrix `K` above. This is solved on the
estimator's second finest grid, which is cheaper and as accurate. The noise of every marker is the one that the solver assumes,
including a share of the displacement for errors of grid and material. But these errors are correlated between markers, so the
spread is too small. The missing part was fitted to presses of random sensors (`bench/accuracy/intervals.py`), as standard
deviations that add in quadrature:

    of the force    FORCE x spread,  FORCE_SHARE x each component of the force,  RIM_ERROR x force if a contact reaches the rim,
                    UNDETECTED x the force that noise alone would cause on the whole surface, if no contact is found
    of the depth    spread,  DEPTH sqrt(spread gap),  SAG gap (gap + 2 depth) / size

with the mean distance `gap` to the markers around the deepest point. The surface between them is not seen: the last term
estimates its sag from `gap` and the curvatures of the surface and the dent. The geometric mean of spread and gap is empirical.
"""

from collections.abc import Callable
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from ...mechanics.cavity import CavityLaw
from ...solve.kkt import solve_bordered
from ...solve.stencil import inner, pad_border
from ...surface.membrane import Membrane
from ...surface.tangent import tangent_frame
from ..base import Deviations, Observation, StandardDeviations
from ..contacts import Contacts
from .camera_motion import CameraMotion
from .contact_force import Linearised
from .gauss_newton import GaussNewton, State
from .marker_residuals import MeasuredRays
from .normal_equations import DAMPING, BalanceEquations, NormalEquations
from .pressure_gauge import pulled
from .settings import ForceBalanceSettings


class LinearisedSolution(NamedTuple):
    """A solution with the linearised equations about it.

    solve        applies `M^-1` to loads `[B, L, 3 N]`
    borders      `[B, 2, 3 N]`, the borders `m` and `n` of pressure and volume
    corner       `c` and the compliance `C`, `[B]` each; None if the pressure is fixed (an open cavity)
    force        `[B, 3, 3 N]`, derivative of the total force in the inner vertices
    of_pressure  `[B, 3]`, minus the derivative of the total force in the pressure
    motion       the camera's part of the equations
    gauge        `1 / sigma` of a gauge's reading, `[B]`, already included in `c`; None without a gauge
    """

    solve: Callable[[Tensor], Tensor]
    borders: Tensor
    corner: tuple[Tensor, Tensor] | None
    force: Tensor
    of_pressure: Tensor
    motion: CameraMotion
    gauge: Tensor | None = None


def linearise(
    equations: BalanceEquations,
    cavity: CavityLaw,
    state: State,
    measured: MeasuredRays,
    scales: tuple[float, float],
    play: float,
    curvature: bool = False,
) -> tuple[Linearised, NormalEquations, LinearisedSolution]:
    """Linearise the equations about a state, and factor them.

    Args:
        equations: equations of force balance.
        cavity: law of the cavity's filling.
        state: the solution.
        measured: the markers' rays.
        scales: scales of the losses of tractions and of markers, the same for all frames.
        play: scale of the prior of the camera's motion, px, as for `CameraMotion.with_prior`.
        curvature: as for `TractionLoss.weights`.
    """
    tau, outlier = (torch.full_like(state.pressure, scale) for scale in scales)
    at, normal, loads, corner, motion = equations.linearised(*state, measured, tau, outlier, curvature=curvature)
    vWv = pulled(corner, measured.gauge, state.pressure - cavity.rest_pressure)[1]
    factor, membrane = equations.system.factor(equations.matrix(normal, DAMPING)), equations.forces.membrane
    compliance = cavity.condition(membrane.volume(membrane.rest + state.u) - membrane.rest_volume, state.pressure)[1]
    motion = motion.with_prior(state.moved, play)
    of_motion = equations.system.substitute(factor, motion.coupling)
    closed = cavity.filling != "open"
    one = torch.eye(3, dtype=state.u.dtype, device=state.u.device)[None, ..., None].expand(1, 3, 3, at.force.shape[-1])
    of_force = equations.forces.change(at.stiffness, one).flatten(2)
    solution = LinearisedSolution(
        lambda loads: motion.eliminate_camera(equations.system.substitute(factor, loads), of_motion),
        torch.stack([loads[:, 2], loads[:, 0]], 1),
        (vWv, compliance.expand_as(vWv)) if closed else None,
        of_force,
        at.volume.sum(-1),
        motion,
        measured.gauge[:, 1].sqrt() if closed and measured.gauge is not None else None,
    )
    return at, normal, solution


@torch.no_grad()
def noise_of_pushes(equations: BalanceEquations, cavity: CavityLaw, rest: Observation, play: float) -> Tensor:
    """Return the standard deviation of the push `S [N]` due to the markers' noise at rest, while all losses are quadratic.

    Args:
        equations: equations of force balance.
        cavity: law of the cavity's filling.
        rest: the markers' rays at rest.
        play: scale of the prior of the camera's motion, px, as for `CameraMotion.with_prior`.
    """
    membrane, loss = equations.forces.membrane, equations.loss
    measured = equations.bearings.measured(rest)
    still = torch.zeros_like(membrane.rest[:1, :1]).expand(1, measured.motion.shape[2])
    state = State(torch.zeros_like(membrane.rest[None]), cavity.rest_pressure[None], still)
    at, normal, solution = linearise(equations, cavity, state, measured, (torch.inf, torch.inf), play)
    alone = torch.eye(2, dtype=measured.weight.dtype, device=measured.weight.device).expand(1, measured.weight.shape[1], 2, 2)
    loads = noise_loads(equations, normal, measured, solution.motion, alone)
    dx, dp = changes(solution, loads)
    dq = equations.forces.change(at.stiffness, dx.unflatten(-1, (3, -1))) - dp[..., None, None] * at.volume[:, None]
    push = (dq * at.normal[:, None]).sum(2) / (loss.area * loss.reference)
    noise: Tensor = (push.square().sum(1) @ loss.surroundings).sqrt()[0]
    return noise


def noise_loads(
    equations: BalanceEquations, normal: NormalEquations, measured: MeasuredRays, motion: CameraMotion, turned: Tensor
) -> Tensor:
    """Return the loads `J^T w e - B' T^-1 K^T w e` of the markers' noise, with the camera eliminated, `[B, 2 D, 3 N]`;
    `turned [B, D, 2, 2]` (noise, angle) are the changes of each marker's angles by independent noises."""
    loads = equations.bearings.loads_alone(turned, normal.weighted_jacobian)
    slopes = torch.einsum("bdra,bakd,bd->bdrk", turned, measured.motion, normal.marker_weights)
    return motion.project_out(loads.flatten(3).flatten(1, 2), slopes.flatten(1, 2))


def changes(solution: LinearisedSolution, noise_loads: Tensor) -> tuple[Tensor, Tensor]:
    """Return the changes of the inner vertices, `[B, L, 3 N]`, and the pressure, `[B, L]`, by each load.

    Args:
        solution: the linearised solution.
        noise_loads: loads of one standard deviation of each independent noise, `[B, L, 3 N]`; a gauge's noise is added last.
    """
    if solution.gauge is not None:
        noise_loads = F.pad(noise_loads, (0, 0, 0, 1))
    y = solution.solve(torch.cat([noise_loads, solution.borders], 1))
    dx, dp = y[:, :-2], torch.zeros_like(noise_loads[..., 0])
    if solution.corner is not None:
        border = y[:, -2:]
        c, C = solution.corner
        corner = torch.stack([c, C, C, torch.zeros_like(C)], -1).unflatten(-1, (2, 2)) - solution.borders @ border.mT
        rows = -solution.borders @ dx.mT
        if solution.gauge is not None:
            rows = rows + F.pad(solution.gauge[:, None, None], (rows.shape[-1] - 1, 0, 0, 1))
        rise = torch.linalg.solve(corner, rows)
        dx, dp = dx - rise.mT @ border, rise[:, 0]
    return dx, dp


def spread(solution: LinearisedSolution, noise_loads: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return the standard deviations of the inner vertices `[B, 3 N]`, the total force `[B, 3]` and the pressure `[B]`;
    arguments as for `changes`."""
    dx, dp = changes(solution, noise_loads)
    dF = dx @ solution.force.mT - dp[..., None] * solution.of_pressure[:, None]
    return _root_sum_square(dx), _root_sum_square(dF), _root_sum_square(dp)


def standard_deviations(
    equations: BalanceEquations,
    cavity: CavityLaw,
    settings: ForceBalanceSettings,
    state: State,
    observation: Observation,
    marker_noise: float | Tensor,
) -> StandardDeviations:
    """Return the standard deviations of a solution due to the markers' noise.

    Args:
        equations: equations of the estimator.
        cavity: law of the cavity's filling.
        settings: settings of the estimator.
        state: the solution.
        observation: the rays that the solution was found from.
        marker_noise: standard deviation of every marker's angles, radians; or the changes of the rays' directions by two
            independent components of noise, `[B, D, 2, 3]`.
    """
    measured = equations.bearings.measured(observation)
    noise = marker_noise if isinstance(marker_noise, Tensor) else marker_noise * tangent_frame(observation.directions)
    scales = settings.tau[1], settings.outlier
    _, normal, solution = linearise(equations, cavity, state, measured, scales, settings.camera_motion, curvature=True)
    turned = torch.einsum("bdrj,bajd->bdra", noise.to(measured.across), measured.across)
    dx, dF, dp = spread(solution, noise_loads(equations, normal, measured, solution.motion, turned))
    return StandardDeviations(pad_border(dx.unflatten(-1, (3, -1)).mT, equations.forces.membrane.grid), dF, dp)


def _root_sum_square(changes: Tensor) -> Tensor:
    return changes.square().sum(1).sqrt()


FORCE, FORCE_SHARE, RIM_ERROR, UNDETECTED = 0.85, 0.026, 0.12, 0.002
DEPTH, SAG = 0.43, 0.23
AROUND = 4
"""Number of markers whose mean distance from a point is the gap around it."""
FINE = 25
"""Lines of the coarsest grids used in the fit; on coarser ones the spreads are increased with the square of the grid step."""


def of_presses(
    noise: tuple[Tensor, Tensor],
    force: Tensor,
    depth: Tensor,
    gap: Tensor,
    contacts: Contacts,
    membrane: Membrane,
    unseen: Tensor,
) -> Deviations:
    """Return the standard deviations of force and depth, including the model's error.

    Args:
        noise: spreads of force and depth due to noise, from `spreads`.
        force: the force found, `[B, 3]`.
        depth: the depth found, `[B]`.
        gap: mean distance to the markers around the deepest point, from `gap_around`, `[B]`.
        contacts: the contacts found.
        membrane: the rest surface on the solver's grid.
        unseen: force of the push due to noise alone on the whole surface, `[]`.
    """
    coarse = max(1.0, (FINE - 1) / (min(membrane.grid) - 1)) ** 2
    of_force, of_depth = (coarse * spread for spread in noise)
    none = (~contacts.points[..., 0].isfinite().any(1)).to(depth.dtype)
    at_rim = (contacts.at_rim == 1).any(1).to(depth.dtype)
    around = (RIM_ERROR * at_rim).square() * force.square().sum(-1) + (UNDETECTED * unseen * none).square()
    dip = SAG * gap * (gap + 2 * depth) / membrane.size
    return Deviations(
        ((FORCE * of_force).square() + FORCE_SHARE**2 * force.square() + around[:, None]).sqrt(),
        (of_depth.square() + DEPTH**2 * of_depth * gap + dip.square()).sqrt(),
    )


def depths(membrane: Membrane, u: Tensor) -> Tensor:
    """Return the components of displacements `u [B, V, 3]` along the inward rest normals, `[B, V]`."""
    depth: Tensor = -(u * membrane.rest_normals).sum(-1)
    return depth


def gap_around(deepest: Tensor, positions: Tensor, confidence: Tensor, membrane: Membrane) -> Tensor:
    """Return the mean rest distance `[B]`, length unit, of a point from the `AROUND` nearest markers that are seen.

    Args:
        deepest: weights of the vertices that define the point, `[B, V]`.
        positions: rest positions of the markers, `[D, 3]`.
        confidence: confidence of the markers, `[B, D]`, 0 for those not seen.
        membrane: the rest surface on this grid.
    """
    distance = torch.linalg.vector_norm(positions - (deepest @ membrane.rest)[:, None], dim=-1)
    distance = torch.where(confidence > 0, distance, membrane.size)
    gap: Tensor = distance.topk(min(AROUND, len(positions)), largest=False).values.mean(-1)
    return gap


def shares_of_deepest(depth: Tensor) -> Tensor:
    """Return the weights of the vertices that define the deepest point, from their `depth [B, V]`: equal for equal depths."""
    deepest = (depth == depth.amax(-1, keepdim=True)).to(depth.dtype)
    shares: Tensor = deepest / deepest.sum(-1, keepdim=True)
    return shares


def spreads(
    gauss_newton: GaussNewton, settings: ForceBalanceSettings, state: State, observation: Observation
) -> tuple[Tensor, Tensor]:
    """Return the spreads of force `[B, 3]` and depth `[B]` of a solution, due to the marker noise that the solver assumes."""
    measured = gauss_newton.equations.bearings.measured(observation)
    if gauss_newton.is_native(*state, *measured):
        both = gauss_newton.native.spread(gauss_newton.equations, gauss_newton.cavity, state, measured, settings.outlier)
        return both[:, :3], both[:, 3]
    return spreads_by_tensors(gauss_newton.equations, gauss_newton.cavity, settings, state, measured)


def spreads_by_tensors(
    equations: BalanceEquations, cavity: CavityLaw, settings: ForceBalanceSettings, state: State, measured: MeasuredRays
) -> tuple[Tensor, Tensor]:
    """Return the same as `spreads`, computed by tensor operations."""
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
    measured: MeasuredRays,
    wanted: Tensor,
    by_pressure: Tensor,
) -> Tensor:
    """Return the standard deviations `[B, L]` of L numbers that are computed from a solution.

    The noise is that of the markers' weighted angles (standard deviation 1) and, if there is one, that of the gauge. The
    numbers have the derivatives `wanted [B, L, 3 N]` in the N inner vertices and `by_pressure [B, L]` in the pressure.
    """
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
    of_angles = equations.bearings.joined((normal.weighted_jacobian[:, None] * at_markers[:, :, None]).sum(3))
    of_camera = solution.motion.response(y)[..., None, :, None] * normal.marker_weights[:, None, None, None]
    of_markers = (of_angles - (measured.motion[:, None] * of_camera).sum(3)).square().sum((2, 3))
    spread: Tensor = (of_markers + of_gauge.square()).sqrt()
    return spread
