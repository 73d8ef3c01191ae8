"""The modulus from several measurements: forces, and a gauge during presses and at rest; contradictions are reported."""

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import ndtr, ndtri

from ..errors import MembraneError, expect
from ..mechanics.cavity import rest_balance
from ..sensor.factories import AMBIENT, elastic_energy
from ..sensor.inflated import InflatedSurface
from ..sensor.sensor import Sensor
from ..sensor.units import hectopascal

REST_ERROR = 0.05  # relative standard deviation of the modulus from a gauge at rest, due to the grid and the reading
FORCE_ERROR = 0.1  # relative standard deviation of force balance on presses of known force (docs/calibration.md)
PROBABILITY = 0.95  # of intervals
REACH, SHIFTS = 8.0, 401  # range of prestretches over which probabilities are summed (standard deviations), and their number
FINE = 401  # number of values at which the distribution function is computed for an interval
CONTRADICTING = 2.5  # standard deviations between two measurements above which they contradict one another


class KnownPressures(NamedTuple):
    """Readings of a pressure gauge.

    Attributes:
        readings: the reading for each image, `[B]`, N per length unit squared; NaN if unknown.
        since_rest: whether readings are changes since rest; if not, the reading at rest is estimated as well.
    """

    readings: np.ndarray
    since_rest: bool = False


class KnownForces(NamedTuple):
    """Known forces of presses.

    Attributes:
        forces: total force on the membrane, N: `[B, 3]` in the camera's frame, or magnitudes `[B, 1]`; NaN if unknown.
        deviations: standard deviations of the magnitudes, `[B]`, N; None or NaN: negligible compared with `FORCE_ERROR`.
    """

    forces: np.ndarray
    deviations: np.ndarray | None = None

    @property
    def relative(self) -> np.ndarray:
        """Relative standard deviation of each known force, including `FORCE_ERROR`."""
        size = np.linalg.norm(self.forces, axis=1)
        own = np.zeros_like(size) if self.deviations is None else np.nan_to_num(self.deviations) / size
        return np.hypot(FORCE_ERROR, own)[np.isfinite(size)]


def refuse_overpressure(what: str, overpressure: float | None, sensor: Sensor) -> None:
    """Refuse a gauge reading at rest, hPa, that is no overpressure, or as large as the absolute pressure of a gas.

    Args:
        what: name of the calibration, for the message.
        overpressure: the reading, if there is one.
        sensor: the sensor.

    Raises:
        MembraneError: the reading is no positive number, or leaves less than `AMBIENT` outside a gas.
    """
    if overpressure is None:
        return
    expect(0 < overpressure < np.inf, f"{what}: overpressure", overpressure, "a positive reading at rest, inside minus outside")
    absolute = sensor.cavity.pressure if sensor.cavity.filling == "gas" else None
    if absolute is not None and absolute - overpressure < AMBIENT[0]:
        raise MembraneError(
            f"{what}: overpressure = {overpressure:g} hPa, of the gas' {absolute:g} hPa in all; expected inside minus outside: "
            "subtract the atmosphere's pressure from the reading of an absolute gauge, or correct [cavity] pressure"
        )


class ModulusEvidence(NamedTuple):
    """The modulus inferred from one kind of measurement.

    Attributes:
        source: name of the measurement, for messages.
        modulus: shear modulus x thickness, force / length.
        deviation: standard deviation of the modulus at the inferred prestretch.
        change: change of the modulus for one standard deviation of the prestretch.
        by_height: change of the modulus for one standard deviation of the rest surface's height.
        sides: the modulus at a prestretch one standard deviation lower and higher. If given, the logarithm of the modulus is
            modelled as a parabola in the log prestretch; if None, as a straight line.
    """

    source: str
    modulus: float
    deviation: float
    change: float
    by_height: float = 0.0
    sides: tuple[float, float] | None = None


class JoinedEvidence(NamedTuple):
    """Prestretch and modulus inferred from all measurements.

    Attributes:
        shift: shift of the logarithm of the prestretch, in its standard deviations.
        modulus: shear modulus x thickness, force / length.
        height: increase of the rest surface's height over the given one, in its standard deviations.
        covariance: covariance of shift, logarithm of the modulus, and height, `[3, 3]`.
        contradictions: a sentence for each pair of measurements that contradict one another.
        intervals: lower and upper bounds of 95 % intervals of the shift and of the modulus, `[2, 2]`.
    """

    shift: float
    modulus: float
    height: float
    covariance: np.ndarray
    contradictions: list[str]
    intervals: np.ndarray


def joined(
    evidence: Sequence[ModulusEvidence],
    by_height: float = 0.0,
    height: tuple[float, float] = (0.0, 1.0),
    least: float = -np.inf,
) -> JoinedEvidence:
    """Find the prestretch's shift `t`, the modulus `m` and the height `h` that fit several measurements, by least squares:

        (t - b h)^2 + (h - h0)^2 / s0^2 + sum_i (log m - log m_i(t) - c_i h)^2 / s_i^2,
        log m_i(t) = log m_i + g_i t,    s_i = deviation / modulus,  g_i = change / modulus,  c_i = by_height / modulus

    The first term is the prestretch inferred from the shapes of presses. The true rest surface may be higher than the given one
    by `h` standard deviations. The modulus from each measurement depends differently on prestretch and height, so that two
    measurements also constrain these. If measurements disagree, the covariance is enlarged by their scatter. If `log m_i` is a
    parabola (as for a slack sheet, whose modulus grows ever faster as its prestretch approaches 1), the probability
    `exp(-sum of squares / 2)` is integrated over `t` numerically.

    Args:
        evidence: the modulus from each measurement.
        by_height: `b`, the shift inferred from the shapes for one standard deviation of the height.
        height: `h0` and `s0`, prior mean and standard deviation of the height.
        least: smallest possible shift.

    Example:
        >>> by_force, at_rest = ModulusEvidence("forces", 0.5, 0.05, 0.0), ModulusEvidence("gauge", 0.3, 0.02, 0.0)
        >>> found = joined([by_force, at_rest])
        >>> round(found.modulus, 2), found.contradictions[0].split(":")[0]
        (0.35, 'forces and gauge contradict one another')
    """
    modulus, deviation, change, higher = (np.array([one[k] for one in evidence]) for k in (1, 2, 3, 4))
    s, g, c = deviation / modulus, change / modulus, higher / modulus
    mean, spread = height
    rows = np.vstack([[1.0, 0.0, -by_height], [0.0, 0.0, 1 / spread], np.stack([-g, np.ones(len(s)), -c], 1) / s[:, None]])
    values = np.concatenate([[0.0, mean / spread], np.log(modulus) / s])
    covariance = np.linalg.inv(rows.T @ rows)
    x = covariance @ rows.T @ values
    off, is_bent = rows @ x - values, any(one.sides for one in evidence)
    about = x[0], covariance[0, 0] ** 0.5
    if is_bent:
        x, covariance, off = _summed(evidence, rows, values, about, least)
    at, said = x[1] - s * off[2:], []
    scatter = max(1.0, (off**2).sum() / max(len(s) - 1, 1))
    covariance = scatter * covariance
    intervals = x[:2, None] + normal_interval(covariance.diagonal()[:2, None] ** 0.5)
    if is_bent:
        intervals = _bent_intervals(evidence, rows, values, about, least, scatter)
    for i, one in enumerate(evidence):
        for k in range(i + 1, len(evidence)):
            apart = abs(at[i] - at[k]) / np.hypot(s[i], s[k])
            if apart > CONTRADICTING:
                told = (f"{np.exp(at[j]):.3g} ± {np.exp(at[j]) * s[j]:.1g}" for j in (i, k))
                said.append(
                    f"{one.source} and {evidence[k].source} contradict one another: moduli of {' and '.join(told)}, "
                    f"{apart:.1f} standard deviations apart: one of them, or the rest shape, is wrong"
                )
    intervals[1] = np.exp(intervals[1])
    return JoinedEvidence(float(x[0]), float(np.exp(x[1])), float(x[2]), covariance, said, intervals)


def normal_interval(deviation: ArrayLike) -> np.ndarray:
    """Return the bounds, relative to the mean, of the interval that a normal variable is in with probability `PROBABILITY`,
    `[..., 2]`, from its standard deviation `[..., 1]`.

    Example:
        >>> normal_interval([1.0]).round(2).tolist()
        [-1.96, 1.96]
    """
    tails = np.array([1 - PROBABILITY, 1 + PROBABILITY]) / 2
    interval: np.ndarray = np.asarray(deviation) * ndtri(tails)
    return interval


def _summed(
    evidence: Sequence[ModulusEvidence], rows: np.ndarray, values: np.ndarray, about: tuple[float, float], least: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return mean and covariance of shift, log modulus and height, and the residuals at the mean shift, if logarithms of moduli
    are parabolas: at each shift, modulus and height are found by least squares and weighted with the shift's probability."""
    t = _shifts(*about, least)
    best, off, covariance = _best(evidence, rows, values, t)
    weight, x = _probabilities(off), np.column_stack([t, best])
    mean = weight @ x
    spread = (weight[:, None] * (x - mean)).T @ (x - mean)
    spread[1:, 1:] += covariance
    return mean, spread, _best(evidence, rows, values, mean[:1])[1][0]


def _bent_intervals(
    evidence: Sequence[ModulusEvidence],
    rows: np.ndarray,
    values: np.ndarray,
    about: tuple[float, float],
    least: float,
    scatter: float,
) -> np.ndarray:
    """Return the 95 % intervals of the shift and of the log modulus, `[2, 2]`, with the evidence's log moduli modelled as
    parabolas in the shift, and all variances multiplied by `scatter`. `about`: mean and standard deviation of the shift with
    straight lines instead of parabolas; `least`: smallest possible shift."""
    t = _shifts(about[0], about[1] * scatter**0.5, least)
    best, off, covariance = _best(evidence, rows, values, t)
    weight, width = _probabilities(off, scatter), (scatter * covariance[0, 0]) ** 0.5
    return np.stack([_interval(weight, t, t[1] - t[0]), _interval(weight, best[:, 0], width)])


def _shifts(middle: float, deviation: float, least: float) -> np.ndarray:
    """Return the shifts over which probabilities are summed, `[n]`."""
    t = middle + deviation * np.linspace(-REACH, REACH, SHIFTS)
    return t[t >= least] if (t >= least).any() else np.array([least, least + 1e-9])


def _best(
    evidence: Sequence[ModulusEvidence], rows: np.ndarray, values: np.ndarray, t: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the least-squares log modulus and height at shifts `t [n]`, `[n, 2]`, the residuals of the R rows, `[n, R]`, and
    the covariance at a given shift, `[2, 2]`."""
    wanted = values - t[:, None] * rows[:, 0]
    for i, one in enumerate(evidence):
        if one.sides:
            low, high = np.log(np.array(one.sides) / one.modulus)
            parabola = np.log(one.modulus) + (high - low) / 2 * t + (high + low) / 2 * t**2
            wanted[:, 2 + i] = parabola * one.modulus / one.deviation
    others = rows[:, 1:]
    covariance = np.linalg.inv(others.T @ others)
    solved = others @ covariance
    return wanted @ solved, wanted @ (solved @ others.T) - wanted, covariance


def _probabilities(off: np.ndarray, scatter: float = 1.0) -> np.ndarray:
    """Return the normalised probabilities `[n]` of residuals `off [n, R]`, each of which has the variance `scatter`."""
    loss = (off**2).sum(1) / (2 * scatter)
    weight: np.ndarray = np.exp(loss.min() - loss)
    return weight / weight.sum()


def _interval(weight: np.ndarray, means: np.ndarray, deviation: float) -> np.ndarray:
    """Return the bounds of the interval with probability `PROBABILITY`, `[2]`, of a mixture of normal distributions with
    these means `[n]`, weights `[n]` and common standard deviation."""
    value = np.linspace(means.min() - REACH * deviation, means.max() + REACH * deviation, FINE)
    below = ndtr((value[:, None] - means) / deviation) @ weight
    return np.interp([(1 - PROBABILITY) / 2, (1 + PROBABILITY) / 2], below, value)


def odd_ones(ratios: np.ndarray, deviations: np.ndarray) -> list[tuple[int, float, float]]:
    """Find the ratios that contradict all others.

    Args:
        ratios: the ratios, `[n]`.
        deviations: their relative standard deviations, `[n]`.

    Returns:
        For each ratio more than `CONTRADICTING` standard deviations from the mean of the others: its index, its ratio to that
        mean, and the number of standard deviations.

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


def modulus_at_rest(
    sensor: Sensor, log_stretch: float, deviation: float, overpressure: float, other: Sensor | None = None
) -> ModulusEvidence:
    """Return the modulus with which the rest surface is in equilibrium with the measured overpressure.

    Args:
        sensor: the sensor with rest surface and material.
        log_stretch: logarithm of the prestretch.
        deviation: standard deviation of `log_stretch`.
        overpressure: gauge reading at rest, hPa.
        other: the sensor with a rest surface whose height differs by one standard deviation.
    """
    measured = overpressure * hectopascal(sensor.length_unit)

    def modulus(stretch: float, sensor: Sensor = sensor) -> float:
        if isinstance(sensor.surface, InflatedSurface):
            sheet = sensor.surface.made_of(replace(sensor.material, prestretch=max(1.0, stretch)), sensor.length_unit)
            return float(measured / sheet.formed.pressure)
        energy = elastic_energy(sensor, sensor.membrane, prestretch=stretch, modulus=1.0)
        return float(measured / float(rest_balance(sensor.membrane, energy)[0]))

    found, low, high = (modulus(float(np.exp(log_stretch + s * deviation))) for s in (0, -1, 1))
    change = float(np.sign(high - low) * max(abs(low - found), abs(high - found)))
    by_height = 0.0 if other is None else modulus(float(np.exp(log_stretch)), other) - found
    return ModulusEvidence("the gauge at rest", found, REST_ERROR * found, change, by_height, (low, high))
