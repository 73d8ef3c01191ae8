"""The order of frames by their names."""

import re
from pathlib import Path

NUMBER = re.compile("([0-9]+)")


def in_order(name: str | Path) -> tuple[list[tuple[int, str]], str]:
    """A key to sort names or paths by: numbers within them count as numbers, whatever their zeros before.

    Example:
        >>> sorted(["f_10", "f_2", "f_1", "e_11"], key=in_order)
        ['e_11', 'f_1', 'f_2', 'f_10']
    """
    parts = NUMBER.split(str(name))  # texts at even places, numbers at odd ones
    digits = [part.lstrip("0") for part in parts]
    return [(len(digits[k]), digits[k]) if k % 2 else (-1, part) for k, part in enumerate(parts)], str(name)
