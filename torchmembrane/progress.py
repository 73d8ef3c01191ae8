"""Progress reports of long computations: the completed share of the work, and the step that begins.

A computation takes an argument `progress` and calls it before each step; the caller decides what to show.
"""

from collections.abc import Callable
from typing import TypeAlias

Progress: TypeAlias = Callable[[float, str], object]
"""A function called with the completed share of the work (0..1, measured in time) and the step that begins."""


def silent(share: float, step: str) -> None:
    """Show nothing; this is the default of all computations."""


def within(progress: Progress, first: float, last: float) -> Progress:
    """Return the progress function of a part of the work.

    Args:
        progress: progress function of the whole work.
        first: share of the whole at which the part begins.
        last: share of the whole at which it ends.

    Returns:
        A function that the part calls with the completed share of its own work.

    Example:
        >>> within(lambda share, step: print(f"{share:.2f} {step}"), 0.5, 0.9)(0.5, "force balance")
        0.70 force balance
    """
    return lambda share, step: progress(first + (last - first) * share, step)
