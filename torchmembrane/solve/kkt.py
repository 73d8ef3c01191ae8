"""Linear systems with one or two borders, by solves with one symmetric positive definite matrix."""

from typing import NamedTuple

import torch
from torch import Tensor

from .symmetric_2x2 import symmetric_solution


class ConstrainedMinimum(NamedTuple):
    """`y [..., N]` and the multiplier `[...]`; the fluid's pressure is minus the multiplier."""

    y: Tensor
    multiplier: Tensor


def constrained_minimum(
    inverse_load: Tensor, inverse_gradient: Tensor, gradient: Tensor, target: Tensor, compliance: float | Tensor = 0.0
) -> ConstrainedMinimum:
    """Minimiser of `1/2 y.K y - g.y` subject to `v.y = c` (eqs. 22, 25-27).

    With `C > 0` the constraint reads `v.y = c + C lambda` (a gas that yields). Stationarity is `K y = g - lambda v`, so

        lambda = (v.K^-1 g - c) / (v.K^-1 v + C)        (eq. 27 for C = 0)

    The indefinite KKT matrix is never formed.

    Args:
        inverse_load: `K^-1 g [..., N]`.
        inverse_gradient: `K^-1 v [..., N]`.
        gradient: `v [..., N]`.
        target: `c [...]`.
        compliance: the constraint's, `C [...]`.

    Example:
        >>> import torch
        >>> g, v = torch.tensor([2.0, 0.0]), torch.tensor([1.0, 1.0])
        >>> constrained_minimum(g, v, v, torch.tensor(0.0))  # K = 1
        ConstrainedMinimum(y=tensor([ 1., -1.]), multiplier=tensor(1.))
    """
    multiplier = (_dot(gradient, inverse_load) - target) / (_dot(gradient, inverse_gradient) + compliance)
    return ConstrainedMinimum(inverse_load - multiplier[..., None] * inverse_gradient, multiplier)


class BorderedStep(NamedTuple):
    """`step [..., N]`, and `rise [...]`, the increase of the second border's unknown."""

    step: Tensor
    rise: Tensor


def solve_bordered(
    loads: Tensor, solved: Tensor, corner: Tensor, load: Tensor, compliance: Tensor, target: Tensor
) -> BorderedStep:
    """Solve for `d`, `r` and a multiplier `lambda`

        [M  m  n] [d     ]   [-g]
        [m' c  C] [r     ] = [ b]
        [n' C  0] [lambda]   [ t]

    Args:
        loads: `[..., 3, N]`: `n`, `g`, `m`.
        solved: `[..., 3, N]`: `M^-1` of them.
        corner: `c [...]`.
        load: `b [...]`.
        compliance: `C`, `[...]` or `[]`.
        target: `t [...]`.
    """
    multiplier, rise = border_unknowns(loads @ solved.mT, corner, load, compliance, target)
    of_border, of_load, of_second = solved.unbind(-2)
    return BorderedStep(-(multiplier[..., None] * of_border + of_load + rise[..., None] * of_second), rise)


def border_unknowns(
    products: Tensor, corner: Tensor, load: Tensor, compliance: Tensor, target: Tensor
) -> tuple[Tensor, Tensor]:
    """`lambda` and `r` of `solve_bordered`, `[...]` each, from the products of the loads (rows) with their solutions, `[..., 3,
    3]`, and the other arguments."""
    nMn, nMg, nMm, _, _, _, _, mMg, mMm = products.flatten(-2).unbind(-1)
    scale = nMn.abs().clamp_min(torch.finfo(nMn.dtype).tiny).rsqrt()  # of the multiplier: the determinant goes with length^10
    border, of_border = scale * (compliance - nMm), scale * (target + nMg)
    rise, multiplier = symmetric_solution(corner - mMm, border, -scale * scale * nMn, load + mMg, of_border)
    return scale * multiplier, rise


def _dot(p: Tensor, q: Tensor) -> Tensor:
    return (p * q).sum(-1)
