"""Anderson acceleration of a fixed-point iteration `x <- x + move(x)`, batched, static. Walker and Ni 2011.

The latest changes of the move are kept orthonormal, each together with its change of `x + move`, so that no system of equations
has to be solved.
"""

import torch
from torch import Tensor

DEPTH = 8  # changes kept
RIDGE = 30.0  # of a change's squared length, in roundings
TINY = 1e-30  # where nothing is known yet and nothing moves


def first(x: Tensor, move: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """The iterate after `x [..., N]`, and the history for `accelerated`."""
    after = x + move
    latest = torch.cat([move, after], -1)[..., None, :]
    return after, latest, torch.zeros_like(latest).expand(*x.shape[:-1], DEPTH, latest.shape[-1])


def accelerated(x: Tensor, move: Tensor, latest: Tensor, changes: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """The iterate after `x`, and the history after it.

    Arguments: `x`, `move [..., N]`; `latest [..., 1, 2 N]`, `(move, x + move)` before; `changes [..., DEPTH, 2 N]` up to there,
    latest first, orthonormal in the move. Of all combinations of `(move, x + move)` and the changes, the one with the shortest
    move is taken, as if the move were linear in `x`; changes no larger than the rounding of `x` are ignored.
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
