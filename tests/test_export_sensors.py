"""Exported models of random sensors agree with torch.

Those of `bench/accuracy/exports.py` on small grids; beside them `tests/test_export.py` has a small sensor.
"""

import pytest

from bench.accuracy import exports


@pytest.mark.full
@pytest.mark.parametrize("number", [0, 1, 2, 4, 6, 9])
def test_exported_models_of_all_kinds_of_sensors_give_what_torch_gives(number, tmp_path):
    """Odd ones track."""
    sensor = exports.drawn(number, 9)
    row = exports.compared(number, tmp_path, sensor)
    assert row["same"], row
    assert sensor.membrane.grid == (9, 9) and row["displacement"] > 0.1 and row["megabytes"] < 10
