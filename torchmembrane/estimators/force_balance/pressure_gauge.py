"""A gauge in the cavity: its reading is one more residual of the solve.

With the pressure `P` measured, of standard deviation `sigma`, the objective gains `(p - P)^2 / (2 sigma^2)`: in a step's row of
the pressure, `1 / sigma^2` on the diagonal and `(p - P) / sigma^2` in the gradient. Both are taken as changes since rest, for
every grid has a rest pressure of its own. Where there is no reading the weight is zero.
"""

import torch
from torch import Tensor

from ...control_flow import can_sync
from ...errors import MembraneError


def refuse_open(filling: str) -> None:
    """Refuse a gauge of a cavity where it tells nothing."""
    if filling == "open":
        raise MembraneError(
            "pressure: the cavity is open, its pressure is known to stay at rest: a gauge tells nothing; leave it out, or "
            "describe the cavity as a liquid or a gas"
        )


def gauge_reading(pressure: Tensor | float, rest_pressure: Tensor, deviation: float, confidence: Tensor) -> Tensor:
    """Change of the pressure since rest as measured, and its weight `1 / sigma^2`, both zero where there is no reading,
    `[B, 2]`.

    Args:
        pressure: across the membrane, `[B]` or `[]`, NaN where there is no reading.
        rest_pressure: pressure at rest of the membrane, `[]`, of the grid whose pressure is reported.
        deviation: sigma, force / length^2.
        confidence: `[B, D]` of the frames' markers.

    Raises:
        MembraneError: another shape, or an infinite pressure.
    """
    read, frames = torch.as_tensor(pressure).to(confidence), len(confidence)
    if read.shape not in ((), (frames,)):
        raise MembraneError(f"pressure {list(read.shape)}; expected [{frames}], one reading for each frame, NaN where none is")
    if can_sync(read) and bool(read.isinf().any()):
        raise MembraneError("pressure: inf; expected force / length^2 across the membrane, NaN where there is no reading")
    known = read.isfinite().expand(frames)
    change = torch.where(known, read - rest_pressure, 0.0)
    return torch.stack([change, known.to(change) / deviation**2], -1)


def pulled(corner: tuple[Tensor, Tensor], gauge: Tensor | None, rise: Tensor) -> tuple[Tensor, Tensor]:
    """Minus the gradient in the pressure and its diagonal, `[B]` each, with what the gauge adds.

    Args:
        corner: both without the gauge.
        gauge: `[B, 2]` as of `gauge_reading`, or None.
        rise: `[B]`, of the pressure since rest.
    """
    if gauge is None:
        return corner
    change, weight = gauge.unbind(-1)
    return corner[0] - weight * (rise - change), corner[1] + weight


def gauge_loss(gauge: Tensor | None, rise: Tensor) -> Tensor:
    """`(p - P)^2 / (2 sigma^2)`, `[B]`; arguments as of `pulled`."""
    if gauge is None:
        return torch.zeros_like(rise)
    change, weight = gauge.unbind(-1)
    loss: Tensor = weight * (rise - change).square() / 2
    return loss
