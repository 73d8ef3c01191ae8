"""Anderson acceleration of a fixed-point iteration `x <- x + move(x)`, depth two, batched, static. Walker and Ni 2011."""

import torch
from torch import Tensor

RIDGE = 30.0  # of the two by two least squares, in roundings
TINY = 1e-30


def first(x: Tensor, move: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """The iterate after `x [..., N]`, and the history for `accelerated`."""
    return x + move, *(a[..., None, :].expand(*a.shape[:-1], 2, a.shape[-1]) for a in (x, move))


def accelerated(x: Tensor, move: Tensor, before: Tensor, moves: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """The iterate after `x`, and the history after it.

    Arguments: `x`, `move [..., N]`; `before`, `moves [..., 2, N]`: the two iterates before this, latest first, and their moves.
    Of all affine combinations of the three, taken is the one whose move, were it linear in `x`, is shortest.
    """
    change = move[..., None, :] - moves
    step = x[..., None, :] - before + change
    products = change @ torch.cat([change, move[..., None, :]], -2).mT
    a, b, f, _, d, g = _raised(products).flatten(-2).split(1, -1)
    ratio = b / a
    second = (g - ratio * f) / (d - ratio * b)
    share = torch.cat([(f - b * second) / a, second], -1)
    following = x + move - (share[..., None] * step).sum(-2)
    return following, torch.stack([x, before[..., 0, :]], -2), torch.stack([move, moves[..., 0, :]], -2)


def _raised(products: Tensor) -> Tensor:
    """The system `[matrix, load] [..., 2, 3]` with a ridge on the matrix's diagonal."""
    diagonal = torch.eye(2, 3, dtype=products.dtype, device=products.device)
    return products * (1 + RIDGE * torch.finfo(products.dtype).eps * diagonal) + TINY * diagonal
