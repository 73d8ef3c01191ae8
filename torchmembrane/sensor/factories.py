"""From a sensor to the mechanics of its membrane: elastic energy, cavity."""

from typing import NamedTuple

from ..forming.sheet_energy import SheetEnergy
from ..mechanics.hyperelastic import ElasticEnergy
from ..surface.membrane import Membrane
from ..user_warnings import warn_user
from .inflated import InflatedSurface
from .sensor import Sensor


class CavityFilling(NamedTuple):
    """What a cavity is filled with, as estimators and the simulator take it.

    Attributes:
        filling: "liquid" | "gas" | "open".
        gas: absolute pressure at rest (force / length^2) and volume (length^3) of a gas, else None.
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
    """The elastic energy of a sensor's material on a membrane of any grid.

    Args:
        sensor: gives the material.
        membrane: the rest surface, such as `sensor.membrane`.
        model: another one than the sensor's: "harmonic" | "neo_hookean" | "mooney_rivlin".
        prestretch: another one than the sensor's.
        modulus: another shear modulus x thickness than the sensor's, force / length.

    Returns:
        The `ElasticEnergy`; of an inflated surface one whose prestretch and modulus belong to the sheet.

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
    """What fills a sensor's cavity, in the sensor's units.

    A gas of a sensor without modulus and thickness acts as a liquid: its pressure cannot be compared with relative ones.

    Args:
        sensor: gives filling, pressure and volume.
        membrane: gives a gas' volume where the sensor does not: that between its rim and its rest surface.
        warn: say so in a warning where a gas acts as a liquid; attributed to the caller of the function that calls this.

    Returns:
        `CavityFilling`; `*` of it are the arguments `filling, gas` of estimators and presses.

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
    return CavityFilling("gas", (sensor.gas_pressure, sensor.cavity.volume or membrane.cavity_volume))
