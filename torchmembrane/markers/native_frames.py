"""Calls of machine code that works on the tensors of several frames, in single precision."""

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ..machine_code import Kept, compiled, in_threads, takes

KEPT_STEPS: dict[Any, Kept] = {}
"""The functions `found_by` can call, of constants and frames, which fill an array of results: whether each is compiled."""


def is_native(*values: Tensor) -> bool:
    """Return whether machine code computes with these tensors."""
    return all(value.dtype == torch.float32 for value in values) and takes(*values)


def found_by(function: Any, constants: tuple[Any, ...], given: tuple[Tensor, ...], *shape: int) -> Tensor:
    """Return the results `[B, *shape]` of one of `KEPT_STEPS`, from the constants of a pattern, arrays, and the tensors `given`
    of the frames."""
    frames = next((len(value) for value in given if len(value) != 1), 1)
    found = given[0].new_empty(frames, *shape)
    with KEPT_STEPS[function].compiling(np.dtype(np.float32)):
        each = [_array(value, frames) for value in given]
        in_threads(partial(function, constants), *each, found.numpy())
    return found


def _array(value: Tensor, frames: int) -> np.ndarray:
    """Return a tensor of the frames, or one for all of them, as a contiguous array."""
    if len(value) != frames:
        value = value.expand(frames, *value.shape[1:])
    return value.contiguous().numpy()


@compiled
def largest(values, found):
    """Write the indices of the largest of the values to `found`, the largest first, and return how many there are; numpy's
    sorting would take seconds to compile."""
    size = 0
    for n in range(len(values)):
        if size < len(found) or values[n] > values[found[size - 1]]:
            size, k = min(size + 1, len(found)), min(size, len(found) - 1)
            while k > 0 and values[n] > values[found[k - 1]]:
                found[k] = found[k - 1]
                k -= 1
            found[k] = n
    return size


class Constants:
    """The constants of a pattern, as arrays. They are looked up again after a move to another device.

    Args:
        function: returns them, from the module that holds the pattern.
    """

    def __init__(self, function: Callable[..., Any]):
        self.function = function
        self.known: tuple[Tensor, Any] | None = None

    def __reduce__(self) -> tuple[Any, tuple[Callable[..., Any]]]:
        return type(self), (self.function,)

    def of(self, owner: Any, buffer: Tensor) -> Any:
        """Return the constants of `owner`, as long as `buffer` is the same tensor."""
        if self.known is None or self.known[0] is not buffer:
            self.known = buffer, self.function(owner)
        return self.known[1]
