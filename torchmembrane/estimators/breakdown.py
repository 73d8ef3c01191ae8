"""Solves that broke down: of these no gradient is taken."""

import torch
from torch import Tensor

from ..results.status import Status


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
    broken = (status == Status.OK.value) & ~vertices.flatten(1).isfinite().all(1)
    return torch.where(broken, Status.NO_SOLUTION.value, status) if bool(broken.any()) else None
