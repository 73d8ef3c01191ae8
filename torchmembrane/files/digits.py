"""The number of digits to write, which depends on the size of a number because lengths may be in any unit."""

import math

import numpy as np

STORED = 7
"""Digits of the largest coordinate in a list of positions: of a membrane of 24 mm, hundredths of a micrometre."""


def decimals(size: float, digits: int) -> int:
    """Decimal places with which a number of this size has `digits` digits; 0 for zero and for numbers that are not finite.

    Example:
        >>> decimals(24.0, 3), decimals(0.024, 3), decimals(24000.0, 3)
        (1, 4, 0)
    """
    return max(0, digits - 1 - math.floor(math.log10(abs(size)))) if size and math.isfinite(size) else 0


def together(values: np.ndarray, digits: int) -> str:
    """Components of a vector with their signs; all have as many decimal places as the largest needs for `digits` digits.

    Example:
        >>> together(np.array([0.00123, -0.04567, 0.0]), 3)
        '+0.0012 -0.0457 +0.0000'
    """
    places = decimals(float(np.abs(values).max(initial=0.0)), digits)
    return " ".join(f"{value:+.{places}f}" for value in values)


def rounded(positions: np.ndarray) -> np.ndarray:
    """Positions `[D, 3]`, rounded to `STORED` digits of their extent.

    Example:
        >>> rounded(np.array([[0.0, 0.0, 1 / 3], [12.0, 0.0, 2 / 3]])).tolist()
        [[0.0, 0.0, 0.33333], [12.0, 0.0, 0.66667]]
    """
    return positions.round(decimals(float(np.ptp(positions, 0).max()), STORED))
