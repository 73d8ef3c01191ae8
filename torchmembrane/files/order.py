"""The order of frames by their names, and a warning if their times are in another order."""

import re
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TypeVar

from ..user_warnings import warn_user

Item = TypeVar("Item")
NUMBER = re.compile("([0-9]+)")
APART = 1.0
"""Smallest difference of file times in seconds that counts: copied files may all have been written at about the same time."""


def in_order(name: str | Path) -> tuple[list[tuple[int, str]], str]:
    """Return a sort key for names or paths in which numbers are compared by value, without regard to leading zeros.

    Example:
        >>> sorted(["f_10", "f_2", "f_1", "e_11"], key=in_order)
        ['e_11', 'f_1', 'f_2', 'f_10']
    """
    parts = NUMBER.split(str(name))  # texts at even places, numbers at odd ones
    digits = [part.lstrip("0") for part in parts]
    return [(len(digits[k]), digits[k]) if k % 2 else (-1, part) for k, part in enumerate(parts)], str(name)


def evenly(items: Sequence[Item], most: int) -> list[Item]:
    """Return at most `most` of the items, evenly spaced, with the first and the last.

    Example:
        >>> evenly("abcdefg", 3), evenly("ab", 3)
        (['a', 'd', 'g'], ['a', 'b'])
    """
    count = len(items)
    if count <= most:
        return list(items)
    return [items[round(k * (count - 1) / (most - 1))] for k in range(most)]


def warn_of_times(frames: Iterable[tuple[str, float]]) -> None:
    """Warn if frames that are used in the order of their names were taken in a different order.

    Args:
        frames: name and time (s) of each frame, in the order in which they are used.

    Example:
        >>> warn_of_times([("f_9", 100.0), ("f_10", 103.0), ("f_11", 102.5)])  # too little apart to tell
    """
    latest, at = "", -float("inf")
    for name, time in frames:
        if time < at - APART:
            warn_user(
                f"{name} follows {latest} by the numbers in their names, but is older by {at - time:.0f} s; the order of the "
                "names is taken. If the other order is meant, rename the files"
            )
            return
        if time > at:
            latest, at = name, time


def warn_of_file_times(paths: Iterable[Path]) -> None:
    """Warn as `warn_of_times` does, by the modification times of files; missing files are ignored."""
    warn_of_times((path.name, path.stat().st_mtime) for path in paths if path.exists())
