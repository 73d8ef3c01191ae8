"""A recording's pressure readings: a table of a gauge's values, by the frames' names."""

import csv
import math
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from ..errors import MembraneError
from ..files.safe_read import in_one_line, read_text, shortened
from ..sensor.parts import METRE
from ..sensor.sensor import Sensor
from .inputs import Inputs, frame_name

if TYPE_CHECKING:
    from ..reconstruct import Reconstructor

MOST_BYTES = 2**26
HEADERS = (["name", "pressure"], ["name", "pressure_change"])
EXPECTED = "CSV with the header name,pressure (across the membrane) or name,pressure_change (since rest), hPa, a line per frame"


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
    try:
        header, *rows = csv.reader(read_text(path, MOST_BYTES, EXPECTED).splitlines())
    except MembraneError:
        raise
    except (csv.Error, ValueError) as error:
        raise MembraneError(f"{path}: not readable ({in_one_line(error)}); expected {EXPECTED}") from error
    if header not in HEADERS:
        raise MembraneError(f"{path}: the header is {shortened(repr(','.join(header)))}; expected {EXPECTED}")
    names = [(image.name, frame_name(image)) for image in inputs.images]
    stems = dict(names) | {name: name for _, name in names}
    readings: dict[str, float] = {}
    for line, row in enumerate(rows, 2):
        where = f"{path}, line {line}"
        if len(row) != 2:
            raise MembraneError(f"{where}: {len(row)} values; expected two, {','.join(header)}")
        name = stems.get(row[0], row[0])
        if row[0] not in stems and inputs.video_of(name) is None:
            raise MembraneError(f"{where}: {shortened(repr(row[0]))} is none of the frames; expected {_known(inputs)}")
        if name in readings:
            raise MembraneError(f"{where}: {shortened(repr(row[0]))} stands there twice; expected one reading for each frame")
        readings[name] = _number(row[1], where)
    known = {name: value * 100 / METRE[sensor.length_unit] ** 2 for name, value in readings.items() if not math.isnan(value)}
    if not known:
        raise MembraneError(f"{path}: no readings after the header; expected {EXPECTED}")
    return PressureReadings(known, header == HEADERS[1])


def _number(text: str, where: str) -> float:
    try:
        value = float(text) if text.strip() else math.nan
    except ValueError:
        value = math.inf
    if math.isinf(value):
        raise MembraneError(f"{where}: {shortened(repr(text))}; expected hPa, or nothing where there is no reading")
    return value


def _known(inputs: Inputs) -> str:
    names = [frame_name(image) for image in inputs.images[:1]] + [f"{frame_name(video)}_000000" for video in inputs.videos[:1]]
    return f"their names, as {' or '.join(names)}"
