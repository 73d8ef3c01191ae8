"""Units of length, and conversions of length and pressure."""

METRE = {"mm": 1000.0, "cm": 100.0, "m": 1.0, "um": 1e6, "inch": 1 / 0.0254}
"""One metre, in each length unit."""


def millimetre(unit: str) -> float:
    """Return one millimetre in a length unit.

    Args:
        unit: one of `METRE`.

    Example:
        >>> millimetre("um"), millimetre("m")
        (1000.0, 0.001)
    """
    return METRE[unit] / METRE["mm"]


def hectopascal(unit: str) -> float:
    """Return one hPa (100 N/m^2) in N per length unit squared.

    Args:
        unit: unit of length, one of `METRE`.

    Example:
        >>> hectopascal("mm"), hectopascal("m")
        (0.0001, 100.0)
    """
    return 100 / METRE[unit] ** 2
