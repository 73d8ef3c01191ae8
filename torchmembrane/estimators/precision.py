"""Floating-point precision of the solvers."""

from contextlib import AbstractContextManager, nullcontext

import torch
from torch import Tensor

from ..errors import MembraneError

PRECISIONS = (torch.float32, torch.float64)


def full_precision(device: str) -> AbstractContextManager[object]:
    """Return a context that disables autocast on devices that have it."""
    return torch.autocast(device, enabled=False) if torch.amp.is_autocast_available(device) else nullcontext()


def check_precision(dtype: torch.dtype) -> None:
    """Refuse a precision other than float32 and float64."""
    if dtype not in PRECISIONS:
        raise MembraneError(
            f"Reconstructor: {dtype} is not accurate enough for the solver; expected torch.float32 or torch.float64: call "
            ".float() (images may have half precision)"
        )


def rounded_to_float32(matrix: Tensor) -> Tensor:
    """Round a matrix of weights to float32 values, keeping its dtype: more digits would only double the size of exported files.

    Example:
        >>> rounded_to_float32(torch.tensor(0.1, dtype=torch.float64)).item()
        0.10000000149011612
    """
    return matrix.float().to(matrix)
