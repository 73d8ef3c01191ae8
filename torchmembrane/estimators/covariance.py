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
