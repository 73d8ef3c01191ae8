"""Check whether a rest surface can be in equilibrium: its residual forces, and the nearest inflated sheet in the same rim."""

from typing import NamedTuple

import numpy as np

from ..errors import MembraneError
from ..forming.formed import SheetMaterial, film, formed_surface
from ..mechanics.cavity import rest_balance
from ..sensor.factories import elastic_energy
from ..sensor.inflated import InflatedSurface
from ..sensor.sensor import Sensor
from ..surface.membrane import Membrane
from ..surface.topology import rim_loop

RAISED = 1.02  # factor of the height for the finite difference of the sheet's shape
UNPRESSED = 1e-9  # overpressure over tension / size, below which it is a rounding error
LINES = 17  # of the sheet's grid; its shape is then accurate to some thousandths of its height


class NearestSheet(NamedTuple):
    """The nearest rest surface that is an inflated sheet of the same material in the same rim.

    Attributes:
        height: height of its highest point above the rim's plane, length unit.
        distance: rms distance of the given surface from it, length unit.
        most: largest distance of the given surface from it, length unit.
        pressure: its equilibrium pressure, force / length^2.
        stretch: stretch of the sheet in its rim, before inflation.
        least: mean stretch due to inflation alone.
    """

    height: float
    distance: float
    most: float
    pressure: float
    stretch: float
    least: float


class RestShape(NamedTuple):
    """The result of checking a rest surface.

    Attributes:
        pressure: overpressure of the fluid according to the model, force / length^2; 0 for a flat or an unstretched membrane.
        left_over: rms of the residual force per area that tension and pressure do not balance, over the pressure, or without a
            pressure over tension / size; the model balances it with a fixed load.
        nearest: the nearest inflated sheet; None if the surface is such a sheet, or there is none in its rim.
    """

    pressure: float
    left_over: float
    nearest: NearestSheet | None


def rest_shape(sensor: Sensor) -> RestShape:
    """Compare a sensor's rest surface with surfaces that can be in equilibrium.

    Args:
        sensor: the sensor.

    Returns:
        The `RestShape`.

    Example:
        >>> from torchmembrane.presets import preset
        >>> found = rest_shape(preset("bubble"))
        >>> found.left_over < 0.06, found.nearest.distance < 0.2
        (True, True)
    """
    membrane = sensor.membrane
    elasticity = elastic_energy(sensor, membrane)
    p0, load = rest_balance(membrane, elasticity)
    load, area = load[membrane.free_vertices], membrane.rest_area[membrane.free_vertices]
    left_over = float((load.square().sum(1) / area).sum() / area.sum()) ** 0.5
    held = max(float(elasticity.tension), float(elasticity.c1 + elasticity.c2)) / membrane.size
    pressure = float(p0) if abs(float(p0)) > UNPRESSED * held else 0.0
    return RestShape(pressure, left_over / (abs(pressure) or held), _nearest(sensor))


def _nearest(sensor: Sensor) -> NearestSheet | None:
    membrane, material = sensor.membrane, sensor.material
    if isinstance(sensor.surface, InflatedSurface):
        return None
    X = membrane.rest.numpy()
    rim = X[rim_loop(membrane.grid)]
    try:
        flat = film(rim, LINES)
        height = float(((X - flat.outline.origin) @ flat.outline.axes[2]).max())
        least = (float(membrane.rest_area.sum()) / flat.area) ** 0.5
        stretch = max(1.0, material.prestretch / least)
        sheet = SheetMaterial(material.model, stretch, material.c2_ratio or 0.0)
        low, high = (formed_surface(rim, sheet, height=h, lines=LINES) for h in (height, RAISED * height))
    except MembraneError:
        return None
    off = _above(low.vertices, X)
    slope = _above(high.vertices, X) - off
    share = -float((slope * off).sum() / (slope * slope).sum())
    distance = _above(low.vertices + share * (high.vertices - low.vertices), X)
    modulus = material.modulus * least**2  # the sheet is thicker by the ratio of areas
    return NearestSheet(
        height=low.height + share * (high.height - low.height),
        distance=float(np.sqrt((distance**2).mean())),
        most=float(np.abs(distance).max()),
        pressure=modulus * (low.pressure + share * (high.pressure - low.pressure)),
        stretch=stretch,
        least=least,
    )


def _above(vertices: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Return the signed distances of points `[N, 3]` from a grid's surface, `[N]`, positive outside."""
    surface = Membrane(vertices)
    near = surface.closest_points(points)
    closest, normals = (
        (a.numpy()[near.vertices] * near.weights[..., None]).sum(1) for a in (surface.rest, surface.rest_normals)
    )
    signed: np.ndarray = ((points - closest) * normals).sum(1)
    return signed
