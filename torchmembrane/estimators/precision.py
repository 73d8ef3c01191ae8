"""The precision that a solve needs."""

from contextlib import AbstractContextManager, nullcontext

import torch
from torch import Tensor

from ..errors import MembraneError

PRECISIONS = (torch.float32, torch.float64)


def full_precision(device: str) -> AbstractContextManager[object]:
    """A context without autocast, on devices that have one."""
    return torch.autocast(device, enabled=False) if torch.amp.is_autocast_available(device) else nullcontext()


def check_precision(dtype: torch.dtype) -> None:
    """Refuse a module in another precision."""
    if dtype not in PRECISIONS:
        raise MembraneError(
            f"Reconstructor: in {dtype} the solve loses the answer; expected torch.float32 or torch.float64: call .float() "
            "(images may be of half precision)"
        )


def rounded_to_float32(matrix: Tensor) -> Tensor:
    """A matrix of means as single precision holds it: its last digits mean nothing, and a model's file keeps half.

    Example:
        >>> rounded_to_float32(torch.tensor(0.1, dtype=torch.float64)).item()
        0.10000000149011612
    """
    return matrix.float().to(matrix)
