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
    force, A = estimator.contact_force(x, pressure), estimator.force_jacobian(x, pressure)
    v = membrane.volume_gradient(x) * estimator.moves
    W = estimator.force_weights(x, force, tau, curvature=True)
    angle, J = estimator._angles(x, seen)
    wJ = estimator._marker_weights(angle, seen, outlier)[..., None, None] * J
    WA = W @ A
    matrix = system.matrix([(estimator.vertex_patches, A.mT @ WA), (estimator.marker_patches, J.mT @ wJ)])
    g = system.columns(estimator.marker_patches, noise @ seen.across.mT @ wJ)
    m = -system.vector([(estimator.vertex_patches, (WA.mT @ v[..., None]).squeeze(-1))])
    n = system.from_vertices(v)
    y = system.solve(matrix, torch.cat([g, torch.stack([m, n], -1)], -1))
    dx, dp = y[..., :-2], torch.zeros_like(g[:, 0])
    if estimator.cavity.filling != "open":
        border, borders = y[..., -2:], torch.stack([m, n], 1)
        _, compliance = estimator.cavity.condition(membrane.volume(x) - membrane.rest_volume, pressure)
        c = (v[..., None, :] @ W @ v[..., None]).sum((1, 2, 3))
        corner = torch.diag_embed(torch.stack([c, compliance], -1)) - borders @ border
        rise = torch.linalg.solve(corner, -borders @ dx)
        dx, dp = dx - border @ rise, rise[:, 0]
    total = torch.stack([system.vector([(estimator.vertex_patches, row)]) for row in A.unbind(-2)], 1)
    dF = total @ dx - v.sum(1)[..., None] * dp[:, None]
    spread = lambda change: change.square().sum(-1).sqrt()  # noqa: E731
    return StandardDeviations(system.to_vertices(spread(dx)), spread(dF), spread(dp))
