"""Preset sensors, complete with marker list and rest image, for first trials and as templates for your own."""

from pathlib import Path

from ..errors import MembraneError, check_arguments
from ..sensor.sensor import Sensor

NAMES = ("fingertip", "bubble", "half_cylinder")
PREFIX = "preset:"


def preset_file(name: str) -> Path:
    """Return the path of a preset's `sensor.toml`.

    Args:
        name: one of `NAMES`.

    Raises:
        MembraneError: no preset has this name.

    Example:
        >>> preset_file("bubble").name
        'sensor.toml'
    """
    if name not in NAMES:
        raise MembraneError(f"preset {name!r}: no such sensor; expected one of {', '.join(NAMES)}")
    return Path(__file__).parent / name / "sensor.toml"


@check_arguments
def preset(name: str) -> Sensor:
    """Return a preset sensor, which comes with the package.

    Args:
        name: "fingertip", "bubble" or "half_cylinder".

    Returns:
        The sensor, with marker list and rest image.

    Raises:
        MembraneError: no preset has this name.

    Example:
        >>> preset("bubble").camera.model
        'pinhole'
    """
    return Sensor.from_file(preset_file(name))


def sensor_file(text: str) -> Path:
    """Return the path of the sensor file that a command-line argument names.

    Args:
        text: a path, or `preset:NAME`.

    Raises:
        MembraneError: no preset has this name.

    Example:
        >>> sensor_file("my/sensor.toml").name, sensor_file("preset:bubble").parent.name
        ('sensor.toml', 'bubble')
    """
    return preset_file(text.removeprefix(PREFIX)) if text.startswith(PREFIX) else Path(text)
