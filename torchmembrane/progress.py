"""How a long computation reports its progress: the share of the work that is done, and the step that begins.

A computation takes `progress` and calls it before each step; its caller decides what to show.
"""

from collections.abc import Callable
from typing import TypeAlias

Progress: TypeAlias = Callable[[float, str], object]
"""Called with the share of the work that is done, 0..1 by the time it takes, and the step that begins."""


def silent(share: float, step: str) -> None:
    """Show nothing: the default of computations."""


def within(progress: Progress, first: float, last: float) -> Progress:
    """The progress of a part of the work.

    Args:
        progress: progress of the whole work.
        first: share of the whole at which the part begins.
        last: share of the whole at which it ends.

    Returns:
        What the part calls with shares of its own.

    Example:
        >>> within(lambda share, step: print(f"{share:.2f} {step}"), 0.5, 0.9)(0.5, "force balance")
        0.70 force balance
    """
    return lambda share, step: progress(first + (last - first) * share, step)
