"""The number of decimal places to write, chosen by the size of a number because lengths may have any unit."""

import math

import numpy as np

STORED = 7
"""Significant digits of the largest coordinate in a stored list of positions: 0.01 um for a membrane of 24 mm."""


def decimals(size: float, digits: int) -> int:
    """Return the number of decimals that shows a number of this size with `digits` digits; 0 for zero and non-finite numbers.

    Example:
        >>> decimals(24.0, 3), decimals(0.024, 3), decimals(24000.0, 3)
        (1, 4, 0)
    """
    return max(0, digits - 1 - math.floor(math.log10(abs(size)))) if size and math.isfinite(size) else 0


def together(values: np.ndarray, digits: int) -> str:
    """Format the components of a vector with signs; all get the number of decimals that the largest needs for `digits` digits.

    Example:
        >>> together(np.array([0.00123, -0.04567, 0.0]), 3)
        '+0.0012 -0.0457 +0.0000'
    """
    places = decimals(float(np.abs(values).max(initial=0.0)), digits)
    return " ".join(f"{value:+.{places}f}" for value in values)


def rounded(positions: np.ndarray) -> np.ndarray:
    """Return positions `[D, 3]` rounded to `STORED` significant digits of their extent.

    Example:
        >>> rounded(np.array([[0.0, 0.0, 1 / 3], [12.0, 0.0, 2 / 3]])).tolist()
        [[0.0, 0.0, 0.33333], [12.0, 0.0, 0.66667]]
    """
    return positions.round(decimals(float(np.ptp(positions, 0).max()), STORED))
