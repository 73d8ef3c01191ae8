"""Pressure readings of a recording: a gauge's log, by frame name or by time."""

from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from ..errors import MembraneError
from ..files.csv_table import Columns, Row, Table, read_table
from ..files.safe_read import shortened
from ..files.timestamps import time_in
from ..sensor.sensor import Sensor
from ..sensor.units import hectopascal
from .inputs import Inputs, frame_name

if TYPE_CHECKING:
    from ..reconstruct import Reconstructor

MOST_BYTES = 2**26
ACROSS, SINCE_REST = "pressure", "pressure_change"
NAME, TIME = "name", "time"
PRESSURES = Columns(
    [(key, kind) for key in (NAME, TIME) for kind in (ACROSS, SINCE_REST)],
    "reading",
    unit="hPa, across the membrane or since rest; time in seconds, or as 2026-09-27T11:38:29.25",
)
UNKNOWN = ("", "nan")
"""Cell contents that mean that a frame has no reading."""
KINDS = {"name": "frames", "image": "images"}
"""What the names in the first column of a table refer to."""
REACH, INTERVALS = 1.0, 1.5
"""Largest time between a frame and a reading that is used for it: seconds, or multiples of the readings' interval if that is
longer."""


class PressureReadings(NamedTuple):
    """Gauge readings, force unit / length unit^2.

    Attributes:
        values: readings by frame name; frames without a reading are left out.
        since_rest: whether the readings are changes since rest, or differences across the membrane.
        times: times of the readings, `[T]` seconds, increasing; empty for readings by name.
        series: readings at these times, `[T]`.
        unused: readings that belong to no frame of the call, as far as this is known before its videos are read.
    """

    values: dict[str, float]
    since_rest: bool
    times: np.ndarray = np.zeros(0)
    series: np.ndarray = np.zeros(0)
    unused: int = 0

    def at(self, name: str, time: float) -> float:
        """Return the reading of a frame, by its name or interpolated to its time (s); NaN if there is none."""
        if name in self.values or not len(self.times):
            return self.values.get(name, np.nan)
        near = np.isfinite(time) and np.abs(self.times - time).min() <= self.reach
        return float(np.interp(time, self.times, self.series)) if near else np.nan

    @property
    def reach(self) -> float:
        """Largest time difference, in s, at which a reading is used for a frame."""
        return max(REACH, INTERVALS * float(np.median(np.diff(self.times)))) if len(self.times) > 1 else REACH

    def plus(self, offset: float) -> "PressureReadings":
        """Return the readings with a constant added to each."""
        values = {name: offset + value for name, value in self.values.items()}
        return self._replace(values=values, series=offset + self.series)


def recording_pressures(reconstructor: "Reconstructor", path: Path, inputs: Inputs) -> PressureReadings:
    """Return the pressures across the membrane in a gauge's log, force unit / length unit^2.

    Args:
        reconstructor: reconstructor of the sensor.
        path: path of the table, in the format of `read_pressures`.
        inputs: inputs of the call.

    Raises:
        MembraneError: the estimator cannot use a pressure, or not for this cavity; the sensor has no modulus; the table is not
            as expected.
    """
    reconstructor.estimator.check_gauge()
    sensor = reconstructor.sensor
    if sensor.force_unit != "N":
        raise MembraneError(
            f"--pressure {path}: sensor {sensor.name!r} has no shear_modulus and thickness, its pressures are relative and hPa "
            "cannot be compared with them; add both to the sensor file, or find them by `torchmembrane calibrate material "
            "--pressure`"
        )
    found = read_pressures(path, inputs, sensor)
    return found.plus(float(reconstructor.rest_pressure)) if found.since_rest else found


def read_pressures(path: Path, inputs: Inputs, sensor: Sensor) -> PressureReadings:
    """Read a gauge's log: `pressure` or `pressure_change` by `name` or by `time`, hPa; 1 hPa = 100 N/m^2.

    Args:
        path: path of the table. A name is that of a frame or of its image file; a value may be empty or nan. Readings of other
            frames or at other times are counted as unused.
        inputs: files of the frames.
        sensor: sensor; its length unit is used.

    Raises:
        MembraneError: the table cannot be read, has another header, a repeated name or time, a value that is not a number, or
            no reading of any frame.
    """
    table = read_table(path, PRESSURES, MOST_BYTES)
    key, column = table.form
    known = Table(table.form, [row for row in table.rows if row.text(column).lower() not in UNKNOWN])
    if not known.rows:
        raise MembraneError(f"{path}: no readings after the header, only empty values; expected {PRESSURES.expected}")
    one, since_rest = hectopascal(sensor.length_unit), column == SINCE_REST
    if key == TIME:
        return _by_time(path, known, inputs, one, since_rest)
    given, others = by_frame(known, inputs)
    if not given:
        raise refusal(others[0], known, inputs)
    values = {frame: row.number(column) * one for frame, row in given.items()}
    return PressureReadings(values, since_rest, unused=len(others))


def _by_time(path: Path, table: Table, inputs: Inputs, one: float, since_rest: bool) -> PressureReadings:
    rows = sorted(((_time(row), row) for row in table.rows), key=lambda timed: timed[0])
    times = np.array([time for time, _ in rows])
    if len(twice := np.flatnonzero(np.diff(times) == 0)):
        raise rows[twice[0] + 1][1].refusal(TIME, f"each time once; line {rows[twice[0]][1].line} has it as well")
    series = np.array([row.number(table.form[1]) for _, row in rows]) * one
    readings = PressureReadings({}, since_rest, times, series)
    if inputs.videos:
        return readings
    taken = np.array([time_in(image.stem) for image in inputs.images])
    if np.isnan(taken).all():
        raise MembraneError(
            f"{path}: readings by time, and no image's name says when it was taken; expected names such as "
            "press_20260927T113829.250.png, or a table with a column name in place of time"
        )
    taken = taken[np.isfinite(taken)]
    near = np.abs(times[:, None] - taken).min(1) <= readings.reach
    if not near.any():
        raise MembraneError(
            f"{path}: no reading is within {readings.reach:g} s of an image: readings from {times[0]:.3f} to {times[-1]:.3f}, "
            f"images from {taken.min():.3f} to {taken.max():.3f} s since 1970; expected the times of one clock, dates as UTC"
        )
    return readings._replace(unused=int((~near).sum()))


def _time(row: Row) -> float:
    """Return the time of a reading, s."""
    text = row.text(TIME)
    dated = time_in(text)
    return row.number(TIME) if np.isnan(dated) or text.replace(".", "").isdigit() else dated


def by_frame(table: Table, inputs: Inputs) -> tuple[dict[str, Row], list[Row]]:
    """Return the lines of a table by the names of their frames, and the lines that belong to no frame.

    Args:
        table: table whose first column holds names of frames, or of their image files.
        inputs: files of the frames.

    Raises:
        MembraneError: a name is listed twice.
    """
    column = table.form[0]
    names = [(image.name, frame_name(image)) for image in inputs.images]
    frames = dict(names) | {name: name for _, name in names}
    found: dict[str, Row] = {}
    others: dict[str, Row] = {}
    for row in table.rows:
        if not (said := row.text(column)):
            raise row.refusal(column, f"a name of one of the {KINDS[column]}")
        name = frames.get(said, said)
        lines = found if said in frames or inputs.video_of(name) else others
        if name in lines:
            quoted = shortened(repr(said))
            raise MembraneError(f"{row.where}: {quoted} is listed twice, also in line {lines[name].line}; expected it once")
        lines[name] = row
    return found, list(others.values())


def refusal(row: Row, table: Table, inputs: Inputs) -> MembraneError:
    """Return the error for a line that belongs to no frame."""
    column = table.form[0]
    names = [image.name for image in inputs.images[:1]] + [f"{frame_name(video)}_000000" for video in inputs.videos[:1]]
    quoted = shortened(repr(row.text(column)))
    return MembraneError(f"{row.where}: {quoted} is none of the {KINDS[column]}; expected their names, as {' or '.join(names)}")
