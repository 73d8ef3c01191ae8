"""What wrong numbers in `init` do to the tutorial's result: steps 3 and 5 of docs/own_sensor.md with other numbers.

python -m bench.robustness.cli_errors

The photographs are those of the page's step 2. Each row: what was said to `init`, and force and deepest displacement that come
out of the press; the truth is first. Rows that end in "rest" have their dots listed, as heights over the rim, and are fitted to
the rest photograph by `calibrate rest` before the weight.
"""

import argparse
import contextlib
import csv
import io
import os
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from torchmembrane.cli.main import main as torchmembrane

DOME = "--shape dome --distance 15 --image-size 640,480 --lens fisheye --view 120 --radius 12"
PRESSES = (
    "--indenter sphere --radius 4 --depth 2 --noise 40 --out photos --name weight",
    "--indenter sphere --radius 3 --depth 3 --direction 0.5,0,0.87 --friction 0.3 --noise 40 --out photos --name press",
)
RIM = 206.17
ROWS = (
    "--rim auto",
    *(f"--rim 319.5,239.5,{RIM + off:.2f}" for off in (2, -2, 4, -4, -10, 10)),
    f"--rim 322.5,239.5,{RIM}",
    "--rim auto --view 108",
    "--rim auto --radius 12.6",
    *(f"--rim 319.5,239.5,{RIM + off:.2f} --dots dots.csv" for off in (-10, 10)),
    f"--rim 329.5,239.5,{RIM} --dots dots.csv",
)


def called(words: str) -> str:
    """What the command prints; an error where it fails."""
    with contextlib.redirect_stdout(io.StringIO()) as said, contextlib.redirect_stderr(said):
        code = torchmembrane(words.split())
    if code:
        raise RuntimeError(said.getvalue().strip().splitlines()[-1])
    return said.getvalue()


def outcome(row: str) -> str:
    """Force and depth of the press, by a sensor that was begun with these numbers."""
    try:
        called(f"init mine.toml --force --shape dome --radius 12 --rest photos/sensor_rest.png --lens fisheye --view 120 {row}")
        if "--dots" in row:
            called("calibrate rest mine.toml photos/sensor_rest.png --out rest")
        first = "rest/sensor.toml" if "--dots" in row else "mine.toml"
        called(f"calibrate material {first} photos/weight.png --weight 126.5g --out material")
        called(f"reconstruct material/sensor.toml photos/press.png --out results{abs(hash(row))}")
    except RuntimeError as error:
        return str(error)
    (found,) = csv.DictReader(Path(f"results{abs(hash(row))}/summary.csv").open())
    return f"{float(found['force']):.2f} N, {-float(found['deepest']):.2f} mm, residual {float(found['residual_px']):.3f} px"


def main() -> None:
    argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter).parse_args()
    with TemporaryDirectory() as folder, contextlib.chdir(folder):
        called(f"init real.toml {DOME} --prestretch 1.35 --shear-modulus 0.25 --thickness 0.5")
        for press in PRESSES:
            called(f"simulate real.toml {press}")
        dots = np.loadtxt("real_dots.csv", delimiter=",", skiprows=1, usecols=(0, 1, 2))
        np.savetxt("dots.csv", dots - [0, 0, 15], "%.5f", ",", header="x,y,h", comments="")
        truth = np.load("photos/press_truth.npz")
        print(f"truth: {np.linalg.norm(truth['force']):.3f} N, pressed 3 mm deep", flush=True)
        for row in ROWS:
            print(f"{row}{', rest' * ('--dots' in row)}: {outcome(row)}", flush=True)


if __name__ == "__main__":
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    main()
