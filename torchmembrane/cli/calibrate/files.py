"""What the steps of `torchmembrane calibrate` read and write: sensors, boards in images, tables, reports."""

from argparse import Namespace
from collections.abc import Sequence
from dataclasses import replace
from datetime import date
from glob import glob
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from ... import __version__
from ...calibrate.detection import find_target
from ...calibrate.known_modulus import KnownForces
from ...calibrate.report import Report
from ...camera.targets import Checkerboard, DotBoard
from ...errors import MembraneError
from ...files.csv_table import ANGLE, Columns, read_table
from ...files.images import read_image, read_pixels
from ...files.safe_read import read_array
from ...files.targets import refuse_overwriting
from ...jobs.inputs import Inputs, find_inputs, frame_name, single_images
from ...jobs.pressure import by_frame, refusal
from ...plot.drawing import save
from ...presets import sensor_file
from ...sensor.companions import companions_of, files_of
from ...sensor.record import Record
from ...sensor.sensor import Sensor
from ...sensor.toml import COORDINATE
from ...sensor.units import millimetre
from ...surface.checks import FARTHEST

if TYPE_CHECKING:
    from matplotlib.figure import Figure

MOST_TABLE_BYTES = 2**20
PLACES, TURNS = ("x", "y", "z"), ("turn_x", "turn_y", "turn_z")
MOTIONS = Columns([(*PLACES, *TURNS)], "image", unit="length unit and degrees")
FORCES = Columns(
    [("image", "fx", "fy", "fz"), ("image", "force")], "force", "deviation", unit="N, on the membrane, in the camera's frame"
)
LISTS = ("images", "air", "medium")
FILES = ("image", "depth", "motions", "forces", "pressure", "pixels")
"""Arguments of the steps that name files to read: images, and single files."""


def read_sensor(arguments: Namespace) -> Sensor:
    """The sensor that the arguments name.

    Raises:
        MembraneError: it cannot be read, or has several views: what is found of one would not be that of the others.
    """
    sensor = Sensor.from_file(sensor_file(arguments.sensor))
    if sensor.views:
        raise MembraneError(
            f"calibrate: {arguments.sensor} has {len(sensor.views)} views; expected one: calibrate each in a file of its own "
            "with [camera], and put the values that are found into its [[camera]]"
        )
    return sensor


def spare_files(step: str, arguments: Namespace) -> None:
    """Refuse a folder in which files would be written over, or that of the sensor that is calibrated.

    Args:
        step: step of the calibration.
        arguments: arguments of the command.
    """
    given = vars(arguments)
    read = [*files_of(sensor_file(arguments.sensor)), *(given[name] for name in FILES if given.get(name) is not None)]
    read += [path for name in LISTS for text in given.get(name, ()) for path in (text, *glob(text), *Path(text).glob("*"))]
    names = ("report.png", "layout.csv", "layout.svg") if step == "layout" else ("report.png", "report.json")
    targets = [*companions_of(arguments.out / "sensor.toml"), *(arguments.out / name for name in names)]
    refuse_overwriting(f"calibrate {step} --out {arguments.out}", targets, read, arguments.force)


def write_calibrated(
    arguments: Namespace,
    sensor: Sensor,
    report: Report,
    drawing: "Figure",
    images: int,
    uncertainty: float | None = None,
) -> int:
    """Write the calibrated sensor with its record, and its report, print what was found; returns the exit code.

    Args:
        arguments: arguments of the command.
        sensor: as found.
        report: report of the calibration.
        drawing: its figure.
        images: that it was found from.
        uncertainty: relative standard deviation of forces, where the step tells it; default: the file's, of an earlier step.
    """
    uncertainty = sensor.record.uncertainty if uncertainty is None else float(f"{uncertainty:.2g}")
    by = f"torchmembrane {__version__}, calibrate {arguments.step}"
    record = Record(sensor.record.serial, date.today(), images, by, uncertainty)
    path = replace(sensor, record=record).to_file(arguments.out)
    report.write(arguments.out)
    save(drawing, arguments.out / "report.png", "calibrate")
    print("\n".join([*report.lines, f"calibrated sensor: {path}; report.json and report.png beside it"]))
    return 0


def read_sensor_image(path: str | Path, sensor: Sensor) -> np.ndarray:
    """An image `[H, W]` that must be as large as the sensor's."""
    return read_image(path, sensor.camera.image_size, sensor.camera.bits)


def read_targets(images: Sequence[str], sensor: Sensor, board: Checkerboard | DotBoard) -> np.ndarray:
    """The board's points in every image that shows it, `[P, D, 2]`; an image that shows none is reported and left out."""
    found, reason, paths = [], "", single_images(find_inputs(images))
    for path in paths:
        image = read_sensor_image(path, sensor)
        try:
            found.append(find_target(image, board))
        except MembraneError as error:
            reason = str(error)
            print(f"{path} left out: {error}")
    if not found:
        raise MembraneError(f"calibrate: no image of {len(paths)} shows {board}: {reason}")
    return np.stack(found)


def read_motions(path: Path) -> np.ndarray:
    """Where the camera was, `[P, 6]`: position (length unit) and rotation vector (degrees) of each view, the first one zeros.

    Args:
        path: path of a table with a line for each image, in their order.

    Raises:
        MembraneError: another table, or a first line that is not zeros.
    """
    rows = read_table(path, MOTIONS, MOST_TABLE_BYTES).rows
    values = np.array([[*row.numbers(PLACES, COORDINATE), *row.numbers(TURNS, ANGLE)] for row in rows])
    for column, value in zip((*PLACES, *TURNS), values[0], strict=True):
        if value != 0:
            raise rows[0].refusal(column, "0: the first image is the sensor's own, from which all motions are counted")
    return values


def read_forces(path: Path, inputs: Inputs) -> KnownForces:
    """Forces of the images `[B, 3]`, or magnitudes `[B, 1]`, N, NaN where the file has none, and their standard deviations.

    Args:
        path: path of a table of forces by the names of images.
        inputs: the B images.

    Raises:
        MembraneError: another table, a name that is no image's, or a force of zero.
    """
    table = read_table(path, FORCES, MOST_TABLE_BYTES)
    columns = table.form[1:]
    known, deviations, (lines, others) = {}, {}, by_frame(table, inputs)
    if others:
        raise refusal(others[0], table, inputs)
    for name, row in lines.items():
        known[name] = row.numbers(columns)
        if not any(known[name]):
            raise row.refusal(columns[-1], "a force that is not zero: leave out images in which nothing presses")
        if "deviation" in row.places:
            deviations[name] = row.number("deviation")
            if not deviations[name] >= 0:
                raise row.refusal("deviation", "a standard deviation of the force, N, 0 or more")
    names = [frame_name(image) for image in inputs.images]
    forces = np.array([known.get(name, [np.nan] * len(columns)) for name in names])
    return KnownForces(forces, np.array([deviations.get(name, np.nan) for name in names]) if deviations else None)


def read_depth(path: Path, unit: float | None, length_unit: str) -> np.ndarray:
    """A depth image `[H, W]` in a length unit, NaN where there is none.

    As ROS has them: 16 bits, 0 where there is none, or float, NaN and infinities there.

    Args:
        path: path of an array, or of an image with 16 bits or float.
        unit: unit of one step of the file's values; default: of an image with 16 bits 1 mm, else the length unit.
        length_unit: unit of the sensor.

    Raises:
        MembraneError: the file cannot be read, or its depths are none of this world.
    """
    is_array = path.suffix == ".npy"
    values = read_array(path) if is_array else read_pixels(path)
    expected = "[H, W] of float or of 16 bits or more, z along the camera's axis"
    if values.ndim == 3 and values.shape[2] == 1:
        values = values[..., 0]
    if values.ndim != 2 or values.dtype.itemsize < 2:
        raise MembraneError(f"{path}: an array {list(values.shape)} of {values.dtype}; expected {expected}")
    if unit is None:
        unit = 1.0 if is_array or values.dtype.kind == "f" else millimetre(length_unit)
    depth = values.astype(float) * unit
    depth[~np.isfinite(depth)] = np.nan
    if (np.abs(depth) > FARTHEST).any():
        raise MembraneError(f"{path}: depths up to {np.nanmax(depth):g}; expected at most {FARTHEST:g}: check --unit {unit:g}")
    return depth
