"""Exported models of random sensors of the whole span against torch, those of `bench/accuracy/exports.py` on small grids."""

import pytest

from bench.accuracy.exports import compared, drawn


@pytest.mark.parametrize("number, lines", [(0, 9), (1, 9), (2, 9), (4, 9), (6, 9), (9, 9)])
def test_an_exported_model_gives_what_torch_gives(number, lines, tmp_path):
    """Odd ones track."""
    sensor = drawn(number, lines)
    row = compared(number, tmp_path, sensor)
    assert row["same"], row
    assert sensor.membrane.grid == (lines, lines) and row["displacement"] > 0.1 and row["megabytes"] < 10
