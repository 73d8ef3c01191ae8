"""Selection of the frames of a batch that are solved."""

import torch
from torch import Tensor

from .status import Status


def is_seen(status: Tensor) -> Tensor:
    """Return which frames are solved, `[B]` bool, from their statuses `[B]` before the solve; a view may have been left out."""
    return (status == Status.OK.value) | (status == Status.VIEW_LEFT_OUT.value)


def broken_down(status: Tensor, vertices: Tensor) -> Tensor | None:
    """Return the statuses `[B]` with failed solves marked, or None if no solve failed or no gradient is recorded.

    A failed solve passes NaN to everything that its gradient reaches, including what it shares with the other frames of the
    batch; therefore the batch must be solved again without it before it is differentiated.

    Args:
        status: statuses before the solve, `[B]`.
        vertices: the solution, `[B, V, 3]`.
    """
    if torch.compiler.is_compiling() or not isinstance(vertices, Tensor) or not vertices.requires_grad:
        return None
    broken = is_seen(status) & ~vertices.flatten(1).isfinite().all(1)
    return torch.where(broken, Status.NO_SOLUTION.value, status) if bool(broken.any()) else None
