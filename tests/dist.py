"""Built distributions work in environments that have nothing else.

python tests/dist.py OUT MODEL.onnx

Built in OUT, from what is committed: torchmembrane, torchmembrane-edge and the plugin for LeRobot. From the wheel and from the
source distribution of torchmembrane the quick start is run, an image of `examples/` reconstructed; from those of the edge
package the model. The plugin runs in the environment of `make test-lerobot`.
"""

import csv
import os
import shutil
import subprocess
import sys
import tempfile
import venv
from functools import partial
from pathlib import Path

ROOT = Path(__file__).parents[1]
PLUGIN = "lerobot_camera_torchmembrane"
PROJECTS = {"torchmembrane": ".", "torchmembrane_edge": "export", PLUGIN: f"integrations/{PLUGIN}"}
IMAGE = "press_on_axis.png"


def call(*command: str | Path, cwd: Path) -> str:
    """What a command prints, run where this checkout is not on the path."""
    environment = {key: value for key, value in os.environ.items() if not key.startswith("PYTHON")}
    done = subprocess.run([str(part) for part in command], cwd=cwd, env=environment, capture_output=True, text=True)
    if done.returncode:
        raise SystemExit(f"{' '.join(map(str, command))}\n{done.stdout}{done.stderr}")
    return done.stdout


def built(out: Path) -> dict[str, list[Path]]:
    """Wheel and source distribution of each project, built from copies of what is in the repository."""
    shutil.rmtree(out, ignore_errors=True)
    with tempfile.TemporaryDirectory() as folder:
        archive = subprocess.run(["git", "archive", "HEAD"], cwd=ROOT, check=True, capture_output=True).stdout
        subprocess.run(["tar", "x", "-C", folder], input=archive, check=True)
        for project in PROJECTS.values():
            call(sys.executable, "-m", "build", "--no-isolation", "--outdir", out, Path(folder) / project, cwd=out.parent)
    found = {name: sorted(out.glob(f"{name}-*")) for name in PROJECTS}
    assert all(sorted(path.suffix for path in files) == [".gz", ".whl"] for files in found.values()), found
    return found


def environment(folder: Path, *packages: str | Path) -> Path:
    """The `bin` of a new environment with these packages."""
    venv.create(folder, with_pip=True)
    pip = [folder / "bin/python", "-m", "pip", "install", "--quiet", "--constraint", ROOT / "constraints.txt"]
    call(*pip, *packages, cwd=folder)
    return folder / "bin"


def try_torchmembrane(package: Path, folder: Path) -> None:
    """The quick start, in a folder that holds the examples alone."""
    commands = environment(folder / "venv", "torch", package)
    shutil.copytree(ROOT / "examples", folder / "examples")
    call(commands / "torchmembrane", "check", "examples/sensor.toml", "--out", "sensor.png", cwd=folder)
    call(commands / "torchmembrane", "reconstruct", "examples/sensor.toml", f"examples/{IMAGE}", "--out", "demo", cwd=folder)
    (row,) = csv.DictReader((folder / "demo/summary.csv").read_text().splitlines())
    assert row["status"] == "0", row
    call(
        commands / "torchmembrane",
        "simulate",
        "preset:fingertip",
        *"--indenter sphere --radius 4 --depth 1".split(),
        "--out",
        "press",
        cwd=folder,
    )


def try_edge(model: Path, package: Path, folder: Path) -> None:
    """The exported model, in an environment that has no torch."""
    commands = environment(folder / "venv", f"torchmembrane-edge[images] @ {package.as_uri()}")
    call(commands / "torchmembrane-edge", model, ROOT / "examples" / IMAGE, "--out", "results", cwd=folder)
    assert list((folder / "results").glob("*.npz"))
    assert (
        call(commands / "python", "-c", "import importlib.util as u; print(u.find_spec('torch'))", cwd=folder).strip() == "None"
    )


def main() -> None:
    out, model = Path(sys.argv[1]).resolve(), Path(sys.argv[2]).resolve()
    packages = built(out)
    tries = {"torchmembrane": try_torchmembrane, "torchmembrane_edge": partial(try_edge, model)}
    for name, use in tries.items():
        for package in packages[name]:
            with tempfile.TemporaryDirectory() as folder:
                use(package, Path(folder))
            print(f"{package.name}: installed in an empty environment, and run")
    for package in packages[PLUGIN]:
        print(f"{package.name}: built; make test-lerobot runs it")


if __name__ == "__main__":
    main()
