"""The wheel, installed on its own: complete, typed, and it runs."""

import json
import os
import shutil
import subprocess
import sys
import tomllib
import venv
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
VERSION = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["version"]
PIP = [sys.executable, "-m", "pip", "--disable-pip-version-check", "--quiet"]
PROBE = """
import importlib.metadata, importlib.resources, json, torchmembrane
files = importlib.resources.files("torchmembrane")
presets = [entry.name for entry in (files / "presets").iterdir() if (entry / "sensor.toml").is_file()]
print(json.dumps({
    "from": torchmembrane.__file__,
    "says": torchmembrane.__version__,
    "metadata": importlib.metadata.version("torchmembrane"),
    "typed": (files / "py.typed").is_file(),
    "presets": {name: sorted(entry.name for entry in (files / "presets" / name).iterdir()) for name in sorted(presets)},
}))
"""


def call(*command: str | Path, cwd: Path) -> str:
    """What the command prints, run where this checkout is not on the path."""
    environment = {key: value for key, value in os.environ.items() if not key.startswith("PYTHON")}
    done = subprocess.run([str(part) for part in command], cwd=cwd, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.fixture(scope="module")
def installed(tmp_path_factory):
    """Folder of a virtual environment with the wheel; everything else comes from the environment of the tests, after it."""
    folder = tmp_path_factory.mktemp("wheel")
    source = folder / "source"
    shutil.copytree(ROOT / "torchmembrane", source / "torchmembrane", ignore=shutil.ignore_patterns("__pycache__"))
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, source)
    build = ("wheel", "--no-deps", "--no-build-isolation", "--no-index", "--wheel-dir", folder, source)
    call(*PIP, *build, cwd=folder)
    (wheel,) = folder.glob("*.whl")
    venv.create(folder / "venv", symlinks=True)
    python = folder / "venv" / "bin" / "python"
    call(*PIP, "--python", python, "install", "--no-deps", "--no-index", wheel, cwd=folder)
    own = Path(call(python, "-c", "import sysconfig; print(sysconfig.get_path('purelib'))", cwd=folder).strip())
    others = [path for path in sys.path if Path(path).name in ("site-packages", "dist-packages")]
    (own / "others.pth").write_text("\n".join(others))
    return python.parent


@pytest.fixture(scope="module")
def seen(installed):
    return json.loads(call(installed / "python", "-c", PROBE, cwd=installed.parent))


def test_it_is_the_wheel_that_is_imported(installed, seen):
    assert Path(seen["from"]).is_relative_to(installed.parent)


def test_metadata_give_the_version(seen):
    assert seen["metadata"] == VERSION


def test_the_package_says_the_version_of_its_metadata(seen):
    assert seen["says"] == VERSION


def test_it_is_typed(seen):
    assert seen["typed"]


def test_presets_are_complete(seen):
    folders = sorted(path.parent for path in (ROOT / "torchmembrane" / "presets").glob("*/sensor.toml"))
    assert folders and seen["presets"] == {folder.name: sorted(file.name for file in folder.iterdir()) for folder in folders}


@pytest.mark.parametrize("arguments", [("--help",), ("simulate", "--help")])
def test_the_command_helps(installed, arguments):
    said = call(installed / "torchmembrane", *arguments, cwd=installed.parent)
    assert said.startswith(f"usage: torchmembrane {arguments[0] if arguments[1:] else ''}".rstrip())


def test_torchmembrane_edge_is_a_wheel_of_its_own(tmp_path):
    """To install where there is no clone of this repository: every module, the command, and torchmembrane's version."""
    source = tmp_path / "export"
    shutil.copytree(
        ROOT / "export" / "torchmembrane_edge", source / "torchmembrane_edge", ignore=shutil.ignore_patterns("__pycache__")
    )
    for name in ("pyproject.toml", "README.md"):
        shutil.copy(ROOT / "export" / name, source)
    call(*PIP, "wheel", "--no-deps", "--no-build-isolation", "--no-index", "--wheel-dir", tmp_path, source, cwd=tmp_path)
    (wheel,) = tmp_path.glob("*.whl")
    assert wheel.name == f"torchmembrane_edge-{VERSION}-py3-none-any.whl"
    modules = {path.name for path in (ROOT / "export" / "torchmembrane_edge").glob("*.py")}
    with zipfile.ZipFile(wheel) as file:
        names = file.namelist()
        assert {Path(name).name for name in names if name.startswith("torchmembrane_edge/")} == modules
        (points,) = (name for name in names if name.endswith("entry_points.txt"))
        assert "torchmembrane-edge = torchmembrane_edge.cli:main" in file.read(points).decode()
