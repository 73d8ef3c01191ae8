"""Whether a membrane is still as stiff as it was calibrated: known loads are compared with the loads found."""

from collections import deque
from math import sqrt

LEAST_OFF = 0.05
"""By how much forces must be off, over the true ones, before a calibration is due."""
LEAST_DEVIATION = 0.03
"""Smallest relative deviation of a comparison: the error of nine in ten forces after one weight (docs/recipes.md)."""
MEMORY = 4
"""Comparisons that count, the latest."""
SURE = 3.0
"""Standard deviations of their mean."""


class StiffnessWatch:
    """Ratios of found to known loads, the latest `MEMORY`; a membrane that has softened gives ratios above 1.

    A camera sees the membrane's strain, not its modulus: a change of the modulus is noticed only with a known load.

    Example:
        >>> watch = StiffnessWatch()
        >>> for _ in range(4):
        ...     watch.add(found=2.2, known=2.0)
        >>> round(watch.ratio, 3), watch.is_due
        (1.1, True)
    """

    def __init__(self) -> None:
        self._latest: deque[tuple[float, float]] = deque(maxlen=MEMORY)

    def add(self, found: float, known: float, deviation: float = 0.0) -> None:
        """Add one comparison; `deviation` is the standard deviation of the load found, in its unit."""
        self._latest.append((found / known, max(LEAST_DEVIATION, deviation / abs(known))))

    @property
    def ratio(self) -> float:
        """Found over known, the mean of the latest; NaN before there is one."""
        weights = [deviation**-2 for _, deviation in self._latest]
        if not weights:
            return float("nan")
        return sum(weight * ratio for weight, (ratio, _) in zip(weights, self._latest, strict=True)) / sum(weights)

    @property
    def deviation(self) -> float:
        """Standard deviation of the ratio; infinite before there is one."""
        return 1 / sqrt(sum(deviation**-2 for _, deviation in self._latest)) if self._latest else float("inf")

    @property
    def is_due(self) -> bool:
        """Whether the modulus should be calibrated anew."""
        off = abs(self.ratio - 1)
        return off > LEAST_OFF and off > SURE * self.deviation
