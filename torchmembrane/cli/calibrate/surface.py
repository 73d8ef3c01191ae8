"""The steps `rest`, `views` and `depth`: the rest surface and its dots from images of the membrane at rest."""

from argparse import Namespace
from typing import TYPE_CHECKING

import numpy as np
import torch

from ...calibrate.depth import rest_from_depth
from ...calibrate.report import Report
from ...calibrate.rest import rest_from_image
from ...calibrate.surface import Correction, fine_surface
from ...calibrate.views import rest_from_views
from ...errors import MembraneError
from ...jobs.inputs import find_inputs, single_images
from ...plot.calibration import fit_figure, surface_figure
from ...sensor.inflated import InflatedSurface
from ...sensor.sensor import Sensor
from ...sensor.units import hectopascal
from ..progress import ProgressDisplay
from .files import read_depth, read_motions, read_sensor, read_sensor_image, write_calibrated

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def rest(arguments: Namespace) -> int:
    """`torchmembrane calibrate rest`"""
    sensor = read_sensor(arguments)
    image = read_sensor_image(arguments.image, sensor)
    with ProgressDisplay("calibrate rest") as progress:
        found = rest_from_image(sensor, image, arguments.overpressure, progress=progress)
    sheet, unit = sensor.surface, sensor.length_unit
    units, design = ["degrees"] * 3 + [unit] * 3, np.zeros(6)
    shifts = np.linalg.norm(found.shifts, axis=1)
    notes = [
        f"{np.isfinite(found.pixels).all(1).sum()} of {len(shifts)} dots found; moved along the surface to null what is left: "
        f"{np.sqrt((shifts**2).mean()):.3g} {unit} rms, at most {shifts.max():.3g}"
    ]
    if isinstance(sheet, InflatedSurface):
        units, design = [*units, unit, ""], np.append(design, [sheet.formed.height, sensor.material.prestretch])
        notes += _held(found.sensor, arguments.overpressure)
    title = "rest surface from one image"
    report = Report.from_fit(title, found.names, units, design, found.fit, found.pixels, found.residuals, notes)
    return write_calibrated(arguments, found.sensor, report, fit_figure(report, sensor.camera.image_size), 1)


def _held(sensor: Sensor, gauge: float | None) -> list[str]:
    """What the sheet found holds, and what the gauge reads."""
    sheet = sensor.surface
    assert isinstance(sheet, InflatedSurface)
    if sensor.force_unit == "relative":
        return ["without a modulus, or a gauge at rest (--overpressure), forces stay relative"]
    held = sheet.formed.pressure * sensor.material.modulus / hectopascal(sensor.length_unit)
    read = "" if gauge is None else f", the gauge reads {gauge:g} hPa"
    return [f"shear modulus x thickness {sensor.material.modulus:.4g} N/{sensor.length_unit} holds {held:.4g} hPa{read}"]


def views(arguments: Namespace) -> int:
    """`torchmembrane calibrate views`"""
    sensor, motions = read_sensor(arguments), read_motions(arguments.motions)
    paths = single_images(find_inputs(arguments.images))
    if len(paths) != len(motions):
        raise MembraneError(f"{arguments.motions}: {len(motions)} lines of motions; expected {len(paths)}, one for each image")
    images = [read_sensor_image(path, sensor) for path in paths]
    with ProgressDisplay("calibrate views") as progress:
        found = rest_from_views(sensor, images, motions, arguments.travel_error, progress=progress)
    unit, P = sensor.length_unit, len(motions)
    design = np.concatenate([motions[1:, 3:], motions[1:, :3]], 1).ravel()
    rms = np.sqrt((found.deviations**2).mean(0))
    notes = [
        f"{len(found.dots)} dots, standard deviations along x, y, z {rms[0]:.3g}, {rms[1]:.3g}, {rms[2]:.3g} {unit}",
        _moved(found.surface, unit),
    ]
    units = (["degrees"] * 3 + [unit] * 3) * (P - 1)
    modelled = found.sensor.camera.point_to_pixel(torch.from_numpy(found.dots)).numpy()
    pixels = np.broadcast_to(modelled, found.residuals.shape)
    title = f"rest surface from {P} views"
    report = Report.from_fit(title, found.names, units, design, found.fit, pixels, found.residuals, notes)
    return write_calibrated(arguments, found.sensor, report, _drawn(sensor, report, found.surface), P)


def depth(arguments: Namespace) -> int:
    """`torchmembrane calibrate depth`"""
    sensor = read_sensor(arguments)
    values = read_depth(arguments.depth, arguments.unit, sensor.length_unit)
    image = read_sensor_image(arguments.image, sensor)
    with ProgressDisplay("calibrate depth") as progress:
        found = rest_from_depth(sensor, values, image, progress=progress)
    unit = sensor.length_unit
    notes = [
        f"{len(found.deviations)} squares of depths, each known to {np.median(found.deviations):.3g} {unit}",
        _moved(found.surface, unit),
        f"{len(found.sensor.markers.sizes or ())} dots placed on the surface",
    ]
    report = Report.without_parameters("rest surface from a depth image", notes)
    return write_calibrated(arguments, found.sensor, report, _drawn(sensor, report, found.surface), 1)


def _drawn(sensor: Sensor, report: Report, surface: Correction) -> "Figure":
    vertices = fine_surface(sensor).rest.numpy()
    return surface_figure(report, sensor.camera.image_size, vertices, surface, sensor.length_unit)


def _moved(surface: Correction, unit: str) -> str:
    rms, sd = (float(np.sqrt((a**2).mean())) for a in (surface.offsets, surface.deviations))
    return f"surface moved along its normals by {rms:.3g} {unit} rms, known to {sd:.3g} {unit} rms"
