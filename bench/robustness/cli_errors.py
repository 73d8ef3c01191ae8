"""What wrong numbers in `init` do to the tutorial's result: steps 3 and 5 of docs/own_sensor.md with other numbers.

python -m bench.robustness.cli_errors [--json FILE]

The photographs are those of the page's step 2. Printed for each wrong number, after the truth: force and deepest
displacement of the press. Where the dots are listed, as heights over the rim, they are fitted to the rest photograph by
`calibrate rest` before the weight.
"""

import argparse
import contextlib
import csv
import io
import os
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from bench.data.record import write
from torchmembrane.cli.main import main as torchmembrane

DOME = "--shape dome --distance 15 --image-size 640,480 --lens fisheye --view 120 --radius 12"
PRESSES = (
    "--indenter sphere --radius 4 --depth 2 --noise 40 --out photos --name weight",
    "--indenter sphere --radius 3 --depth 3 --direction 0.5,0,0.87 --friction 0.3 --noise 40 --out photos --name press",
)
RIM, OFF = 206.17, (2, -2, 4, -4, 10, -10)
ROWS = {
    "as above": "--rim auto",
    **{f"rim {abs(off)} px too {'large' if off > 0 else 'small'}": f"--rim 319.5,239.5,{RIM + off:.2f}" for off in OFF},
    "the rim's centre 3 px to one side": f"--rim 322.5,239.5,{RIM}",
    "field of view 108 degrees in place of 120, the rim as it is seen": "--rim auto --view 108",
    "radius 12.6 mm in place of 12 (5 %)": "--rim auto --radius 12.6",
    **{
        f"rim 10 px too {size}, dots listed, then `calibrate rest`": f"--rim 319.5,239.5,{RIM + off:.2f} --dots dots.csv"
        for size, off in (("small", -10), ("large", 10))
    },
    "the rim's centre 10 px to one side, dots listed, then `calibrate rest`": f"--rim 329.5,239.5,{RIM} --dots dots.csv",
}


def called(words: str) -> str:
    """What the command prints; an error where it fails."""
    with contextlib.redirect_stdout(io.StringIO()) as said, contextlib.redirect_stderr(said):
        code = torchmembrane(words.split())
    if code:
        raise RuntimeError(said.getvalue().strip().splitlines()[-1])
    return said.getvalue()


def outcome(options: str, out: Path) -> dict[str, float]:
    """Force and depth of the press, by a sensor that was begun with these numbers; `out`: a new folder."""
    called(f"init mine.toml --force --shape dome --radius 12 --rest photos/sensor_rest.png --lens fisheye --view 120 {options}")
    if "--dots" in options:
        called("calibrate rest mine.toml photos/sensor_rest.png --out rest --force")
    first = "rest/sensor.toml" if "--dots" in options else "mine.toml"
    called(f"calibrate material {first} photos/weight.png --weight 126.5g --out material --force")
    called(f"reconstruct material/sensor.toml photos/press.png --out {out}")
    (found,) = csv.DictReader((out / "summary.csv").open())
    return dict(force=float(found["force"]), deepest=-float(found["deepest"]), residual=float(found["residual_px"]))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", type=Path)
    args, rows = parser.parse_args(), []
    with TemporaryDirectory() as folder, contextlib.chdir(folder):
        called(f"init real.toml {DOME} --prestretch 1.35 --shear-modulus 0.25 --thickness 0.5")
        for press in PRESSES:
            called(f"simulate real.toml {press}")
        dots = np.loadtxt("real_dots.csv", delimiter=",", skiprows=1, usecols=(0, 1, 2))
        np.savetxt("dots.csv", dots - [0, 0, 15], "%.5f", ",", header="x,y,h", comments="")
        force = float(np.linalg.norm(np.load("photos/press_truth.npz")["force"]))
        print(f"truth: {force:.3f} N, pressed 3 mm deep", flush=True)
        for number, (wrong, options) in enumerate(ROWS.items()):
            rows.append(dict(wrong=wrong, **outcome(options, Path(f"results{number}"))))
            print("{wrong}: {force:.2f} N, {deepest:.2f} mm, residual {residual:.3f} px".format(**rows[-1]), flush=True)
    write(args.json, dict(force=force, deepest=3.0, rows=rows))


if __name__ == "__main__":
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    main()
