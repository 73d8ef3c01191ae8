"""Monitoring of the membrane's stiffness: known loads are compared with the reconstructed ones."""

from collections import deque
from math import sqrt

LEAST_OFF = 0.05
"""Relative force error from which a calibration is due."""
LEAST_DEVIATION = 0.03
"""Smallest relative standard deviation of a comparison: nine in ten forces after one weight are within it (docs/recipes.md)."""
MEMORY = 4
"""Number of most recent comparisons that are used."""
SURE = 3.0
"""Significance of a change, in standard deviations of the mean ratio."""


class StiffnessWatch:
    """Ratios of reconstructed to known loads, of the latest `MEMORY` comparisons; a membrane that has softened gives ratios
    above 1.

    A camera measures the membrane's strain, not its modulus: only a known load reveals a change of the modulus.

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
        """Add one comparison; `deviation` is the standard deviation of the reconstructed load, in its unit."""
        self._latest.append((found / known, max(LEAST_DEVIATION, deviation / abs(known))))

    @property
    def ratio(self) -> float:
        """Return the mean ratio of reconstructed to known load in the latest comparisons; NaN before there is one."""
        weights = [deviation**-2 for _, deviation in self._latest]
        if not weights:
            return float("nan")
        return sum(weight * ratio for weight, (ratio, _) in zip(weights, self._latest, strict=True)) / sum(weights)

    @property
    def deviation(self) -> float:
        """Return the standard deviation of the ratio; infinite before there is a comparison."""
        return 1 / sqrt(sum(deviation**-2 for _, deviation in self._latest)) if self._latest else float("inf")

    @property
    def is_due(self) -> bool:
        """Return whether the modulus should be calibrated again."""
        off = abs(self.ratio - 1)
        return off > LEAST_OFF and off > SURE * self.deviation
