"""Floating-point precision of the solvers."""

from collections.abc import Callable
from contextlib import AbstractContextManager
from typing import Self

import torch
from torch import Tensor, nn

from ..errors import MembraneError
from ..torch_modes import without_autocast

PRECISIONS = (torch.float32, torch.float64)


class FullPrecision(nn.Module):
    """A module that refuses half precision before it rounds the constants, because `.float()` would not restore them."""

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> Self:
        """Convert the constants, as `.to`, `.double()` and the same methods of a module around this one do."""
        check_precision(fn(torch.empty(0, dtype=torch.float32, device="cpu")).dtype)
        converted: Self = super()._apply(fn, recurse)  # type: ignore[no-untyped-call]
        return converted


def full_precision(like: Tensor) -> AbstractContextManager[object]:
    """Return a context without autocast on the device of a tensor, whose precision is checked."""
    check_precision(like.dtype)
    return without_autocast(like.device.type)


def check_precision(dtype: torch.dtype) -> None:
    """Refuse a precision other than float32 and float64."""
    if dtype not in PRECISIONS:
        raise MembraneError(
            f"Reconstructor: {dtype} is not accurate enough for the solver; expected torch.float32 or torch.float64: "
            "convert the other parts of a model only (images may have half precision)"
        )


def rounded_to_float32(matrix: Tensor) -> Tensor:
    """Round a matrix of weights to float32 values, keeping its dtype: more digits would only double the size of exported files.

    Example:
        >>> rounded_to_float32(torch.tensor(0.1, dtype=torch.float64)).item()
        0.10000000149011612
    """
    return matrix.float().to(matrix)
