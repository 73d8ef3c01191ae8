"""Make the mechanics of a sensor's membrane: its elastic energy and its cavity."""

from typing import NamedTuple

from ..errors import MembraneError
from ..forming.sheet_energy import SheetEnergy
from ..mechanics.cavity import rest_balance
from ..mechanics.hyperelastic import ElasticEnergy
from ..surface.membrane import Membrane
from ..user_warnings import warn_user
from .inflated import InflatedSurface
from .sensor import Sensor
from .units import hectopascal

AMBIENT = (300.0, 5000.0)
"""Range of the pressure outside a membrane, hPa, from the highest mountains to a pressure chamber."""
LEAST_VOLUME = 1e-6
"""Smallest volume of a gas between rim and rest surface, over the cube of the surface's size; rounding leaves less."""


class CavityFilling(NamedTuple):
    """The filling of a cavity, in the form that estimators and the simulator take.

    Attributes:
        filling: "liquid" | "gas" | "open".
        gas: absolute pressure (force / length^2) and volume (length^3) of a gas at rest; None for other fillings.
    """

    filling: str
    gas: tuple[float, float] | None = None


def elastic_energy(
    sensor: Sensor,
    membrane: Membrane,
    model: str | None = None,
    *,
    prestretch: float | None = None,
    modulus: float | None = None,
) -> ElasticEnergy:
    """Return the elastic energy of a sensor's material on a membrane of any grid.

    Args:
        sensor: the sensor whose material is used.
        membrane: the rest surface, such as `sensor.membrane`.
        model: material model, "harmonic" | "neo_hookean" | "mooney_rivlin"; default: the sensor's.
        prestretch: prestretch; default: the sensor's.
        modulus: shear modulus x thickness, force / length; default: the sensor's.

    Returns:
        The `ElasticEnergy`; for an inflated surface, prestretch and modulus are those of the sheet before inflation.

    Example:
        >>> from torchmembrane.sensor.sensor import Sensor
        >>> sensor = Sensor.from_file("examples/sensor.toml")
        >>> elastic_energy(sensor, sensor.membrane, "harmonic").model
        'harmonic'
    """
    material = sensor.material
    stretched = (
        model or material.model,
        material.prestretch if prestretch is None else prestretch,
        material.modulus if modulus is None else modulus,
        material.c2_ratio or 0.0,
    )
    if isinstance(sensor.surface, InflatedSurface):
        return SheetEnergy(membrane, sensor.surface.sheet(membrane.grid), *stretched)
    return ElasticEnergy(membrane, *stretched)


def cavity_filling(sensor: Sensor, membrane: Membrane, *, warn: bool = False) -> CavityFilling:
    """Return the filling of a sensor's cavity, in the sensor's units.

    Without shear modulus and thickness, a gas is treated as a liquid, because its pressure cannot be compared with relative
    pressures.

    Args:
        sensor: the sensor with filling, pressure and volume.
        membrane: the membrane; the volume between its rim and its rest surface is used if the sensor has no volume.
        warn: whether to warn if a gas is treated as a liquid, or if its pressure at rest, less the membrane's overpressure, is
            no pressure of the surroundings; the warning points to the caller of the calling function.

    Returns:
        The `CavityFilling`, which unpacks into the arguments `filling, gas` of estimators and presses.

    Raises:
        MembraneError: the volume of a gas is not given, and there is none between rim and rest surface.

    Example:
        >>> from torchmembrane.sensor.sensor import Sensor
        >>> sensor = Sensor.from_file("examples/sensor.toml")
        >>> cavity_filling(sensor, sensor.membrane)
        CavityFilling(filling='liquid', gas=None)
    """
    if sensor.cavity.filling != "gas" or sensor.gas_pressure is None:
        return CavityFilling(sensor.cavity.filling)
    if sensor.force_unit == "relative":
        if warn:
            warn_user(
                f"sensor {sensor.name!r}: a gas without shear_modulus and thickness acts as a liquid (volume kept)",
            )
        return CavityFilling("liquid")
    volume = sensor.cavity.volume or membrane.cavity_volume
    if sensor.cavity.volume is None and volume < LEAST_VOLUME * membrane.size**3:
        raise MembraneError(
            f"sensor {sensor.name!r}: the volume between rim and rest surface is {volume:.3g} {sensor.length_unit}^3; expected "
            "the volume of the gas, which this surface does not enclose: add volume to [cavity]"
        )
    if warn:
        _warn_of_surroundings(sensor, membrane)
    return CavityFilling("gas", (sensor.gas_pressure, volume))


def _warn_of_surroundings(sensor: Sensor, membrane: Membrane) -> None:
    """Warn if the absolute pressure of the gas and the membrane's overpressure contradict any pressure outside."""
    assert sensor.cavity.pressure is not None  # of a gas
    over = float(rest_balance(membrane, elastic_energy(sensor, membrane))[0]) / hectopascal(sensor.length_unit)
    outside = sensor.cavity.pressure - over
    if not AMBIENT[0] <= outside <= AMBIENT[1]:
        warn_user(
            f"sensor {sensor.name!r}: [cavity] pressure = {sensor.cavity.pressure:g} hPa, of which the membrane holds "
            f"{over:.4g} hPa, leaves {outside:.4g} hPa outside; expected the gas' absolute pressure in hPa, about "
            f"{1013 + over:.4g}: forces are wrong if this is a gauge's reading, or in another unit"
        )
