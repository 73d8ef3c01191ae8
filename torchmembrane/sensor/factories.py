"""Make the mechanics of a sensor's membrane: its elastic energy and its cavity."""

from typing import NamedTuple

from ..forming.sheet_energy import SheetEnergy
from ..mechanics.hyperelastic import ElasticEnergy
from ..surface.membrane import Membrane
from ..user_warnings import warn_user
from .inflated import InflatedSurface
from .sensor import Sensor


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
        warn: whether to warn if a gas is treated as a liquid; the warning points to the caller of the calling function.

    Returns:
        The `CavityFilling`, which unpacks into the arguments `filling, gas` of estimators and presses.

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
