"""The steps `camera` and `ports`: the camera, or that of one of several views, from images of boards."""

from argparse import Namespace

import numpy as np

from ...calibrate.camera import CameraFit, Views, lens_from_views, ports_from_views
from ...calibrate.report import Report
from ...camera.folds import refuse_folds
from ...camera.model import Camera
from ...camera.targets import Checkerboard, DotBoard
from ...errors import MembraneError
from ...plot.calibration import fit_figure
from ...sensor.sensor import Sensor
from .files import read_sensor, read_targets, view_number, write_calibrated


def camera(arguments: Namespace) -> int:
    """`torchmembrane calibrate camera`"""
    whole, (columns, rows) = read_sensor(arguments), arguments.corners
    number, board = view_number(arguments, whole), Checkerboard(columns, rows, arguments.square)
    pixels, sensor = read_targets(arguments.images, whole, number, board), whole.in_view(number)
    found = lens_from_views(sensor.camera, board, Views(pixels, np.zeros(len(pixels), bool)))
    try:
        refuse_folds(found.camera, sensor.membrane.rest)
    except MembraneError as error:
        raise MembraneError(f"calibrate camera: the lens that was found is refused: {error}") from error
    units = [{"focal": "px", "centre": "px"}.get(name.split("[")[0], "") for name in found.names]
    return _write(arguments, whole, number, found, pixels, units, f"lens: {sensor.camera.model}, {len(pixels)} images")


def ports(arguments: Namespace) -> int:
    """`torchmembrane calibrate ports`"""
    whole, (columns, rows) = read_sensor(arguments), arguments.dots
    number, board = view_number(arguments, whole), DotBoard(columns, rows, arguments.pitch, arguments.radius)
    sensor = whole.in_view(number)
    sets = [read_targets(images, whole, number, board) for images in (arguments.air, arguments.medium) if images]
    if not sets:
        raise MembraneError("calibrate ports: no images; expected --air IMAGES, --medium IMAGES, best both")
    pixels = np.concatenate(sets)
    filled = np.arange(len(pixels)) >= (len(sets[0]) if arguments.air else 0)
    found = ports_from_views(sensor.camera, board, Views(pixels, filled), arguments.held)
    units = ["" if "index" in name else sensor.length_unit for name in found.names]
    title = f"ports: {(~filled).sum()} images in air, {filled.sum()} in the medium"
    return _write(arguments, whole, number, found, pixels, units, title)


def _write(
    arguments: Namespace, sensor: Sensor, number: int, found: CameraFit, pixels: np.ndarray, units: list[str], title: str
) -> int:
    camera = sensor.in_view(number).camera
    design = [_value(camera, name) for name in found.names]
    if sensor.views:
        title = f"view {sensor.views[number].name!r}: {title}"
    report = Report.from_fit(title, found.names, units, design, found.fit, pixels, found.residuals)
    drawing = fit_figure(report, camera.image_size)
    return write_calibrated(arguments, sensor.with_camera(found.camera, number), report, drawing, len(pixels))


def _value(camera: Camera, name: str) -> float:
    """A number of the camera by its name in a fit, as `focal[1]`; 0 for a coefficient that it does not have."""
    key, _, index = name.rstrip("]").partition("[")
    values = getattr(camera, key).reshape(-1).tolist()
    i = int(index or 0)
    return values[i] if i < len(values) else 0.0
