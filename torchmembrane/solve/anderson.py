"""Anderson acceleration of a fixed-point iteration `x <- x + move(x)`, batched, with a static graph (Walker and Ni 2011).

The latest differences of `move` between iterations are kept orthonormal, each together with the corresponding difference of
`x + move`, so that no system of equations has to be solved.
"""

import torch
from torch import Tensor

DEPTH = 8  # number of differences that are kept
RIDGE = 30.0  # regularisation of a difference's squared length, in units of machine epsilon
TINY = 1e-30  # avoids 0 / 0 where there is no history yet and nothing moves


def first(x: Tensor, move: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return the iterate `x + move` that follows `x [..., N]`, and the two initial parts of the history for `accelerated`."""
    after = x + move
    latest = torch.cat([move, after], -1)[..., None, :]
    return after, latest, torch.zeros_like(latest).expand(*x.shape[:-1], DEPTH, latest.shape[-1])


def accelerated(x: Tensor, move: Tensor, latest: Tensor, changes: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return the iterate that follows `x`, and the updated history.

    The iterate is the combination of `(move, x + move)` and the stored differences that has the shortest move, as if the move
    were linear in `x`. Differences no larger than the rounding error of `x` are ignored.

    Args:
        x: current iterate, `[..., N]`.
        move: its move, `[..., N]`.
        latest: `(move, x + move)` of the previous iterate, `[..., 1, 2 N]`.
        changes: differences stored so far, `[..., DEPTH, 2 N]`, latest first; their move parts are orthonormal.
    """
    N = x.shape[-1]
    now = torch.cat([move, x + move], -1)[..., None, :]
    change, rounding = now - latest, torch.finfo(x.dtype).eps
    fresh = change - change[..., :N] @ changes[..., :N].mT @ changes
    ridge = RIDGE * rounding * _square(change[..., :N]) + rounding**2 * _square(now) + TINY
    changes = torch.cat([fresh / (_square(fresh[..., :N]) + ridge).sqrt(), changes[..., :-1, :]], -2)
    shortest = now - now[..., :N] @ changes[..., :N].mT @ changes
    return shortest[..., 0, N:], now, changes


def _square(row: Tensor) -> Tensor:
    return row @ row.mT
