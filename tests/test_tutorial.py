"""The tutorial and the recipes run, and their numbers come out.

Marked `full`: the pages as they are. Beside them: their commands on coarser grids, of a material that is told.
"""

import csv
import re
import shlex
import shutil
import tomllib
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from torchmembrane.cli.main import command_parser, main
from torchmembrane.sensor.sensor import Sensor

ROOT = Path(__file__).parents[1]
PAGES = ("own_sensor", "own_bubble", "own_window", "recipes")
TUTORIAL, BUBBLE, WINDOW, RECIPES = ((ROOT / "docs" / f"{name}.md").read_text() for name in PAGES)


def words(page: str) -> str:
    """The page with its lines joined."""
    return " ".join(page.split())


def commands(page: str) -> list[list[str]]:
    """The commands of the blocks that begin with ```sh, as lists of arguments."""
    text = "\n".join(re.findall(r"```sh\n(.*?)```", page, re.S)).replace("\\\n", " ")
    calls = [shlex.split(line) for line in text.splitlines() if line.strip()]
    assert all(call[0] == "torchmembrane" for call in calls)
    return [call[1:] for call in calls]


def python(page: str) -> str:
    return "\n".join(re.findall(r"```python\n(.*?)```", page, re.S))


def run_python(capsys: pytest.CaptureFixture) -> None:
    """Run the tutorial's program beside its photographs: it prints no contact at rest, and one of each press."""
    exec(compile(python(TUTORIAL), "own_sensor.md", "exec"), {})
    rest, weight, press = capsys.readouterr().out.splitlines()
    assert "nan" in rest and "nan" not in weight + press


def walk_shortly(page: str) -> None:
    """The page's sensor files, its last press and its last reconstruction, on coarser grids; its material is not calibrated."""
    calls = commands(page)
    presses = [call for call in calls if call[0] == "simulate"]
    for call in [call for call in calls if call[0] == "init" and "--rest" not in call]:
        assert main(call) == 0, call
    coarser = Path("real.toml").read_text().replace("grid = [33, 33]", "grid = [17, 17]")
    Path("real.toml").write_text(coarser)
    assert main([*presses[-1], "--grid", "26,26"]) == 0
    (photographed,) = (call for call in calls if call[0] == "init" and "--rest" in call)
    assert main(photographed) == 0
    real, mine = Sensor.from_file("real.toml"), Sensor.from_file("mine.toml")
    told = replace(mine, material=real.material, cavity=real.cavity, membrane=mine.surface.membrane((17, 17)))
    Path("material").mkdir()
    told.to_file("material/sensor.toml")
    assert main(calls[-1]) == 0


def assert_newtons() -> dict[str, Any]:
    """The press's force is the true one, in newtons, within a tenth; its row of the summary."""
    (row,) = csv.DictReader(Path("results/summary.csv").open())
    true = float(np.linalg.norm(np.load("photos/press_truth.npz")["force"]))
    assert row["force_unit"] == "N" and float(row["force"]) == pytest.approx(true, rel=0.1)
    return row | {"true": true}


@pytest.mark.parametrize("page", [TUTORIAL, BUBBLE, WINDOW], ids=["dome", "bubble", "window"])
def test_every_command_of_a_page_is_one(page):
    parser = command_parser()
    for call in commands(page):
        parser.parse_args(call)


def test_from_the_tutorial_s_photographs_to_newtons_in_short(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    walk_shortly(TUTORIAL)
    assert_newtons()
    shutil.copy("photos/press.png", "photos/weight.png")
    capsys.readouterr()
    run_python(capsys)


def test_from_the_bubble_s_photographs_to_newtons_in_short(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    walk_shortly(BUBBLE)
    assert_newtons()


@pytest.mark.full
def test_the_tutorial_ends_with_the_force_in_newtons(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    for call in commands(TUTORIAL):
        assert main(call) == 0, call
    row = assert_newtons()
    assert f"{float(row['force']):.2f} N; the true force is {row['true']:.3f} N" in words(TUTORIAL)
    weight = float(np.linalg.norm(np.load("photos/weight_truth.npz")["force"]))
    (grams,) = re.findall(r"--weight ([\d.]+)g", TUTORIAL)
    assert float(grams) * 9.80665e-3 == pytest.approx(weight, rel=1e-3)
    capsys.readouterr()
    run_python(capsys)


@pytest.mark.full
def test_the_bubble_s_gauge_gives_newtons(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (readings,) = re.findall(r"```csv\n(.*?)```", BUBBLE, re.S)
    Path("gauge.csv").write_text(readings)
    for call in commands(BUBBLE):
        assert main(call) == 0, call
    gauged = np.load("photos/gauged_truth.npz")
    hectopascal = 1e4 * float(gauged["p"] - gauged["p0"])
    assert float(readings.split("gauged,")[1]) == pytest.approx(hectopascal, abs=0.006)
    row = assert_newtons()
    assert f"{float(row['force']):.2f} N; the true force is {row['true']:.3f} N" in words(BUBBLE)
    found = tomllib.loads(Path("material/sensor.toml").read_text())["material"]
    assert f"prestretch of {found['prestretch']:.2f} ±" in words(BUBBLE)


@pytest.mark.full
def test_the_window_s_ruler_and_gauge_give_newtons(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for call in commands(WINDOW):
        assert main(call) == 0, call
    row = assert_newtons()
    assert f"{float(row['force']):.3f} N; the true force is {row['true']:.3f} N" in words(WINDOW)


def test_the_recipes_python_runs(monkeypatch):
    monkeypatch.chdir(ROOT)
    names: dict = {}
    exec(compile(python(RECIPES), "recipes.md", "exec"), names)
    assert len(names["points"]) > 3 and names["normals"].shape == names["points"].shape
    assert int(names["result"].status[0]) == 0 and names["result"].displacement.abs().max() < 1e-3
