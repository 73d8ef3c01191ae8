"""A modulus that several measurements tell: forces, a gauge under presses and at rest; joined, and contradictions named."""

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from ..mechanics.cavity import rest_balance
from ..sensor.factories import elastic_energy
from ..sensor.inflated import InflatedSurface
from ..sensor.parts import METRE
from ..sensor.sensor import Sensor

REST_ERROR = 0.05
"""Of the modulus from a gauge at rest, relative: that of the rest shape, whose height enters, and of the reading."""
CONTRADICTING = 2.5  # standard deviations between two measurements, above which it is said


class ModulusEvidence(NamedTuple):
    """What one kind of measurement says of the modulus.

    Attributes:
        source: in words.
        modulus: shear modulus x thickness, force / length.
        deviation: standard deviation, at the prestretch found.
        change: with one standard deviation of the prestretch.
    """

    source: str
    modulus: float
    deviation: float
    change: float


def joined(evidence: Sequence[ModulusEvidence]) -> tuple[ModulusEvidence, list[str]]:
    """The mean of several, by their deviations, and a sentence for each two that contradict one another.

    Where they contradict one another, the deviation grows by their scatter. The prestretch's error, which they share, does not
    average out.

    Example:
        >>> by_force, at_rest = ModulusEvidence("forces", 0.5, 0.05, 0.0), ModulusEvidence("gauge", 0.3, 0.02, 0.0)
        >>> found, said = joined([by_force, at_rest])
        >>> round(found.modulus, 2), said[0].split(":")[0]
        (0.33, 'forces and gauge contradict one another')
    """
    if len(evidence) == 1:
        return evidence[0], []
    modulus, deviation, change = (np.array([one[k] for one in evidence]) for k in (1, 2, 3))
    weight = deviation**-2.0 / (deviation**-2.0).sum()
    mean = float((weight * modulus).sum())
    scatter = (((modulus - mean) / deviation) ** 2).sum() / (len(evidence) - 1)
    width = float((deviation**-2.0).sum() ** -0.5 * max(1.0, scatter) ** 0.5)
    said = []
    for i, one in enumerate(evidence):
        for other in evidence[i + 1 :]:
            apart = abs(one.modulus - other.modulus) / np.hypot(
                np.hypot(one.deviation, other.deviation), one.change - other.change
            )
            if apart > CONTRADICTING:
                told = (f"{each.modulus:.3g} ± {each.deviation:.1g}" for each in (one, other))
                said.append(
                    f"{one.source} and {other.source} contradict one another: moduli of {' and '.join(told)}, {apart:.1f} "
                    "standard deviations apart: one of them, or the rest shape, is wrong"
                )
    return ModulusEvidence("all", mean, width, float((weight * change).sum())), said


def odd_ones(ratios: np.ndarray, deviations: np.ndarray) -> list[tuple[int, float, float]]:
    """Which of several ratios, whose mean counts, the others contradict: each with its ratio to their mean, and by how much.

    Args:
        ratios: `[n]`.
        deviations: `[n]`, relative.

    Returns:
        Index, ratio, and standard deviations apart, of each that is more than `CONTRADICTING` apart from the others.

    Example:
        >>> [(i, round(r, 2)) for i, r, _ in odd_ones(np.array([1.0, 1.02, 1.6, 0.98]), np.full(4, 0.1))]
        [(2, 1.6)]
    """
    found = []
    for i in range(len(ratios)) if len(ratios) > 2 else ():
        others = np.arange(len(ratios)) != i
        weight = deviations[others] ** -2.0
        mean = (weight * ratios[others]).sum() / weight.sum()
        apart = (ratios[i] / mean - 1) / np.hypot(deviations[i], weight.sum() ** -0.5)
        if abs(apart) > CONTRADICTING:
            found.append((i, float(ratios[i] / mean), float(abs(apart))))
    return found


def modulus_at_rest(sensor: Sensor, log_stretch: float, deviation: float, overpressure: float) -> ModulusEvidence:
    """The modulus that holds the rest surface against what a gauge reads there.

    Args:
        sensor: gives rest surface and material.
        log_stretch: logarithm of the prestretch.
        deviation: its standard deviation.
        overpressure: at rest, hPa.
    """
    measured = overpressure * 100 / METRE[sensor.length_unit] ** 2

    def modulus(stretch: float) -> float:
        if isinstance(sensor.surface, InflatedSurface):
            sheet = sensor.surface.made_of(replace(sensor.material, prestretch=max(1.0, stretch)), sensor.length_unit)
            return float(measured / sheet.formed.pressure)
        energy = elastic_energy(sensor, sensor.membrane, prestretch=stretch, modulus=1.0)
        return float(measured / float(rest_balance(sensor.membrane, energy)[0]))

    found, low, high = (modulus(float(np.exp(log_stretch + s * deviation))) for s in (0, -1, 1))
    change = float(np.sign(high - low) * max(abs(low - found), abs(high - found)))
    return ModulusEvidence("the gauge at rest", found, REST_ERROR * found, change)
