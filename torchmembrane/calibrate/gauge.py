"""The membrane's stiffness from a gauge: pressures are proportional to the modulus as forces are."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from ..errors import MembraneError

PRESSURE_ERROR = 0.06  # of a pressure change found, relative (docs/calibration.md)
GAUGE_ERROR = 0.005  # of a reading, over the rest pressure
UNSURE = 0.3  # relative standard deviation beyond which readings tell no modulus
CONTRADICTION = 4.0  # standard deviations that a reading may be off
LEAST_RESPONSE = 0.3  # of the pressure to the modulus, logarithms: below, a gas follows its volume, whatever the membrane
STIFFER = 1.1  # modulus with which a gas' response is asked for
ROUNDS = 6


class FoundPressures(NamedTuple):
    """What images show at one modulus: pressure changes since rest and their standard deviations by the markers' noise, `[B]`
    each, and the rest pressure."""

    change: np.ndarray
    deviation: np.ndarray
    rest: float


class GaugeModulus(NamedTuple):
    """The modulus, its standard deviation at the prestretch assumed, and pressure changes found and measured `[B, 2]`."""

    modulus: float
    deviation: float
    pressures: np.ndarray


def modulus_from_pressures(
    found: Callable[[float], FoundPressures], readings: np.ndarray, since_rest: bool, modulus: float, gas: bool
) -> GaugeModulus:
    """The modulus that makes the pressure changes found the measured ones, by weighted least squares.

    Of a liquid, the changes found are proportional to it: `reading = ratio x change`, or where readings are no changes, with
    what the gauge reads at rest as a second unknown: one image at rest and a pressed one tell both. A gas yields; there it is
    solved anew with each modulus, `ratio^(1 / response)` times the one before.

    Args:
        found: what the images show with a modulus.
        readings: `[B]`, force / length^2, NaN where there is none.
        since_rest: whether they are changes since rest.
        modulus: to begin with, force / length.
        gas: whether the cavity holds a gas.

    Raises:
        MembraneError: nothing is pressed, or too little; the readings contradict the images or one another; a gas' pressure
            tells its volume, not the membrane.
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
            f"calibrate material: the readings contradict one another: image {worst + 1}'s is {readings[worst]:.4g}, by the "
            f"others {ratio * at.change[worst] + offset:.4g}; expected readings of one gauge, taken with the images, of a "
            "cavity that does not leak"
        )
    scatter = max(1.0, np.sqrt(np.nansum(off**2) / spare)) if spare else 1.0
    return GaugeModulus(modulus, modulus * deviation * scatter / response, np.stack([at.change, readings - offset], -1))


def _line(change: np.ndarray, readings: np.ndarray, sigma: np.ndarray, since_rest: bool) -> tuple[float, float, float]:
    """Slope of the readings over the changes found, the reading where nothing changes, and the slope's relative deviation."""
    w = sigma**-2
    centre = 0.0 if since_rest else (w * change).sum() / w.sum()
    information = (w * (change - centre) ** 2).sum()
    if information * UNSURE**2 < 1:
        remedy = "pressed images with their readings" if since_rest else "an image at rest and pressed ones with their readings"
        raise MembraneError(
            "calibrate material: the images with readings show pressure changes of at most "
            f"{np.abs(change - centre).max():.3g}, too little to tell a modulus; expected {remedy}"
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
    """How a gas' pressure changes follow the modulus, by logarithms: 1 as a liquid's, 0 where the gas alone determines them."""
    response = float(np.log((change * stiffer).sum() / (change**2).sum()) / np.log(STIFFER))
    if not response > LEAST_RESPONSE:
        raise MembraneError(
            "calibrate material: the gas is so soft that its pressure tells how much volume the press takes, not how stiff the "
            "membrane is; expected a smaller cavity, or presses of known force, --forces"
        )
    return response
