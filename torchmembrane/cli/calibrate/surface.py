"""The steps `rest`, `views` and `depth`: the rest surface and its dots from images of the membrane at rest."""

from argparse import Namespace
from typing import TYPE_CHECKING

import numpy as np
import torch
from scipy.linalg import block_diag

from ...calibrate.depth import rest_from_depth, rest_from_depth_of_view
from ...calibrate.fit import Fit
from ...calibrate.report import Report
from ...calibrate.rest import RestFit, rest_from_image
from ...calibrate.surface import Correction, fine_surface
from ...calibrate.view_poses import rest_from_view_images
from ...calibrate.views import rest_from_views
from ...errors import MembraneError
from ...jobs.inputs import find_inputs, of_first_view, single_images
from ...plot.calibration import fit_figure, surface_figure
from ...sensor.inflated import InflatedSurface
from ...sensor.sensor import Sensor
from ...sensor.units import hectopascal
from ..progress import ProgressDisplay
from .files import (
    read_depth,
    read_motions,
    read_sensor,
    read_sensor_image,
    read_view_images,
    view_number,
    write_calibrated,
)

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def rest(arguments: Namespace) -> int:
    """`torchmembrane calibrate rest`"""
    sensor = read_sensor(arguments)
    if sensor.views:
        return _rest_of_views(arguments, sensor)
    image = read_sensor_image(arguments.image, sensor)
    with ProgressDisplay("calibrate rest") as progress:
        found = rest_from_image(sensor, image, arguments.overpressure, progress=progress)
    units, design, notes = _before(sensor, found, arguments.overpressure)
    title = "rest surface from one image"
    report = Report.from_fit(title, found.names, units, design, found.fit, found.pixels, found.residuals, notes)
    return write_calibrated(arguments, found.sensor, report, fit_figure(report, sensor.camera.image_size), 1)


def _before(sensor: Sensor, found: RestFit, overpressure: float | None) -> tuple[list[str], np.ndarray, list[str]]:
    """Units of what a rest image tells, its values in the file, and notes on the dots."""
    sheet, unit = sensor.surface, sensor.length_unit
    units, design = ["degrees"] * 3 + [unit] * 3, np.zeros(6)
    shifts = np.linalg.norm(found.shifts, axis=1)
    notes = [
        f"{np.isfinite(found.pixels).all(1).sum()} of {len(shifts)} dots found; moved along the surface to null what is left: "
        f"{np.sqrt((shifts**2).mean()):.3g} {unit} rms, at most {shifts.max():.3g}"
    ]
    if isinstance(sheet, InflatedSurface):
        units, design = [*units, unit, ""], np.append(design, [sheet.formed.height, sensor.material.prestretch])
        notes += _held(found.sensor, overpressure)
    return units, design, notes


def _rest_of_views(arguments: Namespace, sensor: Sensor) -> int:
    """The same of several views: the surface by the first one, the others' poses by the dots on it."""
    images = read_view_images(arguments.image, sensor)
    with ProgressDisplay("calibrate rest") as progress:
        found = rest_from_view_images(sensor, images, arguments.overpressure, progress=progress)
    first, unit = found.first, sensor.length_unit
    units, design, notes = _before(sensor, first, arguments.overpressure)
    names, fits = list(first.names), [first.fit]
    for view, of_view in zip(found.sensor.views[1:], found.further, strict=True):
        names += [f"{view.name}.{name}" for name in of_view.names]
        units, design, fits = units + ["degrees"] * 3 + [unit] * 3, np.append(design, np.zeros(6)), [*fits, of_view.fit]
        seen = of_view.residuals[np.isfinite(of_view.residuals).all(1)]
        place = ", ".join(f"{value:z.5g}" for value in view.pose.translation)
        notes.append(
            f"view {view.name!r} stands at {place} {unit}: it sees {len(seen)} dots, {np.sqrt((seen**2).mean()):.3f} px rms off"
        )
    joined = Fit(
        np.concatenate([each.values for each in fits]),
        block_diag(*(each.covariance for each in fits)),
        np.concatenate([each.residuals for each in fits]),
        first.fit.noise,
    )
    title = f"rest surface and poses from images of {len(images)} views"
    report = Report.from_fit(title, names, units, design, joined, first.pixels, first.residuals, notes)
    return write_calibrated(arguments, found.sensor, report, fit_figure(report, sensor.camera.image_size), len(images))


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
    sensor = read_sensor(arguments)
    images, motions = _from_several_places(arguments, sensor)
    with ProgressDisplay("calibrate views") as progress:
        found = rest_from_views(sensor, images, motions, arguments.travel_error, progress=progress)
    unit, P = sensor.length_unit, len(images)
    rms = np.sqrt((found.deviations**2).mean(0))
    notes = [
        f"{len(found.dots)} dots, standard deviations along x, y, z {rms[0]:.3g}, {rms[1]:.3g}, {rms[2]:.3g} {unit}",
        _moved(found.surface, unit),
    ]
    if alone := len(found.sensor.markers.sizes or ()) - len(found.dots):
        notes.append(f"{alone} more dots, each seen by one view alone, placed on that surface")
    units = (["degrees"] * 3 + [unit] * 3) * (P - 1)
    modelled = found.sensor.camera.point_to_pixel(torch.from_numpy(found.dots)).numpy()
    pixels = np.broadcast_to(modelled, found.residuals.shape)
    title = f"rest surface from {P} views"
    report = Report.from_fit(title, found.names, units, found.first_guess, found.fit, pixels, found.residuals, notes)
    return write_calibrated(arguments, found.sensor, report, _drawn(sensor, report, found.surface), P)


def _from_several_places(arguments: Namespace, sensor: Sensor) -> tuple[list[np.ndarray], np.ndarray | None]:
    """Images by one camera that moved, and its motions; or one image of each of several views.

    Raises:
        MembraneError: another number of images than of motions, no motions of one camera, or motions of several views.
    """
    if sensor.views:
        paths = single_images(of_first_view(find_inputs(arguments.images), sensor.views_apart))
        if arguments.motions is not None or len(paths) != 1:
            given = f"{len(paths)} frames{'' if arguments.motions is None else ' and --motions'}"
            raise MembraneError(
                f"calibrate views: {given}; expected one frame, an image of each view of {arguments.sensor}, and no motions: "
                "its poses are the first guess"
            )
        return read_view_images(paths[0], sensor), None
    if arguments.motions is None:
        raise MembraneError("calibrate views: no --motions; expected a table of where the camera was for each image")
    motions, paths = read_motions(arguments.motions), single_images(find_inputs(arguments.images))
    if len(paths) != len(motions):
        raise MembraneError(f"{arguments.motions}: {len(motions)} lines of motions; expected {len(paths)}, one for each image")
    return [read_sensor_image(path, sensor) for path in paths], motions


def depth(arguments: Namespace) -> int:
    """`torchmembrane calibrate depth`"""
    sensor = read_sensor(arguments)
    number, values = view_number(arguments, sensor), read_depth(arguments.depth, arguments.unit, sensor.length_unit)
    images = read_view_images(arguments.image, sensor) if sensor.views else [read_sensor_image(arguments.image, sensor)]
    with ProgressDisplay("calibrate depth") as progress:
        if sensor.views:
            found = rest_from_depth_of_view(sensor, number, values, images, progress=progress)
        else:
            found = rest_from_depth(sensor, values, images[0], progress=progress)
    unit = sensor.length_unit
    notes = [
        f"{len(found.deviations)} squares of depths, each known to {np.median(found.deviations):.3g} {unit}",
        _moved(found.surface, unit),
        f"{len(found.sensor.markers.sizes or ())} dots placed on the surface",
    ]
    report = Report.without_parameters("rest surface from a depth image", notes)
    return write_calibrated(arguments, found.sensor, report, _drawn(sensor.in_view(number), report, found.surface), len(images))


def _drawn(sensor: Sensor, report: Report, surface: Correction) -> "Figure":
    vertices = fine_surface(sensor).rest.numpy()
    return surface_figure(report, sensor.camera.image_size, vertices, surface, sensor.length_unit)


def _moved(surface: Correction, unit: str) -> str:
    rms, sd = (float(np.sqrt((a**2).mean())) for a in (surface.offsets, surface.deviations))
    return f"surface moved along its normals by {rms:.3g} {unit} rms, known to {sd:.3g} {unit} rms"
