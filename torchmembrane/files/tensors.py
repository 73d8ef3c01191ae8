"""Conversion of numbers passed by callers to tensors."""

from typing import Any

import numpy as np
import torch
from torch import Tensor

from ..errors import MembraneError, is_number


def tensor_of(name: str, values: Any) -> Tensor:
    """Convert real numbers to a tensor, independently of torch's default dtype.

    Args:
        name: name of the numbers in error messages.
        values: a tensor, an array, a number, or lists of numbers.

    Raises:
        MembraneError: the values are not numbers, or are complex.

    Example:
        >>> tensor_of("pressure", 0.1).dtype
        torch.float64
    """
    if isinstance(values, Tensor):
        given: Tensor | None = values
    elif isinstance(values, int | float) and is_number(values):
        given = torch.tensor(float(values), dtype=torch.float64, device="cpu")
    else:
        given = _of_array(values)
    if given is None or given.is_complex():
        came = f"of type {given.dtype}" if given is not None else f"{type(values).__name__}"
        raise MembraneError(f"{name}: {came}; expected real numbers: a tensor, an array, a number, or a list of numbers")
    return given


def _of_array(values: Any) -> Tensor | None:
    try:
        array = np.asarray(values)
        return torch.from_numpy(np.require(array, array.dtype.newbyteorder("="), ["C", "W"]))
    except (TypeError, ValueError, OverflowError, RuntimeError):
        return None
