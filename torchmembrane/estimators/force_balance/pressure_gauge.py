"""A pressure gauge in the cavity: its reading is one more residual of the solver.

A measured pressure `P` with the standard deviation `sigma` adds `(p - P)^2 / (2 sigma^2)` to the objective. In a step's row of
the pressure this is `1 / sigma^2` on the diagonal and `(p - P) / sigma^2` in the gradient. Both pressures are taken relative to
rest, because every grid has its own rest pressure. Without a reading the weight is zero.
"""

import torch
from torch import Tensor

from ...control_flow import can_sync
from ...errors import MembraneError


def refuse_open(filling: str) -> None:
    """Refuse a gauge for an open cavity, whose pressure is known."""
    if filling == "open":
        raise MembraneError(
            "pressure: the cavity is open, so its pressure stays at rest and a gauge adds nothing; leave it out, or describe "
            "the cavity as a liquid or a gas"
        )


def gauge_reading(pressure: Tensor | float, rest_pressure: Tensor, deviation: float, confidence: Tensor) -> Tensor:
    """Return the measured change of the pressure from rest and its weight `1 / sigma^2`, `[B, 2]`; zero without a reading.

    Args:
        pressure: measured pressure difference across the membrane, `[B]` or `[]`, NaN without a reading.
        rest_pressure: rest pressure of the grid whose pressure is reported, `[]`.
        deviation: sigma, force / length^2.
        confidence: confidence of the frames' markers, `[B, D]`; it gives the batch size.

    Raises:
        MembraneError: the pressure has another shape, or is infinite.
    """
    read, frames = torch.as_tensor(pressure, device=confidence.device).to(confidence), len(confidence)
    if read.shape not in ((), (frames,)):
        raise MembraneError(f"pressure {list(read.shape)}; expected [{frames}], one reading per frame, NaN if there is none")
    if can_sync(read) and bool(read.isinf().any()):
        raise MembraneError("pressure: inf; expected force / length^2 across the membrane, NaN if there is no reading")
    known = read.isfinite().expand(frames)
    change = torch.where(known, read - rest_pressure, 0.0)
    return torch.stack([change, known.to(change) / deviation**2], -1)


def pulled(corner: tuple[Tensor, Tensor], gauge: Tensor | None, rise: Tensor) -> tuple[Tensor, Tensor]:
    """Add a gauge to the negative gradient in the pressure and to the pressure's diagonal element, `[B]` each.

    Args:
        corner: both without the gauge.
        gauge: `[B, 2]` from `gauge_reading`, or None.
        rise: change of the pressure from rest, `[B]`.
    """
    if gauge is None:
        return corner
    change, weight = gauge.unbind(-1)
    return corner[0] - weight * (rise - change), corner[1] + weight


def gauge_loss(gauge: Tensor | None, rise: Tensor) -> Tensor:
    """Return the loss of the gauge, `(p - P)^2 / (2 sigma^2)`, `[B]`; arguments as for `pulled`."""
    if gauge is None:
        return torch.zeros_like(rise)
    change, weight = gauge.unbind(-1)
    loss: Tensor = weight * (rise - change).square() / 2
    return loss
