"""What the steps of `torchmembrane calibrate` read and write: sensors, boards in images, tables, reports."""

import csv
from argparse import Namespace
from collections.abc import Sequence
from glob import glob
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from ...calibrate.detection import find_target
from ...calibrate.report import Report
from ...camera.targets import Checkerboard, DotBoard
from ...errors import MembraneError
from ...files.images import read_image
from ...files.safe_read import read_array, read_text
from ...files.targets import refuse_overwriting
from ...jobs.inputs import find_inputs
from ...plot.drawing import save
from ...presets import sensor_file
from ...sensor.companions import companions_of, files_of
from ...sensor.sensor import Sensor
from ...surface.checks import FARTHEST

if TYPE_CHECKING:
    from matplotlib.figure import Figure

MOST_TABLE_BYTES = 2**20
LARGEST_MOTION = 1e4  # length unit, and degrees
LISTS = ("images", "air", "medium")
FILES = ("image", "depth", "motions", "forces", "pressure", "pixels")
"""Arguments of the steps that name files to read: images, and single files."""


def read_sensor(arguments: Namespace) -> Sensor:
    """The sensor that the arguments name."""
    return Sensor.from_file(sensor_file(arguments.sensor))


def spare_files(step: str, arguments: Namespace) -> None:
    """Refuse a folder in which files would be written over, or that of the sensor that is calibrated.

    Args:
        step: of the calibration.
        arguments: of the command.
    """
    given = vars(arguments)
    read = [*files_of(sensor_file(arguments.sensor)), *(given[name] for name in FILES if given.get(name) is not None)]
    read += [path for name in LISTS for text in given.get(name, ()) for path in (text, *glob(text), *Path(text).glob("*"))]
    names = ("report.png", "layout.csv", "layout.svg") if step == "layout" else ("report.png", "report.json")
    targets = [*companions_of(arguments.out / "sensor.toml"), *(arguments.out / name for name in names)]
    refuse_overwriting(f"calibrate {step} --out {arguments.out}", targets, read, arguments.force)


def write_calibrated(arguments: Namespace, sensor: Sensor, report: Report, drawing: "Figure") -> int:
    """Write the calibrated sensor and its report, print what was found; returns the exit code."""
    path = sensor.to_file(arguments.out)
    report.write(arguments.out)
    save(drawing, arguments.out / "report.png", "calibrate")
    print("\n".join([*report.lines, f"calibrated sensor: {path}; report.json and report.png beside it"]))
    return 0


def read_sensor_image(path: str | Path, sensor: Sensor) -> np.ndarray:
    """An image `[H, W]` that must be as large as the sensor's."""
    return read_image(path, sensor.camera.image_size)


def read_targets(images: Sequence[str], sensor: Sensor, board: Checkerboard | DotBoard) -> np.ndarray:
    """The board's points in every image that shows it, `[P, D, 2]`; an image that shows none is reported and left out."""
    found = []
    for path in find_inputs(images).images:
        image = read_sensor_image(path, sensor)
        try:
            found.append(find_target(image, board))
        except MembraneError as error:
            print(f"{path} left out: {error}")
    if not found:
        raise MembraneError(f"calibrate: no image of {len(images)} shows {board}")
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
    """A depth image `[H, W]` in the sensor's length unit; `unit`: of one step of the file's values."""
    values = read_array(path) if path.suffix == ".npy" else read_image(path).astype(float) * 65535
    depth: np.ndarray = values.astype(float) * unit
    if (np.abs(depth) > FARTHEST).any():
        raise MembraneError(f"{path}: depths up to {np.nanmax(depth):g}; expected at most {FARTHEST:g}: check --unit {unit:g}")
    return depth
