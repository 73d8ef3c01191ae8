"""A sensor's record reaches results and models unchanged."""

import json
from dataclasses import replace
from datetime import date

import numpy as np
import pytest

import torchmembrane as tm
from torchmembrane.cli.describe import described
from torchmembrane.onnx.export import metadata_of
from torchmembrane.results.npz import save_frame
from torchmembrane.results.store import Mesh, Settings
from torchmembrane.sensor.record import Record

KNOWN = Record("A 17", date(2026, 9, 27), 12, "calibrate material", 0.04)


@pytest.fixture
def sensor(small_sensor):
    sensor = tm.Sensor.from_file(small_sensor / "sensor.toml")
    return replace(sensor, markers=replace(sensor.markers, rest_image=None))


@pytest.mark.parametrize("record", [KNOWN, Record(), Record(serial="=1"), Record(calibrated=date(2026, 1, 2), uncertainty=0.0)])
def test_a_record_is_written_and_read_and_is_no_part_of_the_fingerprint(record, sensor, tmp_path):
    path = replace(sensor, record=record).to_file(tmp_path)
    read = tm.Sensor.from_file(path)
    assert read.record == record and read.fingerprint == sensor.fingerprint
    assert ("[record]" in path.read_text()) == bool(record.known)


def test_a_day_may_be_in_quotes(sensor, tmp_path):
    path = sensor.to_file(tmp_path)
    path.write_text(f'{path.read_text()}\n[record]\ncalibrated = "2026-09-27"\n')
    assert tm.Sensor.from_file(path).record == Record(calibrated=date(2026, 9, 27))


@pytest.mark.parametrize(
    "line, said",
    [
        ("calibrated = 2026-09-27T10:00:00", "calibrated = 2026-09-27T10:00:00; expected a day as 2026-09-27"),
        ('calibrated = "yesterday"', "expected a day as 2026-09-27"),
        ("calibrated = 20260927", "expected a day as 2026-09-27"),
        ("serial = 17", "serial = 17; expected text in quotes"),
        ("images = 0", "images = 0; expected 1 or more"),
        ("images = 1.5", "expected a whole number"),
        ("uncertainty = -0.1", "uncertainty = -0.1; expected 0 or more"),
        ("owner = 'me'", "owner"),
    ],
)
def test_what_is_no_record_is_refused_with_file_and_key(line, said, sensor, tmp_path):
    path = sensor.to_file(tmp_path)
    path.write_text(f"{path.read_text()}\n[record]\n{line}\n")
    with pytest.raises(tm.MembraneError) as refused:
        tm.Sensor.from_file(path)
    assert str(path) in str(refused.value) and "[record]" in str(refused.value) and said in str(refused.value)


def test_results_and_models_carry_the_record(sensor, tmp_path):
    reconstructor = tm.Reconstructor(replace(sensor, record=KNOWN))
    mesh = Mesh.from_reconstructor(reconstructor, Settings.from_reconstructor(reconstructor, "npz"))
    mesh.save(tmp_path / "mesh.npz")
    carried = {"serial": "A 17", "calibrated": "2026-09-27", "images": 12, "by": "calibrate material", "uncertainty": 0.04}
    assert json.loads(Mesh.load(tmp_path / "mesh.npz").record) == carried
    assert json.loads(json.loads(metadata_of(reconstructor)["mesh"])["record"]) == carried
    earlier = {key: value for key, value in mesh._asdict().items() if key != "record"}
    save_frame(tmp_path / "mesh.npz", {key: np.asarray(value) for key, value in earlier.items()})
    assert Mesh.load(tmp_path / "mesh.npz").record == ""


@pytest.mark.parametrize(
    "day, age", [(date(2026, 9, 27), "today"), (date(2026, 9, 28), "1 day ago"), (date(2026, 11, 27), "61 days ago")]
)
def test_the_age_of_a_calibration_is_said(day, age):
    serial, calibration = KNOWN.said(day)
    assert serial == "serial A 17"
    assert calibration == f"calibrated 2026-09-27, {age}, from 12 images, by calibrate material, forces known to 4 %"


def test_check_says_the_record_or_that_there_is_none(sensor):
    with_record, without = (described(replace(sensor, record=record)) for record in (KNOWN, Record()))
    assert any(line.startswith("record    serial A 17") for line in with_record)
    assert any(line.startswith("record    none") for line in without)
