"""What `check` reports on a rest surface: whether it is an equilibrium, how a gauge reading fits, and the effect on forces."""

from math import inf

from ..accuracy.rest_shape import NearestSheet, RestShape, rest_shape
from ..sensor.sensor import Sensor
from ..sensor.units import hectopascal
from .describe import pressure_in_words

LEFT_OVER = 0.15  # of the pressure: a sheet that is given as a grid, taken for evenly stretched, has up to 0.13
ALIKE = 1.1  # of two pressures: their largest ratio
FAR = 0.003  # rms distance from the nearest sheet, over the surface's size: above it is another shape


def rest_in_words(sensor: Sensor, gauge: float | None = None) -> list[str]:
    """Return lines about a sensor's rest surface.

    Args:
        sensor: any sensor.
        gauge: overpressure measured at rest, hPa.
    """
    shape = rest_shape(sensor)
    lines = [*_left_over(shape), *_nearest(shape, shape.nearest, sensor), *_gauge(shape, sensor, gauge)]
    return [f"{'at rest' if i == 0 else '':<10}{line}" for i, line in enumerate(lines)]


def _left_over(shape: RestShape) -> list[str]:
    found = f"tension and pressure leave forces of {shape.left_over:.1%} of the pressure (rms) unbalanced"
    if not shape.pressure:
        found = f"no overpressure; forces of {shape.left_over:.1%} of the tension over the size (rms) are left unbalanced"
    if shape.left_over < LEFT_OVER:
        return [found]
    return [
        f"{found}; the solver treats them as a constant load",
        f"expected below {LEFT_OVER:.0%}: a membrane moulded in this shape has such stresses, an inflated sheet has none",
    ]


def _nearest(shape: RestShape, sheet: NearestSheet | None, sensor: Sensor) -> list[str]:
    if sheet is None:
        return []
    unit, stretch = sensor.length_unit, sensor.material.prestretch
    off = f"{sheet.distance:.3g} {unit} rms, at most {sheet.most:.3g}"
    lines = [f"the nearest sheet that is inflated in this rim, {sheet.height:.4g} {unit} high, lies {off} from this surface"]
    ratio = sheet.pressure / shape.pressure if shape.pressure else 1.0
    if sheet.distance > FAR * sensor.membrane.size or not 1 / ALIKE < ratio < ALIKE:
        held, modelled = (pressure_in_words(p, sensor) for p in (sheet.pressure, shape.pressure))
        lines += [
            f"made of the same rubber, that sheet has a pressure of {held}, this membrane {modelled}: if yours is such a",
            "sheet, depths and forces by this file are wrong, forces by about as much as these pressures differ; `init` writes",
            'shape = "inflated"',
        ]
    if stretch < sheet.least:
        lines.append(f"a prestretch of {stretch:g} at rest is less than inflation alone gives such a sheet, {sheet.least:.3g}")
    return lines


def _gauge(shape: RestShape, sensor: Sensor, gauge: float | None) -> list[str]:
    if gauge is None:
        return []
    measured, relative = gauge * hectopascal(sensor.length_unit), sensor.force_unit == "relative"
    if relative and not (measured and shape.pressure):
        return [f"{gauge:g} hPa at rest do not give the modulus: the gauge or this shape has no overpressure"]
    ratio = measured / shape.pressure if shape.pressure else inf
    if relative:
        return [
            f"{gauge:g} hPa at rest, this shape and this prestretch give shear modulus x thickness = {ratio:.4g} "
            f"N/{sensor.length_unit}"
        ]
    said = f"the gauge reads {gauge:g} hPa at rest, the model has {pressure_in_words(shape.pressure, sensor)}"
    if 1 / ALIKE < ratio < ALIKE or not (measured or shape.pressure):
        return [said]
    if not (measured and shape.pressure):
        return [f"{said}: shape or prestretch is wrong, or the gauge is not connected"]
    return [f"{said}: shape, prestretch or modulus is wrong; if it is the modulus, forces are {1 / ratio:.2f} of the true ones"]
