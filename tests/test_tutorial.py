"""The tutorial's commands and its Python run from top to bottom, and what it says comes out; so does the recipes' Python."""

import csv
import re
import shlex
import tomllib
from pathlib import Path

import numpy as np
import pytest

from torchmembrane.cli.main import main

ROOT = Path(__file__).parents[1]
TUTORIAL, BUBBLE, RECIPES = ((ROOT / "docs" / f"{name}.md").read_text() for name in ("own_sensor", "own_bubble", "recipes"))


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


@pytest.fixture(scope="module")
def walked(tmp_path_factory):
    """The folder after the tutorial's commands."""
    folder = tmp_path_factory.mktemp("tutorial")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        for call in commands(TUTORIAL):
            assert main(call) == 0, call
        yield folder


def test_the_tutorial_ends_with_the_force_in_newtons(walked):
    (row,) = csv.DictReader((walked / "results" / "summary.csv").open())
    true = float(np.linalg.norm(np.load(walked / "photos" / "press_truth.npz")["force"]))
    assert row["force_unit"] == "N" and float(row["force"]) == pytest.approx(true, rel=0.1)
    assert f"says {float(row['force']):.2f} N; the truth is {true:.3f} N" in words(TUTORIAL)
    weight = float(np.linalg.norm(np.load(walked / "photos" / "weight_truth.npz")["force"]))
    (grams,) = re.findall(r"--weight ([\d.]+)g", TUTORIAL)
    assert float(grams) * 9.80665e-3 == pytest.approx(weight, rel=1e-3)


def test_the_tutorial_s_python_runs(walked, capsys):
    exec(compile(python(TUTORIAL), "own_sensor.md", "exec"), {})
    rest, weight, press = capsys.readouterr().out.splitlines()
    assert "nan" in rest and "nan" not in weight + press


def test_the_bubble_s_gauge_gives_newtons(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (readings,) = re.findall(r"```csv\n(.*?)```", BUBBLE, re.S)
    Path("gauge.csv").write_text(readings)
    for call in commands(BUBBLE):
        assert main(call) == 0, call
    gauged, press = (np.load(f"photos/{name}_truth.npz") for name in ("gauged", "press"))
    hectopascal = 1e4 * float(gauged["p"] - gauged["p0"])
    assert float(readings.split("gauged,")[1]) == pytest.approx(hectopascal, abs=0.006)
    (row,) = csv.DictReader(Path("results/summary.csv").open())
    true = float(np.linalg.norm(press["force"]))
    assert row["force_unit"] == "N" and float(row["force"]) == pytest.approx(true, rel=0.1)
    assert f"says {float(row['force']):.2f} N; the truth is {true:.3f} N" in words(BUBBLE)
    found = tomllib.loads(Path("material/sensor.toml").read_text())["material"]
    assert f"prestretch of {found['prestretch']:.2f} ±" in words(BUBBLE)


def test_the_recipes_python_runs(monkeypatch):
    monkeypatch.chdir(ROOT)
    names: dict = {}
    exec(compile(python(RECIPES), "recipes.md", "exec"), names)
    assert len(names["points"]) > 3 and names["normals"].shape == names["points"].shape
    assert int(names["result"].status[0]) == 0 and names["result"].displacement.abs().max() < 1e-3
