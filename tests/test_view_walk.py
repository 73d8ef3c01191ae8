"""The commands of the page on several views run from top to bottom.

Two webcams, a rest photograph of each, one weight, one press.
"""

from pathlib import Path

import numpy as np
import pytest
from test_tutorial import ROOT, assert_newtons, commands, walk_shortly, words

from torchmembrane.cli.main import main
from torchmembrane.sensor.sensor import Sensor

PAGE = (ROOT / "docs" / "several_views.md").read_text()


def test_two_webcams_on_coarser_grids(tmp_path, monkeypatch, quick_images):
    monkeypatch.chdir(tmp_path)
    walk_shortly(PAGE)
    assert_newtons()
    mine, real = (Sensor.from_file(f"{name}.toml").views[1].pose for name in ("mine", "real"))
    assert np.abs(mine.translation - real.translation).max() < 0.03


@pytest.mark.full
def test_two_webcams_and_a_printed_pattern(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for call in commands(PAGE):
        assert main(call) == 0, call
    row = assert_newtons()
    mine, real = (Sensor.from_file(f"{name}.toml").views[1].pose for name in ("mine", "real"))
    place, off = ", ".join(f"{value:.2f}" for value in mine.translation), np.linalg.norm(mine.translation - real.translation)
    for said in (f"second webcam at {place} mm", f"{off:.3f} mm off", f"{-float(row['deepest']):.2f} mm deep"):
        assert said in words(PAGE), said
    assert f"{float(row['force']):.2f} N; in truth 3.00 mm and {row['true']:.2f} N" in words(PAGE)
    assert Path("results/press_left.png").exists()
