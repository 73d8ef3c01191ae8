"""The reference names every key, column, option and status."""

import ast
import importlib
import re
import sys
import tomllib
from pathlib import Path

import numpy as np
import pytest

import torchmembrane as tm
from torchmembrane.results.store import Mesh
from torchmembrane.results.summary_row import NAMES
from torchmembrane.sensor import parts, units
from torchmembrane.sensor.table import Table
from torchmembrane.sensor.toml import read_sensor

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"
SENSOR_FILE, RESULTS, API = ((DOCS / f"{name}.md").read_text() for name in ("sensor_file", "results", "api"))
CAMERA = """
format = 1
name = "a"
length_unit = "mm"
[camera]
model = "pinhole"
image_size = [64, 48]
focal = [50.0, 50.0]
centre = [32.0, 24.0]
distortion = []
[[camera.ports]]
distance = 1.0
thickness = 1.0
index = 1.5
[camera.medium]
index = 1.33
"""
EVERYTHING = """
[material]
model = "neo_hookean"
prestretch = 1.2
[cavity]
filling = "liquid"
[markers]
kind = "dots"
polarity = "dark"
file = "dots.csv"
[tool]
rotation = [0, 0, 0]
translation = [0, 0, 0]
[record]
serial = "A17"
"""
SURFACES = {
    "spherical_cap": "rim_radius = 9.0\nheight = 6.0\nbase_z = 20.0",
    "ellipsoid_cap": "semi_axes = [9.0, 8.0, 7.0]\nbase_z = 20.0",
    "half_cylinder": "radius = 9.0\nlength = 20.0\nhalf_angle = 70.0\nbase_z = 20.0",
    "grid": 'file = "grid.npz"',
    "heightfield": 'file = "field.npz"',
}


def quoted(page: str) -> set[str]:
    return set(re.findall(r"`\"?(\w+)\"?`", page))


@pytest.fixture
def keys(tmp_path, monkeypatch):
    """All keys that reading accepts, of files of all shapes."""
    found, allow = set(), Table.allow

    def noted(self, keys, *owner):
        found.update(keys := list(keys))
        allow(self, keys, *owner)

    monkeypatch.setattr(Table, "allow", noted)
    monkeypatch.chdir(tmp_path)
    x = np.linspace(-9, 9, 9)
    a, b = np.meshgrid(x, x, indexing="ij")
    z = 26 - (a**2 + b**2) / 40
    np.savez("field.npz", x=x, y=x, z=z)
    fixed = np.pad(np.zeros((7, 7), bool), 1, constant_values=True)
    np.savez("grid.npz", vertices=np.stack([a, b, z], -1), fixed=fixed)
    Path("dots.csv").write_text("x,y,z,size\n0.0,0.0,26.0,small\n")
    assert SURFACES.keys() == parts.SHAPES_BY_NUMBERS.keys() | parts.SHAPES_BY_ARRAYS.keys()
    for shape, numbers in SURFACES.items():
        Path("sensor.toml").write_text(f'{CAMERA}[membrane]\nshape = "{shape}"\ngrid = [9, 9]\n{numbers}\n{EVERYTHING}')
        try:
            read_sensor(Path("sensor.toml"))
        except tm.MembraneError as error:
            assert "off the rest surface" in str(error)  # the one dot; all tables have been read
    Path("design.toml").write_text(Path("sensor.toml").read_text().replace('file = "dots.csv"\n', ""))
    read_sensor(Path("design.toml"), undotted=True)
    return found


def test_every_key_of_the_sensor_file_and_every_word_is_in_the_reference(keys):
    assert len(keys) > 40
    words = {*parts.MODELS, *parts.FILLINGS, *SURFACES, *units.METRE, "pinhole", "fisheye", "dots", "texture", "dark", "light"}
    arrays = {name for names in parts.SHAPES_BY_ARRAYS.values() for name in names}
    assert (keys | words | arrays | {"large", "small"}) <= quoted(SENSOR_FILE)


def test_the_reference_s_sensor_file_is_one(keys):
    text = re.search(r"```toml\n(.*?)```", SENSOR_FILE, re.S)[1]
    file = tomllib.loads(text)
    assert {key for table in file.values() if isinstance(table, dict) for key in table} | file.keys() <= keys


def test_every_array_column_and_status_is_in_the_reference():
    columns = {re.sub(r"contact_\d", "contact_K", name) for name in NAMES}
    assert {*tm.Reconstruction._fields, *Mesh._fields, *columns} <= quoted(RESULTS)
    for status in tm.Status:
        assert f"| {int(status)} | `{status.name}` |" in RESULTS
        assert f"| {int(status)} `{status.name}` |" in (DOCS / "faq.md").read_text() or status is tm.Status.OK


def words_of_warnings() -> list[str]:
    """The constant words of every warning in the package, also where a function of the same module words it."""
    found = []
    for path in sorted((ROOT / "torchmembrane").rglob("*.py")):
        tree = ast.parse(path.read_text())
        functions = {node.name: node for node in ast.walk(tree) if isinstance(node, ast.FunctionDef)}
        for call in (node for node in ast.walk(tree) if isinstance(node, ast.Call) and ast.unparse(node.func) == "warn_user"):
            worded = call.args[0]
            if isinstance(worded, ast.Call):
                worded = functions[ast.unparse(worded.func)]
            if isinstance(worded, ast.Name):
                worded = next(
                    node.value for node in tree.body if isinstance(node, ast.Assign) and node.targets[0].id == worded.id
                )
            constants = [node.value for node in ast.walk(worded) if isinstance(node, ast.Constant)]
            found.append("\n".join(text for text in constants if isinstance(text, str)))
    return found


def test_every_warning_has_its_line_among_the_questions_and_no_other_has_one():
    section = re.search(r"^## A warning$(.*?)^## ", (DOCS / "faq.md").read_text(), re.M | re.S)[1]
    lines = [re.findall(r"`([^`]+)`", row.split(" | ")[0]) for row in section.splitlines() if row.startswith("| `")]
    warnings = words_of_warnings()
    assert len(warnings) == len(lines) >= 4
    for warning in warnings:
        assert sum(all(words in warning for words in line) for line in lines) == 1, warning
    for line in lines:
        assert sum(all(words in warning for words in line) for warning in warnings) == 1, line


def test_every_option_is_in_the_reference():
    sys.path.insert(0, str(DOCS))
    try:
        import reference
    finally:
        sys.path.remove(str(DOCS))
    assert (DOCS / "command.md").read_text() == reference.page(), "python docs/reference.py makes it anew"


@pytest.mark.parametrize("face", [tm, tm.simulate, tm.calibrate], ids=lambda face: face.__name__)
def test_every_public_name_is_in_the_reference(face):
    named = set(re.findall(r"^::: torchmembrane\.(?:\w+\.)*(\w+)$", API, re.M)) | {"simulate", "calibrate", "__version__"}
    assert set(face.__all__) <= named


def test_the_site_keeps_options_and_short_names_whole_and_opens_pictures(monkeypatch):
    monkeypatch.syspath_prepend(str(DOCS))
    page = importlib.import_module("hooks").on_page_content(
        "<pre><code>check --out a.png</code></pre><table><tr><td><code>UNLIKE_REST</code></td>"
        '<td><code>tm.calibrate.rest_from_image</code></td><td><code>a\\|b</code></td></tr></table><img alt="x" src="a.png" />'
    )
    assert '<code>check <span class="whole">--out</span> a.png</code>' in page
    assert '<td><span class="whole"><code>UNLIKE_REST</code></span></td>' in page
    assert "<code>tm.<wbr>calibrate.<wbr>rest_<wbr>from_<wbr>image</code>" in page
    assert "<code>a|b</code>" in page
    assert page.endswith('<a href="a.png"><img alt="x" src="a.png" /></a>')


def test_every_page_has_its_place_in_the_navigation():
    placed = re.findall(r": (\w+\.md)$", (ROOT / "mkdocs.yml").read_text(), re.M)
    assert sorted(placed) == sorted(path.name for path in DOCS.glob("*.md"))
