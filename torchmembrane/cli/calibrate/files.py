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
from ...plot.files import save
from ...presets import sensor_file
from ...sensor.companions import companions_of, files_of
from ...sensor.record import Record
from ...sensor.sensor import Sensor
from ...sensor.toml import COORDINATE
from ...sensor.units import millimetre
from ...sensor.view_images import view_files, view_of
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
    """The sensor that the arguments name."""
    return Sensor.from_file(sensor_file(arguments.sensor))


def view_number(arguments: Namespace, sensor: Sensor) -> int:
    """The number of the view that `--view` names; 0 of a sensor with one camera.

    Raises:
        MembraneError: none of several views is named, or one that there is not.
    """
    names = [view.name for view in sensor.views]
    if not names and arguments.view is not None:
        raise MembraneError(f"calibrate: --view {arguments.view}: {arguments.sensor} has one camera; leave --view out")
    if names and arguments.view not in names:
        given = "no --view" if arguments.view is None else f"--view {arguments.view}"
        raise MembraneError(f"calibrate: {given}: {arguments.sensor} has several views; expected --view {' | '.join(names)}")
    return names.index(arguments.view) if names else 0


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


def read_sensor_image(path: str | Path, sensor: Sensor, number: int = 0) -> np.ndarray:
    """An image `[H, W]` of the sensor's camera; of several views that of one of them, or its region of the one that they share.

    Args:
        path: path of the image, which must be as large as the camera's, or as the shared one.
        sensor: the sensor.
        number: number of the view, from 0.
    """
    camera = sensor.views[number].camera if sensor.views else sensor.camera
    if not sensor.views or sensor.views[number].region is None or camera.mode is None:
        return read_image(path, camera.image_size, camera.bits)
    region: np.ndarray = camera.mode.image(read_image(path, sensor.image_size, camera.bits))
    return region


def read_view_images(path: str | Path, sensor: Sensor) -> list[np.ndarray]:
    """Read the images of all views, `[H, W]` each: the files NAME_VIEW beside that of the first view, or regions of one image.

    Raises:
        MembraneError: an image is missing or has another size.
    """
    names = sensor.views_apart
    files = view_files(Path(path), names) if names else [Path(path)] * len(sensor.views)
    return [read_sensor_image(file, sensor, number) for number, file in enumerate(files)]


def read_targets(images: Sequence[str], sensor: Sensor, number: int, board: Checkerboard | DotBoard) -> np.ndarray:
    """The board's points in every image that shows it, `[P, D, 2]`; an image that shows none is reported and left out, and so
    are images NAME_VIEW of other views.

    Args:
        images: files, patterns, folders.
        sensor: the sensor.
        number: number of the view whose images they are, from 0; a mirror shows the board reversed.
        board: the board.
    """
    found, reason, given, own = [], "", single_images(find_inputs(images)), sensor.views and sensor.views[number].name
    paths = [path for path in given if view_of(path, sensor.views_apart) in (None, own)]
    if len(paths) < len(given):
        print(f"{len(given) - len(paths)} images left out, as their names are those of other views than {own!r}")
    mirrored = bool(sensor.views) and sensor.views[number].pose.determinant < 0
    for path in paths:
        image = read_sensor_image(path, sensor, number)
        try:
            found.append(reversed_target(image, board) if mirrored else find_target(image, board))
        except MembraneError as error:
            reason = str(error)
            print(f"{path} left out: {error}")
    if not found:
        raise MembraneError(f"calibrate: no image of {len(paths)} shows {board}: {reason}")
    return np.stack(found)


def reversed_target(image: np.ndarray, board: Checkerboard | DotBoard) -> np.ndarray:
    """The board's points `[D, 2]` in an image `[H, W]` that shows it in a mirror.

    Its points lie in a plane, so that a reflected pose of them is a rotated one, too: a lens fits them as it does others.
    """
    u, v = find_target(np.ascontiguousarray(image[:, ::-1]), board).T
    return np.stack([image.shape[1] - 1 - u, v], -1)


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
    """Return the known forces of the images, vectors `[B, 3]` in the camera's frame or magnitudes `[B, 1]`, N, NaN for images
    that the table does not list; and their standard deviations `[B]`, N, or None if the table has none.

    Args:
        path: path of the table, whose first column holds names of images.
        inputs: the B images.

    Raises:
        MembraneError: the table has other columns, a line names none of the images or one twice, a force is zero, or a
            standard deviation is negative.
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
