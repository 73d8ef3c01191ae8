"""Quadratic programmes with one linear constraint, by two solves with the same matrix."""

from typing import NamedTuple

from torch import Tensor


class ConstrainedMinimum(NamedTuple):
    """`y [..., N]` and the multiplier `[...]`; the fluid's pressure is minus the multiplier."""

    y: Tensor
    multiplier: Tensor


def constrained_minimum(
    inverse_load: Tensor, inverse_gradient: Tensor, gradient: Tensor, target, compliance=0.0
) -> ConstrainedMinimum:
    """Minimiser of `1/2 y.K y - g.y` subject to `v.y = c` (eqs. 22, 25-27).

    Arguments: `K^-1 g [..., N]`, `K^-1 v [..., N]`, `v [..., N]`, the target `c [...]`, and the constraint's compliance `C`:
    with `C > 0` the constraint reads `v.y = c + C lambda` (a gas that yields). Stationarity is `K y = g - lambda v`, so

        lambda = (v.K^-1 g - c) / (v.K^-1 v + C)        (eq. 27 for C = 0)

    The indefinite KKT matrix is never formed.
    """
    dot = lambda p, q: (p * q).sum(-1)  # noqa: E731
    multiplier = (dot(gradient, inverse_load) - target) / (dot(gradient, inverse_gradient) + compliance)
    return ConstrainedMinimum(inverse_load - multiplier[..., None] * inverse_gradient, multiplier)
