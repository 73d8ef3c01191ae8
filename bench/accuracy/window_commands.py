"""From rendered photographs of windows to newtons, prestretch and modulus, by the documented commands alone.

python -m bench.accuracy.window_commands [--rims rectangle ...] [--keep DIR] [--json FILE]

The windows of `bench.accuracy.windows`: truth on an unstructured mesh, by another solver. Photographs, at rest and of each
press, are drawn from the mesh: shaded triangles, and round dots of two sizes on the sheet, with noise of 40 dB. Then:

    init mine.toml RIM --height H --overpressure 12hPa --prestretch 1.1 --distance 40 --focal 480 --rest rest.png
    reconstruct mine.toml press_*.png --out results
    init unknown.toml RIM --height H --prestretch 1.2 --distance 40 --focal 480 --rest rest.png     # wrong by 0.1
    calibrate material unknown.toml press_*.png --forces forces.csv --overpressure 12hPa --out material

RIM is --shape rectangle --size 50,36 --corner 4, --shape ellipse --size 50,36, or --outline rim.csv; forces.csv holds the true
forces, known to 3 %. Printed are, of each press, force and depth found over true, and the status; then prestretch and modulus
with their standard deviations and intervals of 95 %.
"""

import argparse
import csv
import json
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
import torch
from PIL import Image, ImageDraw
from torch import Tensor

import torchmembrane as tm
from bench.accuracy.windows import GAUGE, PITCH, STRETCH, Twin, centres, rims
from bench.data.record import write
from torchmembrane.forming.outline import encloses, outline_of
from torchmembrane.sensor.inflated import rim_lines

CAMERA = tm.Camera("pinhole", (640, 480), (480.0, 480.0), (319.5, 239.5))
DISTANCE, NOISE_LEVEL, KNOWN = 40.0, 40.0, 0.03  # mm; dB; standard deviation of the forces given, relative
WRONG_STRETCH = 1.2
SUPER = 6  # drawn so many times as large both ways
RADII = 0.27 * PITCH, 0.16 * PITCH
FRAME, PAPER, INK = 60, 200, 40  # grey of the frame around the membrane, of the membrane and of its dots
LIGHT = np.array([0.3, 0.2, 1.0]) / np.linalg.norm([0.3, 0.2, 1.0])
OPTIONS = {"rectangle": "--shape rectangle --size 50,36 --corner 4", "ellipse": "--shape ellipse --size 50,36"}


class Paint:
    """Dots on the sheet of a `Twin`: polygons whose corners are material points."""

    def __init__(self, twin: Twin) -> None:
        self.twin = twin
        i, j = (a.ravel() for a in np.meshgrid(*(np.arange(-12, 13),) * 2))
        angle = 2 * np.pi * np.arange(24) / 24
        circle = np.stack([np.cos(angle), np.sin(angle)], -1)
        radius = np.where((i + j) % 2 == 0, *RADII)
        flat = np.stack([i, j], -1)[:, None] * PITCH + radius[:, None, None] * circle
        border = twin.border[:, :2].numpy()
        whole = encloses(border, flat.reshape(-1, 2)).reshape(len(flat), -1).all(1)
        self.corners, self.weights = twin.at(flat[whole].reshape(-1, 2))
        self.shape = flat[whole].shape[:2]

    def image(self, x: Tensor, rng: np.random.Generator) -> Image.Image:
        """What the camera sees of the sheet with its vertices at `x`."""
        width, height = CAMERA.image_size
        picture = Image.new("L", (SUPER * width, SUPER * height), FRAME)
        draw = ImageDraw.Draw(picture)
        corners = x[self.twin.cells].numpy()
        normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        shade = np.abs(normals @ LIGHT) / np.linalg.norm(normals, axis=1)
        for corner, light in zip(_drawn(torch.from_numpy(corners)), shade, strict=True):
            draw.polygon([tuple(p) for p in corner], fill=int(PAPER * light))
        dots = (x[self.corners] * self.weights[..., None]).sum(1).reshape(*self.shape, 3)
        for corner in _drawn(dots):
            draw.polygon([tuple(p) for p in corner], fill=INK)
        grey = np.asarray(picture.reduce(SUPER), float)
        noisy = grey + 255 * 10 ** (-NOISE_LEVEL / 20) * rng.standard_normal(grey.shape)
        return Image.fromarray(noisy.round().clip(0, 255).astype(np.uint8))


def _drawn(points: Tensor) -> list:
    """In the large picture, whose pixel centres are at integers, too."""
    return (SUPER * (CAMERA.point_to_pixel(points) + 0.5) - 0.5).tolist()


def command(folder: Path, line: str) -> str:
    """Run `torchmembrane` in a folder; returns what it prints."""
    done = subprocess.run(
        [sys.executable, "-m", "torchmembrane", *line.split()], cwd=folder, capture_output=True, text=True, check=False
    )
    if done.returncode not in (0, 1):
        raise SystemExit(f"torchmembrane {line}\n{done.stdout}{done.stderr}")
    return done.stdout


def measured(name: str, rim: np.ndarray, folder: Path, rng: np.random.Generator) -> dict:
    """Simulate a window, run the commands, print what they give: forces and depths found over true, and the material."""
    twin = Twin(rim)
    rest = twin.blown_up()
    paint, gas = Paint(twin), float(twin.volume(rest) - twin.volume(twin.sheet))
    presses = [twin.pressed(rest, centre, gas) for centre in centres(rest)]
    paint.image(rest, rng).save(folder / "rest.png")
    rows = ["image,force,deviation"]
    for k, (x, force) in enumerate(presses):
        paint.image(x, rng).save(folder / f"press_{k}.png")
        rows.append(f"press_{k}.png,{float(force.norm()):.5f},{KNOWN * float(force.norm()):.5f}")
    (folder / "forces.csv").write_text("\n".join(rows) + "\n")
    (folder / "rim.csv").write_text(rim_lines(rim - [0.0, 0.0, DISTANCE] if np.ptp(rim[:, 2]) else rim[:, :2]))
    height = float(rest[:, 2].max()) - outline_of(rim).origin[2]
    outline = f"{OPTIONS.get(name, '--outline rim.csv')} --distance {DISTANCE:g}"
    known = f"{outline} --height {height:.3f}mm --focal 480 --centre 319.5,239.5 --rest rest.png"
    said = command(folder, f"init mine.toml {known} --overpressure {GAUGE:g}hPa --prestretch {STRETCH:g}")
    modulus = next(line for line in said.splitlines() if "modulus" in line)
    print(f"{name}: {modulus}", flush=True)
    files = " ".join(f"press_{k}.png" for k in range(len(presses)))
    command(folder, f"reconstruct mine.toml {files} --out results")
    forces, depths, statuses = [], [], []
    summary = {row["name"]: row for row in csv.DictReader((folder / "results" / "summary.csv").open())}
    for k, (x, force) in enumerate(presses):
        with np.load(folder / "results" / f"press_{k}.npz") as found:
            lowered, said_force = float(-found["displacement"][:, 2].min()), found["force"]
        depth = float((rest[:, 2] - x[:, 2]).max())
        forces.append(float(np.linalg.norm(said_force) / force.norm()))
        depths.append(lowered / depth)
        statuses.append(summary[f"press_{k}"]["status_text"])
        said = f"force {float(force.norm()):.4f} N x {forces[-1]:.3f}, depth {depth:.2f} mm x {depths[-1]:.3f}, {statuses[-1]}"
        print(f"  press {k}: {said}", flush=True)
    command(folder, f"init unknown.toml {known} --prestretch {WRONG_STRETCH:g}")
    command(folder, f"calibrate material unknown.toml {files} --forces forces.csv --overpressure {GAUGE:g}hPa --out material")
    report = json.loads((folder / "material" / "report.json").read_text())
    found = report["parameters"].items()
    told = {key: [v["value"], v["deviation"], *v["interval"]] for key, v in found}
    said = [f"{key} {value:.4g} ± {sd:.2g} ({low:.3g} to {high:.3g})" for key, (value, sd, low, high) in told.items()]
    print(f"  {', '.join(said)}", flush=True)
    return dict(rim=name, forces=forces, depths=depths, statuses=statuses, **told)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rims", nargs="+", choices=list(rims()), default=list(rims()))
    parser.add_argument("--keep", type=Path, metavar="DIR", help="keep the files")
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    rows, rng = [], np.random.default_rng(0)
    with tempfile.TemporaryDirectory() as temporary:
        for name in arguments.rims:
            folder = (arguments.keep or Path(temporary)) / name
            folder.mkdir(parents=True)
            rows.append(measured(name, rims()[name], folder, rng))
    off = {key: [abs(ratio - 1) for row in rows for ratio in row[key]] for key in ("forces", "depths")}
    median, most = ({key: float(of(errors)) for key, errors in off.items()} for of in (np.median, np.max))
    print(f"median error of forces {median['forces']:.1%}, of depths {median['depths']:.1%}")
    write(arguments.json, dict(rows=rows, median=median, most=most))


if __name__ == "__main__":
    main()
