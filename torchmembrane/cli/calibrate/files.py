"""What the steps of `torchmembrane calibrate` read and write: sensors, boards in images, tables, reports."""

import csv
from argparse import Namespace
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from ...calibrate.detection import find_target
from ...calibrate.report import Report
from ...camera.targets import Checkerboard, DotBoard
from ...errors import MembraneError
from ...files.images import read_image, read_pixels
from ...files.safe_read import read_array, read_text
from ...jobs.inputs import find_inputs, single_images
from ...plot.drawing import save
from ...presets import sensor_file
from ...sensor.sensor import Sensor
from ...surface.checks import FARTHEST

if TYPE_CHECKING:
    from matplotlib.figure import Figure

MOST_TABLE_BYTES = 2**20
LARGEST_MOTION = 1e4  # length unit, and degrees


def read_sensor(arguments: Namespace) -> Sensor:
    """The sensor that the arguments name."""
    return Sensor.from_file(sensor_file(arguments.sensor))


def write_calibrated(arguments: Namespace, sensor: Sensor, report: Report, drawing: "Figure") -> int:
    """Write the calibrated sensor and its report, print what was found; returns the exit code."""
    path = sensor.to_file(arguments.out)
    report.write(arguments.out)
    save(drawing, arguments.out / "report.png")
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
    """Where the camera was, `[P, 6]`: position (length unit) and rotation vector (degrees) of each view."""
    expected = "CSV with the header x,y,z,turn_x,turn_y,turn_z and one line per image"
    text = read_text(path, MOST_TABLE_BYTES, expected)
    try:
        rows = np.loadtxt(text.splitlines(), delimiter=",", skiprows=1, ndmin=2)
    except ValueError as error:
        raise MembraneError(f"{path}: not readable ({error}); expected {expected}") from error
    if rows.shape[1] != 6 or not (np.abs(rows) <= LARGEST_MOTION).all():
        limit = f"six finite numbers up to {LARGEST_MOTION:g}, x,y,z,turn_x,turn_y,turn_z"
        raise MembraneError(f"{path}: {rows.shape[1]} columns, largest {np.abs(rows).max(initial=0):g}; expected {limit}")
    return rows


def read_forces(path: Path, images: Sequence[Path]) -> np.ndarray:
    """Forces of the images `[B, 3]`, or magnitudes `[B, 1]`, N, NaN where the file has none."""
    expected = "CSV with the header image,fx,fy,fz or image,force and one line per image, N"
    text = read_text(path, MOST_TABLE_BYTES, expected)
    try:
        header, *rows = csv.reader(text.splitlines())
        known = {name: [float(value) for value in values] for name, *values in rows}
    except (csv.Error, ValueError) as error:
        raise MembraneError(f"{path}: not readable ({error}); expected {expected}") from error
    if header not in (["image", "fx", "fy", "fz"], ["image", "force"]):
        raise MembraneError(f"{path}: the header is {','.join(header)!r}; expected {expected}")
    if wrong := [name for name, values in known.items() if len(values) != len(header) - 1 or not np.isfinite(values).all()]:
        raise MembraneError(f"{path}: {wrong[0]} has {known[wrong[0]]}; expected {len(header) - 1} finite numbers")
    if unknown := known.keys() - {image.name for image in images}:
        raise MembraneError(f"{path}: {min(unknown)} is none of the images given; expected their names, as {images[0].name}")
    if not known:
        raise MembraneError(f"{path}: no forces after the header; expected {expected}")
    return np.array([known.get(image.name, [np.nan] * (len(header) - 1)) for image in images])


def read_depth(path: Path, unit: float) -> np.ndarray:
    """A depth image `[H, W]` in the sensor's length unit, NaN where there is none; `unit`: of one step of the file's values.

    As ROS has them: 16 bits, 0 where there is none, or float, NaN and infinities there.
    """
    values = read_array(path) if path.suffix == ".npy" else read_pixels(path)
    expected = "[H, W] of float or of 16 bits or more, z along the camera's axis"
    if values.ndim == 3 and values.shape[2] == 1:
        values = values[..., 0]
    if values.ndim != 2 or values.dtype.itemsize < 2:
        raise MembraneError(f"{path}: an array {list(values.shape)} of {values.dtype}; expected {expected}")
    depth = values.astype(float) * unit
    depth[~np.isfinite(depth)] = np.nan
    if (np.abs(depth) > FARTHEST).any():
        raise MembraneError(f"{path}: depths up to {np.nanmax(depth):g}; expected at most {FARTHEST:g}: check --unit {unit:g}")
    return depth
