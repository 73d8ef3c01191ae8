"""Modes of torch that change no result, although a caller has set them: a default device."""

from collections.abc import Callable
from contextlib import nullcontext
from functools import wraps
from typing import Any, TypeVar

import torch

Built = TypeVar("Built", bound=Callable[..., Any])


def on_cpu(target: Built) -> Built:
    """Decorate a function or class so that it creates its tensors on the CPU.

    The decorator is for what builds or calibrates. Code that is given tensors creates others on the device of these instead.
    `torch.compile` cannot trace a change of the default device; in a compiled graph the function is called as it is.

    Args:
        target: the function or class to decorate.

    Returns:
        The decorated function; of a class, the class itself.

    Example:
        >>> @on_cpu
        ... def numbers(count):
        ...     return torch.arange(count)
        >>> with torch.device("meta"):
        ...     numbers(3)
        tensor([0, 1, 2])
    """
    if isinstance(target, type):
        target.__init__ = on_cpu(target.__init__)  # type: ignore[misc]
        return target

    @wraps(target)
    def called(*arguments: Any, **options: Any) -> Any:
        with nullcontext() if torch.compiler.is_compiling() else torch.device("cpu"):
            return target(*arguments, **options)

    return called  # type: ignore[return-value]
