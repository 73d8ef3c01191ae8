"""Standard deviations of a force balance: how far marker noise spreads into the surface, the total force and the pressure.

At the solution a small change `e` of the measured angles moves surface and pressure by

    [M  m  n] [dx    ]   [J^T w e]
    [m' c  0] [dp    ] = [   0   ],    M = A^T W A + J^T w J,
    [n' 0  C] [lambda]   [   0   ]

with `W` the curvature of a push's price (flat where it bends down; what rubs by its parabola), so that noise of covariance S
gives the sandwich `H^-1 J^T w S w J H^-1`. One load a marker and direction of its noise, all solved with one factor.
"""

from typing import TYPE_CHECKING, NamedTuple

import torch
from torch import Tensor

from ..surface.stencil import pad_border

if TYPE_CHECKING:
    from .force_balance import ForceBalance, Observation


class StandardDeviations(NamedTuple):
    """Of `vertices [B, V, 3]` (zero where fixed), total `force [B, 3]` and `pressure [B]`."""

    vertices: Tensor
    force: Tensor
    pressure: Tensor


def standard_deviations(
    estimator: "ForceBalance", x: Tensor, pressure: Tensor, seen: "Observation", noise: Tensor, tau: float, outlier: float
) -> StandardDeviations:
    """Arguments: the solution's `x [B, V, 3]`, `pressure [B]`; what it was found from; `noise [B, D, 2, 3]`: how one standard
    deviation of a marker's noise in each of two independent directions turns its ray, radians."""
    system, membrane = estimator.system, estimator.membrane
    at = estimator.linearised(x, pressure)
    W = estimator.force_weights(at.normal, at.force, tau, curvature=True)
    angle, sight = estimator.angles(x, seen)
    weight = estimator.marker_weights_at(angle, seen, outlier)
    normal = estimator.normal_equations(at, W, sight, weight)
    loads, (_, c) = estimator.loads(normal, at, angle)
    borders = loads[:, [2, 0]]
    turns = torch.einsum("bdrj,bajd,bacd->bdrc", noise, seen.across, normal.weighted_sight)
    g = torch.einsum("bdrc,dn->bdrcn", turns, estimator.vertex_shares).flatten(3).flatten(1, 2)
    y = system.substitute(system.factor(estimator.matrix(normal)), torch.cat([g, borders], 1))
    dx, dp = y[:, :-2], torch.zeros_like(g[..., 0])
    if estimator.cavity.filling != "open":
        border = y[:, -2:]
        _, compliance = estimator.cavity.condition(membrane.volume(x) - membrane.rest_volume, pressure)
        corner = torch.diag_embed(torch.stack([c, compliance.expand_as(c)], -1)) - borders @ border.mT
        rise = torch.linalg.solve(corner, -borders @ dx.mT)
        dx, dp = dx - rise.mT @ border, rise[:, 0]
    total = estimator.along(at.slope, torch.eye(3).to(x)[None, ..., None].expand(1, 3, 3, len(estimator.free))).flatten(2)
    dF = dx @ total.mT - dp[..., None] * at.volume.sum(-1)[:, None]
    spread = lambda change: change.square().sum(1).sqrt()  # noqa: E731
    return StandardDeviations(pad_border(spread(dx).unflatten(-1, (3, -1)).mT, membrane.grid), spread(dF), spread(dp))
