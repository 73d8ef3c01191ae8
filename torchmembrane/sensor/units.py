"""Units of length, and what follows from them."""

METRE = {"mm": 1000.0, "cm": 100.0, "m": 1.0, "um": 1e6, "inch": 1 / 0.0254}
"""One metre in the length unit."""


def millimetre(unit: str) -> float:
    """One millimetre in a length unit.

    Args:
        unit: one of `METRE`.

    Example:
        >>> millimetre("um"), millimetre("m")
        (1000.0, 0.001)
    """
    return METRE[unit] / METRE["mm"]


def hectopascal(unit: str) -> float:
    """One hPa, which is 100 N/m^2, in N per length unit squared.

    Args:
        unit: unit of length, one of `METRE`.

    Example:
        >>> hectopascal("mm"), hectopascal("m")
        (0.0001, 100.0)
    """
    return 100 / METRE[unit] ** 2
