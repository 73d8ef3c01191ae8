"""Bordered linear systems (one or two borders), reduced to solves with one symmetric positive definite matrix."""

from typing import NamedTuple

import torch
from torch import Tensor

from .symmetric_2x2 import symmetric_solution


class ConstrainedMinimum(NamedTuple):
    """The minimiser `y [..., N]` and the Lagrange multiplier `[...]`; the fluid's pressure is minus the multiplier."""

    y: Tensor
    multiplier: Tensor


def constrained_minimum(
    inverse_load: Tensor, inverse_gradient: Tensor, gradient: Tensor, target: Tensor, compliance: float | Tensor = 0.0
) -> ConstrainedMinimum:
    """Minimise `1/2 y.K y - g.y` subject to `v.y = c` (eqs. 22, 25-27).

    With `C > 0` the constraint is `v.y = c + C lambda` (a compressible gas). Stationarity is `K y = g - lambda v`, so

        lambda = (v.K^-1 g - c) / (v.K^-1 v + C)        (eq. 27 for C = 0)

    The indefinite KKT matrix is never formed.

    Args:
        inverse_load: solution for the load, `K^-1 g [..., N]`.
        inverse_gradient: solution for the constraint's gradient, `K^-1 v [..., N]`.
        gradient: gradient of the constraint, `v [..., N]`.
        target: right-hand side of the constraint, `c [...]`.
        compliance: compliance of the constraint, `C [...]`.

    Example:
        >>> import torch
        >>> g, v = torch.tensor([2.0, 0.0]), torch.tensor([1.0, 1.0])
        >>> constrained_minimum(g, v, v, torch.tensor(0.0))  # K = 1
        ConstrainedMinimum(y=tensor([ 1., -1.]), multiplier=tensor(1.))
    """
    multiplier = (_dot(gradient, inverse_load) - target) / (_dot(gradient, inverse_gradient) + compliance)
    return ConstrainedMinimum(inverse_load - multiplier[..., None] * inverse_gradient, multiplier)


class BorderedStep(NamedTuple):
    """The step `d [..., N]` of `solve_bordered`, and `rise [...]`, the increase `r` of the unknown of the border `m`."""

    step: Tensor
    rise: Tensor


def solve_bordered(
    loads: Tensor, solved: Tensor, corner: Tensor, load: Tensor, compliance: Tensor, target: Tensor
) -> BorderedStep:
    """Solve for `d`, `r` and the multiplier `lambda`:

        [M  m  n] [d     ]   [-g]
        [m' c  C] [r     ] = [ b]
        [n' C  0] [lambda]   [ t]

    Args:
        loads: the vectors `n`, `g`, `m`, `[..., 3, N]`.
        solved: `M^-1` times each of them, `[..., 3, N]`.
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
    """Return `lambda` and `r` of `solve_bordered`, `[...]` each.

    Args:
        products: products of the loads (rows) with their solutions (columns), `[..., 3, 3]`.
        corner: as for `solve_bordered`.
        load: as for `solve_bordered`.
        compliance: as for `solve_bordered`.
        target: as for `solve_bordered`.
    """
    nMn, nMg, nMm, _, _, _, _, mMg, mMm = products.flatten(-2).unbind(-1)
    scale = nMn.abs().clamp_min(torch.finfo(nMn.dtype).tiny).rsqrt()  # of lambda: the determinant is in length^10
    border, of_border = scale * (compliance - nMm), scale * (target + nMg)
    rise, multiplier = symmetric_solution(corner - mMm, border, -scale * scale * nMn, load + mMg, of_border)
    return scale * multiplier, rise


def _dot(p: Tensor, q: Tensor) -> Tensor:
    return (p * q).sum(-1)
