"""Exported models of random sensors agree with torch."""

import pytest

from bench.accuracy import exports
from torchmembrane.onnx import export


def assert_same(number, folder):
    """Odd ones track."""
    sensor = exports.drawn(number, 9)
    row = exports.compared(number, folder, sensor)
    assert row["same"], row
    assert sensor.membrane.grid == (9, 9) and row["displacement"] > 0.1 and row["megabytes"] < 10


def test_an_exported_model_gives_what_torch_gives(tmp_path, monkeypatch):
    """Of the slack dome of gas, compared once: not by `export` as well."""
    monkeypatch.setattr(export, "checked", lambda *_: None)
    monkeypatch.setattr(exports, "rounding", lambda *_: 0.0)
    assert_same(0, tmp_path)


@pytest.mark.full
@pytest.mark.parametrize("number", [0, 1, 2, 4, 6, 9])
def test_exported_models_of_all_kinds_of_sensors_give_what_torch_gives(number, tmp_path):
    assert_same(number, tmp_path)
