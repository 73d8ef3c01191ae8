"""Modes of torch that change no result, although a caller has set them: a default device, and autocast."""

from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from functools import wraps
from typing import Any, TypeVar

import torch

Built = TypeVar("Built", bound=Callable[..., Any])


def on_cpu(target: Built) -> Built:
    """Decorate a function or class so that it creates its tensors on the CPU, and without autocast.

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
        if torch.compiler.is_compiling():
            return target(*arguments, **options)
        # within a default device every torch function is called from Python, which a calibration would feel
        device = nullcontext() if torch.get_default_device().type == "cpu" else torch.device("cpu")
        with device, without_autocast("cpu"):
            return target(*arguments, **options)

    return called  # type: ignore[return-value]


def without_autocast(device: str) -> AbstractContextManager[object]:
    """Return a context that disables autocast on a type of device, if it has autocast.

    Example:
        >>> with torch.autocast("cpu"), without_autocast("cpu"):
        ...     (torch.eye(2) @ torch.eye(2)).dtype
        torch.float32
    """
    return torch.autocast(device, enabled=False) if torch.amp.is_autocast_available(device) else nullcontext()
