"""The membrane's modulus from a pressure gauge: like forces, pressures are proportional to the modulus."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from ..errors import MembraneError

PRESSURE_ERROR = 0.06  # relative standard deviation of a reconstructed pressure change (docs/calibration.md)
GAUGE_ERROR = 0.005  # standard deviation of a reading, over the rest pressure
UNSURE = 0.3  # relative standard deviation beyond which readings do not determine a modulus
CONTRADICTION = 4.0  # largest deviation of a reading, standard deviations
LEAST_RESPONSE = 0.3  # smallest d log pressure / d log modulus: below, the gas alone determines the pressure
STIFFER = 1.1  # factor of the modulus with which a gas' response is computed
ROUNDS = 6


class FoundPressures(NamedTuple):
    """Pressures reconstructed from images with one modulus: changes since rest and their standard deviations due to the
    markers' noise, `[B]` each, and the rest pressure."""

    change: np.ndarray
    deviation: np.ndarray
    rest: float


class GaugeModulus(NamedTuple):
    """The modulus, its standard deviation at the given prestretch, and reconstructed and measured pressure changes `[B, 2]`."""

    modulus: float
    deviation: float
    pressures: np.ndarray


def modulus_from_pressures(
    found: Callable[[float], FoundPressures], readings: np.ndarray, since_rest: bool, modulus: float, gas: bool
) -> GaugeModulus:
    """Fit the modulus such that the reconstructed pressure changes equal the measured ones, by weighted least squares.

    With a liquid, the reconstructed changes are proportional to the modulus: `reading = ratio x change`. If readings are not
    changes since rest, the reading at rest is a second unknown; one image at rest and one of a press determine both. With a
    gas, which is compressible, the presses are solved again for each modulus, `ratio^(1 / response)` times the one before.

    Args:
        found: function from a modulus to the pressures reconstructed with it.
        readings: gauge readings, `[B]`, force / length^2; NaN where there is none.
        since_rest: whether readings are changes since rest.
        modulus: initial modulus, force / length.
        gas: whether the cavity holds a gas.

    Raises:
        MembraneError: the pressure changes are too small, the readings contradict the images or one another, or a gas' pressure
            depends on its volume rather than on the membrane.
    """
    known, response = np.isfinite(readings), 1.0
    if gas:
        response = _response(found(modulus).change[known], found(STIFFER * modulus).change[known])
    for _ in range(ROUNDS if gas else 1):
        at = found(modulus)
        sigma = np.sqrt((PRESSURE_ERROR * at.change) ** 2 + at.deviation**2 + (GAUGE_ERROR * at.rest) ** 2)
        ratio, offset, deviation = _line(at.change[known], readings[known], sigma[known], since_rest)
        modulus *= ratio ** (1 / response)
    off = (readings - offset - ratio * at.change) / (ratio * sigma)
    spare = known.sum() - (1 if since_rest else 2)
    worst = int(np.nanargmax(abs(off)))
    if spare and abs(off[worst]) > CONTRADICTION:
        raise MembraneError(
            f"calibrate material: the readings contradict each other: that of image {worst + 1} (in the order of the call) is "
            f"{readings[worst]:.4g}, and the others predict {ratio * at.change[worst] + offset:.4g}, in force / length^2 "
            "(1 hPa = 1e-4 N/mm^2); expected readings of one gauge, taken with the images, of a cavity that does not leak"
        )
    scatter = max(1.0, np.sqrt(np.nansum(off**2) / spare)) if spare else 1.0
    return GaugeModulus(modulus, modulus * deviation * scatter / response, np.stack([at.change, readings - offset], -1))


def _line(change: np.ndarray, readings: np.ndarray, sigma: np.ndarray, since_rest: bool) -> tuple[float, float, float]:
    """Return the slope of readings over reconstructed changes, the reading at no change, and the slope's relative deviation."""
    w = sigma**-2
    centre = 0.0 if since_rest else (w * change).sum() / w.sum()
    information = (w * (change - centre) ** 2).sum()
    if information * UNSURE**2 < 1:
        remedy = "pressed images with their readings" if since_rest else "an image at rest and pressed ones with their readings"
        raise MembraneError(
            "calibrate material: in the images with readings, the reconstructed pressure varies by at most "
            f"{np.abs(change - centre).max():.3g} (force / length^2), too little to determine the modulus; expected {remedy}"
        )
    slope = (w * (change - centre) * readings).sum() / information
    if not slope > 0:
        raise MembraneError(
            "calibrate material: the readings fall where the images show that the pressure rises; expected readings taken with "
            "these images, inside less outside"
        )
    offset = 0.0 if since_rest else (w * (readings - slope * change)).sum() / w.sum()
    return float(slope), float(offset), float(information**-0.5)


def _response(change: np.ndarray, stiffer: np.ndarray) -> float:
    """Return d log pressure change / d log modulus: 1 as for a liquid, 0 if the gas alone determines the pressure."""
    response = float(np.log((change * stiffer).sum() / (change**2).sum()) / np.log(STIFFER))
    if not response > LEAST_RESPONSE:
        raise MembraneError(
            "calibrate material: the gas is so compliant that its pressure depends on the displaced volume, not on how stiff "
            "the membrane is; expected a smaller cavity, or presses of known force, --forces"
        )
    return response
