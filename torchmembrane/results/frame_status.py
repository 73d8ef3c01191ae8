"""Which frames of a batch are solved."""

import torch
from torch import Tensor

from .status import Status


def is_seen(status: Tensor) -> Tensor:
    """Which frames, `[B]` bool of statuses `[B]` before the solve, are solved: by all views, or by those not left out."""
    return (status == Status.OK.value) | (status == Status.VIEW_LEFT_OUT.value)


def broken_down(status: Tensor, vertices: Tensor) -> Tensor | None:
    """Statuses `[B]` with the frames whose solve broke down said; None where none did, or no gradient is asked for.

    A broken solve passes NaN to all that its gradient reaches, also what the batch's other frames share with it: so it is not
    the one to be differentiated.

    Args:
        status: `[B]`, before the solve.
        vertices: `[B, V, 3]` that it found.
    """
    if torch.compiler.is_compiling() or not isinstance(vertices, Tensor) or not vertices.requires_grad:
        return None
    broken = is_seen(status) & ~vertices.flatten(1).isfinite().all(1)
    return torch.where(broken, Status.NO_SOLUTION.value, status) if bool(broken.any()) else None
