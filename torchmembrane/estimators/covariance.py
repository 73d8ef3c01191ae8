"""Standard deviations of a force balance: how far marker noise spreads into the surface, the total force and the pressure.

At the solution a small change `e` of the measured angles moves surface and pressure by

    [M  m  n] [dx    ]   [J^T w e]
    [m' c  C] [dp    ] = [   0   ],    M = A^T W A + J^T w J,
    [n' C  0] [lambda]   [   0   ]

with `W` the curvature of a push's loss (flat where it bends down; shear by its parabola), so that noise of covariance S gives
the sandwich `H^-1 J^T w S w J H^-1`. One load per marker and direction of its noise, all solved with one factor.
"""

from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from ..mechanics.cavity import CavityLaw
from .base import Observation
from .bearings import Bearings
from .contact_force import Linearised
from .normal_equations import BalanceEquations, NormalEquations


class StandardDeviations(NamedTuple):
    """Of `vertices [B, V, 3]` (zero where fixed), total `force [B, 3]` and `pressure [B]`."""

    vertices: Tensor
    force: Tensor
    pressure: Tensor


class LinearisedSolution(NamedTuple):
    """A solution, linearised.

    solve        `M^-1` of loads `[B, L, 3 N]`
    borders      `[B, 2, 3 N]`, `m` and `n`: what the pressure and the volume do to the equations
    corner       `c` and the compliance `C`, `[B]` each; None where the pressure is fixed (an open cavity)
    force        `[B, 3, 3 N]`, the total force's derivative in the inner vertices
    of_pressure  `[B, 3]`, minus its derivative in the pressure
    """

    solve: Callable[[Tensor], Tensor]
    borders: Tensor
    corner: tuple[Tensor, Tensor] | None
    force: Tensor
    of_pressure: Tensor


def linearise(
    equations: BalanceEquations,
    cavity: CavityLaw,
    x: Tensor,
    pressure: Tensor,
    measured: Bearings,
    scales: tuple[float, float],
    curvature: bool = False,
) -> tuple[Linearised, NormalEquations, LinearisedSolution]:
    """The equations about a surface `x [B, V, 3]`, and what solves them for small loads.

    Args:
        equations: of the force balance.
        cavity: its law.
        x: the surface.
        pressure: `[B]`.
        measured: the markers' rays.
        scales: of the losses of tractions and of markers.
        curvature: as for `TractionLoss.weights`.
    """
    at, normal, loads, (_, vWv) = equations.linearised(x, pressure, measured, *scales, curvature=curvature)
    factor, membrane = equations.system.factor(equations.matrix(normal)), equations.forces.membrane
    compliance = cavity.condition(membrane.volume(x) - membrane.rest_volume, pressure)[1]
    corner = None if cavity.filling == "open" else (vWv, compliance.expand_as(vWv))
    one = torch.eye(3).to(x)[None, ..., None].expand(1, 3, 3, at.force.shape[-1])
    of_force = equations.forces.change(at.stiffness, one).flatten(2)
    solution = LinearisedSolution(
        lambda loads: equations.system.substitute(factor, loads), loads[:, [2, 0]], corner, of_force, at.volume.sum(-1)
    )
    return at, normal, solution


@torch.no_grad()
def push_noise(equations: BalanceEquations, cavity: CavityLaw, rest: Observation) -> Tensor:
    """The push `S [N]` that the markers' noise makes at rest, one standard deviation, while all losses are quadratic.

    Args:
        equations: of the force balance.
        cavity: its law.
        rest: the markers' rays at rest.
    """
    membrane, loss = equations.forces.membrane, equations.loss
    measured = equations.bearings.measured(rest)
    at, normal, solution = linearise(
        equations, cavity, membrane.rest[None], cavity.rest_pressure[None], measured, (torch.inf, torch.inf)
    )
    noise_loads = torch.einsum("bacd,dn->bdacn", normal.weighted_jacobian, equations.bearings.vertex_shares)
    dx, dp = changes(solution, noise_loads.flatten(3).flatten(1, 2))
    dq = equations.forces.change(at.stiffness, dx.unflatten(-1, (3, -1))) - dp[..., None, None] * at.volume[:, None]
    push = (dq * at.normal[:, None]).sum(2) / (loss.area * loss.reference)
    return (push.square().sum(1) @ loss.surroundings).sqrt()[0]


def changes(solution: LinearisedSolution, noise_loads: Tensor) -> tuple[Tensor, Tensor]:
    """What each load does to the inner vertices, `[B, L, 3 N]`, and to the pressure, `[B, L]`.

    Args:
        solution: the linearised solution.
        noise_loads: `[B, L, 3 N]`, what one standard deviation of each independent noise adds to the equations, `J^T w e`.
    """
    y = solution.solve(torch.cat([noise_loads, solution.borders], 1))
    dx, dp = y[:, :-2], torch.zeros_like(noise_loads[..., 0])
    if solution.corner is not None:
        border = y[:, -2:]
        c, C = solution.corner
        corner = torch.stack([c, C, C, torch.zeros_like(C)], -1).unflatten(-1, (2, 2)) - solution.borders @ border.mT
        rise = torch.linalg.solve(corner, -solution.borders @ dx.mT)
        dx, dp = dx - rise.mT @ border, rise[:, 0]
    return dx, dp


def spread(solution: LinearisedSolution, noise_loads: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Standard deviations of the inner vertices `[B, 3 N]`, the total force `[B, 3]` and the pressure `[B]`; arguments as of
    `changes`."""
    dx, dp = changes(solution, noise_loads)
    dF = dx @ solution.force.mT - dp[..., None] * solution.of_pressure[:, None]
    return _root_sum_square(dx), _root_sum_square(dF), _root_sum_square(dp)


def _root_sum_square(changes: Tensor) -> Tensor:
    return changes.square().sum(1).sqrt()
