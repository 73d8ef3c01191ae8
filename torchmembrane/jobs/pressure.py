"""A recording's pressure readings: a table of a gauge's values, by the frames' names."""

from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from ..errors import MembraneError
from ..files.csv_table import Columns, Row, Table, read_table
from ..files.safe_read import shortened
from ..sensor.parts import METRE
from ..sensor.sensor import Sensor
from .inputs import Inputs, frame_name

if TYPE_CHECKING:
    from ..reconstruct import Reconstructor

MOST_BYTES = 2**26
ACROSS, SINCE_REST = "pressure", "pressure_change"
PRESSURES = Columns([("name", ACROSS), ("name", SINCE_REST)], "reading", unit="hPa, across the membrane or since rest")
UNKNOWN = ("", "nan")
"""Cells of frames that have no reading."""
KINDS = {"name": "frames", "image": "images"}
"""What a table's first column names."""


class PressureReadings(NamedTuple):
    """What a gauge read.

    Attributes:
        values: by the names of the frames, force unit / length unit^2; frames without a reading are left out.
        since_rest: whether these are changes since rest, or differences across the membrane.
    """

    values: dict[str, float]
    since_rest: bool


def recording_pressures(reconstructor: "Reconstructor", path: Path, inputs: Inputs) -> dict[str, float]:
    """The pressures across the membrane that a table holds, by the names of the frames, force unit / length unit^2.

    Args:
        reconstructor: the sensor's.
        path: of the table, as for `read_pressures`.
        inputs: of the call.

    Raises:
        MembraneError: a pressure tells nothing to this estimator or of this cavity; the sensor has no modulus; the table is not
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
    values, since_rest = read_pressures(path, inputs, sensor)
    offset = float(reconstructor.rest_pressure) if since_rest else 0.0
    return {name: offset + value for name, value in values.items()}


def read_pressures(path: Path, inputs: Inputs, sensor: Sensor) -> PressureReadings:
    """Read a table `name,pressure` or `name,pressure_change`, hPa; 1 hPa = 100 N/m^2.

    Args:
        path: of the table. A name is that of a frame or of its image file; a value may be left empty, or be nan.
        inputs: the frames.
        sensor: gives the length unit.

    Raises:
        MembraneError: the table cannot be read, or has another header, a name that is no frame's, a name twice, no number.
    """
    table = read_table(path, PRESSURES, MOST_BYTES)
    name, column = table.form
    hectopascal = 100 / METRE[sensor.length_unit] ** 2
    given = {frame: row for frame, row in by_frame(table, inputs).items() if row.text(column).lower() not in UNKNOWN}
    if not given:
        raise MembraneError(f"{path}: no readings after the header but empty ones; expected {PRESSURES.expected}")
    return PressureReadings({frame: row.number(column) * hectopascal for frame, row in given.items()}, column == SINCE_REST)


def by_frame(table: Table, inputs: Inputs) -> dict[str, Row]:
    """The lines of a table by the names of the frames that they tell of.

    Args:
        table: whose first column holds names of frames, or of their image files.
        inputs: the frames.

    Raises:
        MembraneError: a name that is no frame's, or that stands there twice.
    """
    column = table.form[0]
    names = [(image.name, frame_name(image)) for image in inputs.images]
    frames = dict(names) | {name: name for _, name in names}
    found: dict[str, Row] = {}
    for row in table.rows:
        said = row.text(column)
        name, quoted = frames.get(said, said), shortened(repr(said))
        if said not in frames and inputs.video_of(name) is None:
            raise MembraneError(f"{row.where}: {quoted} is none of the {KINDS[column]}; expected {_known(inputs)}")
        if name in found:
            raise MembraneError(f"{row.where}: {quoted} stands there twice, also in line {found[name].line}; expected it once")
        found[name] = row
    return found


def _known(inputs: Inputs) -> str:
    names = [image.name for image in inputs.images[:1]] + [f"{frame_name(video)}_000000" for video in inputs.videos[:1]]
    return f"their names, as {' or '.join(names)}"
