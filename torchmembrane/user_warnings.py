"""Warnings that point to the line in the caller's program, however deep in this package they arise."""

import sys
import warnings

INSIDE = ("torchmembrane", "torch")
"""Packages whose lines are skipped because they do not help the caller."""


def warn_user(message: str) -> None:
    """Warn with the innermost line outside this package and torch as the location.

    Args:
        message: what happened, and how to correct it.

    Example:
        >>> with warnings.catch_warnings(record=True) as said:
        ...     warnings.simplefilter("always")
        ...     warn_user("the rest image has aged")
        >>> str(said[0].message)
        'the rest image has aged'
    """
    level, frame = 1, sys._getframe()
    while frame.f_back is not None and frame.f_globals.get("__name__", "").partition(".")[0] in INSIDE:
        level, frame = level + 1, frame.f_back
    warnings.warn(message, stacklevel=level)
