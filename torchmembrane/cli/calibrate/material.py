"""The step `material`: prestretch and stiffness from images of presses."""

import re
from argparse import Namespace
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import torch

from ...calibrate.known_modulus import KnownForces, KnownPressures
from ...calibrate.material import MaterialFit, material_from_images
from ...calibrate.presses import STRETCHES
from ...calibrate.report import Report
from ...calibrate.view_poses import with_found
from ...calibrate.weight import WeightFit, material_from_weight
from ...errors import MembraneError
from ...files.timestamps import time_in
from ...jobs.inputs import Inputs, find_inputs, frame_name, of_first_view, single_images
from ...jobs.pressure import read_pressures
from ...plot.calibration import material_figure
from ...reconstruct import Reconstructor
from ...results.status import Status
from ...sensor.inflated import InflatedSurface
from ...sensor.sensor import Sensor
from ..progress import ProgressDisplay
from .files import read_forces, read_sensor, read_sensor_image, write_calibrated


def material(arguments: Namespace) -> int:
    """`torchmembrane calibrate material`"""
    whole = read_sensor(arguments)
    sensor, inputs = whole.in_view(0), of_first_view(find_inputs(arguments.images), whole.views_apart)
    paths = single_images(inputs)
    alone = arguments.weight is not None and not (arguments.forces or arguments.pressure or arguments.overpressure)
    forces = known_forces(arguments, inputs)
    pressures = _pressures(arguments, inputs, sensor) if arguments.pressure else None
    images = torch.from_numpy(np.stack([read_sensor_image(path, whole) for path in paths]))[:, None]
    with _named(paths), ProgressDisplay("calibrate material") as progress:
        weighed = material_from_weight(sensor, images, arguments.weight, progress=progress) if alone else None
        known = dict(overpressure=arguments.overpressure, rest_error=arguments.rest_error, progress=progress)
        found = material_from_images(sensor, images, forces, pressures, **known) if weighed is None else weighed.material
    unit, n = sensor.length_unit, len(found.values)
    each = zip(paths, found.each, strict=True)
    notes = [f"{path.name} alone: prestretch {one:.3f} ± {sd:.2g}" for path, (one, sd) in each]
    if found.values[0] + found.deviations[0] > STRETCHES[-1]:
        notes.append(f"the prestretch may be larger: {STRETCHES[-1]:g} is the largest that was tried")
    if n == 2:
        notes.append("modulus: shear modulus x thickness; the sensor file's thickness is kept, or 1 where it has none")
    if found.height is not None and isinstance(sensor.surface, InflatedSurface):
        height, deviation = found.height
        notes.append(
            f"the rest surface is {height:.4g} ± {deviation:.2g} {unit} high, by the presses and by what was stated of it; the "
            f"file said {sensor.surface.formed.height:.4g}; the calibrated sensor has the height found"
        )
    if whole.views:
        notes.append(f"found by the first view, {whole.views[0].name!r}, alone")
    notes += [_by_name(sentence, paths) for sentence in found.contradictions]
    notes += _of_forces(arguments, found, weighed)
    if weighed is None:
        notes += _doubted(found.sensor, images, paths)
    report = Report.without_parameters(f"material from {len(paths)} images of presses", notes)._replace(
        names=["prestretch", "modulus"][:n],
        units=["", f"N/{unit}"][:n],
        design=np.array([sensor.material.prestretch, sensor.material.modulus][:n]),
        values=found.values,
        deviations=found.deviations,
        correlations=found.covariance / np.outer(found.deviations, found.deviations),
        intervals=found.intervals,
    )
    made = found.sensor if weighed is None else weighed.sensor
    uncertainty = found.force_deviation if weighed is None else weighed.deviation
    drawing = material_figure(report, found, [path.name for path in paths])
    return write_calibrated(arguments, with_found(whole, made), report, drawing, len(paths), uncertainty)


def _of_forces(arguments: Namespace, found: MaterialFit, weighed: WeightFit | None) -> list[str]:
    """How surely the scale of forces is known, in sentences."""
    if weighed is not None:
        told, unit = ", ".join(f"{force:.3g}" for force in weighed.forces), weighed.sensor.length_unit
        return [
            f"the file's modulus is scaled to {weighed.sensor.material.modulus:.4g} N/{unit}, so that its reconstruction says "
            f"the weight, {arguments.weight:.4g} N: {told} N; forces are scaled to {100 * weighed.deviation:.0f} %"
        ]
    if found.force_deviation is None:
        return []
    return [
        f"forces are known to {100 * found.force_deviation:.2g} % (in them errors of prestretch and modulus partly cancel) "
        f"if the height of the rest surface is right to {100 * arguments.rest_error:.2g} % (--rest-error)"
    ]


def _by_name(sentence: str, paths: list[Path]) -> str:
    """A sentence about `image N` with that image's name."""
    return re.sub(r"\bimage (\d+)", lambda match: paths[int(match[1]) - 1].name, sentence)


@contextmanager
def _named(paths: list[Path]) -> Iterator[None]:
    """Let errors name the files of the images instead of their numbers."""
    try:
        yield
    except MembraneError as error:
        raise MembraneError(_by_name(str(error), paths)) from error


def _doubted(sensor: Sensor, images: torch.Tensor, paths: list[Path]) -> list[str]:
    """Images that the material found does not explain, each by its name: they were used."""
    with torch.no_grad():
        statuses = Reconstructor(sensor, check_rest=False)(images).status.tolist()
    return [
        f"{path.name}: with this material {Status(status).text}; it was used: leave it out and see what changes"
        for path, status in zip(paths, statuses, strict=True)
        if status != Status.OK
    ]


def known_forces(arguments: Namespace, inputs: Inputs) -> KnownForces | None:
    """Return the forces of the table, and the weight for images that it does not list; None if neither is given.

    Args:
        arguments: `forces`, a table, and `weight`, N.
        inputs: the images.
    """
    table = read_forces(arguments.forces, inputs) if arguments.forces else None
    if arguments.weight is None:
        return table
    weights = np.full((len(inputs.images), 1), arguments.weight)
    if table is None:
        return KnownForces(weights)
    sizes = np.linalg.norm(table.forces, axis=1, keepdims=True)
    return KnownForces(np.where(np.isfinite(sizes), sizes, weights), table.deviations)


def _pressures(arguments: Namespace, inputs: Inputs, sensor: Sensor) -> KnownPressures:
    found = read_pressures(arguments.pressure, inputs, sensor)
    if found.unused:
        print(f"{arguments.pressure}: {found.unused} readings belong to none of the images and are not used")
    readings = np.array([found.at(frame_name(path), time_in(path.stem)) for path in inputs.images])
    return KnownPressures(readings, found.since_rest)
