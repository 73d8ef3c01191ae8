"""Jobs killed at random moments: what is lost, and whether the end is as if nothing had happened.

    python -m bench.robustness.crash_recovery [--sensor SENSOR.toml --images FOLDER] [--kills 10]
        [--format npz|parquet] [--engine ray] [--json FILE]

By default 500 images, the example's three presses again and again, on 17 x 17 vertices.

Starts the command again and again, each time ended by SIGTERM or SIGKILL at a random moment, and last to the end. Prints for
each time the frames kept, the seconds since the first frames, and the seconds of work lost: from the last frame that was kept
to the kill, by the modification times of the files. Then compares the results with those of a job that was left alone. Exit
code 1 if names differ, a row of summary.csv is missing, or more than `MOST_LOST` seconds were lost.
"""

import random
import re
import shutil
import signal
import subprocess
import sys
import time
from argparse import ArgumentParser, RawDescriptionHelpFormatter
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

import torchmembrane as tm
from bench.data.record import write
from torchmembrane.errors import MembraneError

EXAMPLES = Path(__file__).parents[2] / "examples"
FRAMES = 500
MOST_LOST = 10.0


def last_written(out: Path) -> float | None:
    """When the newest result was written."""
    files = [*out.glob("[!.]*.npz"), *out.glob("frames/part-*.parquet")]
    times = [path.stat().st_mtime for path in files if path.name != "mesh.npz"]
    return max(times, default=None)


def kept(out: Path) -> int:
    """Frames that can be read."""
    try:
        return len(tm.read_results(out))
    except MembraneError:
        return 0


def has_begun(log: str) -> bool:
    """Whether the progress bar has moved."""
    counts = re.findall(r"(\d+)/\d+ \[", log)
    return len(set(counts)) > 1


def example(folder: Path) -> tuple[str, str]:
    """A sensor file and a folder of images."""
    (folder / "images").mkdir()
    for name in ("rest_grid.npz", "dots.csv", "rest.png"):
        shutil.copy(EXAMPLES / name, folder)
    text = (EXAMPLES / "sensor.toml").read_text()
    (folder / "sensor.toml").write_text(text.replace("[membrane]", "[membrane]\ngrid = [17, 17]"))
    presses = sorted(path for path in EXAMPLES.glob("*.png") if path.name != "rest.png")
    for k in range(FRAMES):
        shutil.copy(presses[k % len(presses)], folder / "images" / f"k{k:04d}.png")
    return str(folder / "sensor.toml"), str(folder / "images")


def killed(command: list[str], out: Path, after: float, end: signal.Signals) -> dict:
    """One job, ended so many seconds after its computation has begun: frames kept before and after, the seconds lost."""
    before, log = kept(out), out.with_suffix(".log")
    with open(log, "w") as said, subprocess.Popen(command, stdout=said, stderr=said) as process:
        while not has_begun(log.read_text()) and process.poll() is None:
            time.sleep(0.02)
        begun = time.time()
        time.sleep(after)
        alive = process.poll() is None
        process.send_signal(end)
        ended = time.time()
        process.wait()
    written = max(last_written(out) or begun, begun)
    lost = max(ended - written, 0.0) if alive else 0.0
    said = "" if alive else "  (had ended)"
    row = dict(signal=end.name, after=after, before=before, kept=kept(out), lost=lost)
    done = "{before:4d} -> {kept:4d} frames, at most {lost:4.1f} s of work lost".format(**row)
    print(f"{end.name:8} after {after:5.1f} s: {done}{said}", flush=True)
    return row


def difference(one: Path, other: Path) -> dict:
    """How far the results of two folders are apart: frames equal bit for bit, and the largest difference of some arrays."""
    a, b = tm.read_results(one), tm.read_results(other)
    if a.names != b.names:
        return dict(frames=(len(a), len(b)))
    pairs = list(zip(a, b, strict=True))
    keys = "vertices", "force", "pressure", "residual"
    worst = {key: max(float(np.nanmax(np.abs(x[key] - y[key]), initial=0)) for x, y in pairs) for key in keys}
    same = sum(all(np.array_equal(x[key], y[key], equal_nan=True) for key in x) for x, y in pairs)
    return dict(frames=(len(a), len(b)), same=same, largest=worst)


def main() -> int:
    parser = ArgumentParser(description=__doc__, formatter_class=RawDescriptionHelpFormatter)
    parser.add_argument("--sensor")
    parser.add_argument("--images")
    parser.add_argument("--kills", type=int, default=10)
    parser.add_argument("--latest", type=float, default=12.0, help="seconds of computation after which a job is killed at most")
    parser.add_argument("--json", type=Path)
    arguments, options = parser.parse_known_args()
    dice = random.Random(0)
    with TemporaryDirectory() as folder:
        whole, broken = Path(folder) / "whole", Path(folder) / "broken"
        given = (arguments.sensor, arguments.images) if arguments.images else example(Path(folder))
        base = [sys.executable, "-m", "torchmembrane", "reconstruct", *given, *options, "--out"]
        kills = []
        for number in range(arguments.kills):
            end = (signal.SIGTERM, signal.SIGKILL)[number % 2]
            kills.append(killed([*base, str(broken)], broken, dice.uniform(0, arguments.latest), end))
        for out in (broken, whole):
            done = subprocess.run([*base, str(out)], capture_output=True, text=True)
            print(done.stdout.strip().rpartition(";")[0], flush=True)
        summary = (broken / "summary.csv").read_text().count("\n") - 1
        end = difference(broken, whole)
        print(f"rows of summary.csv: {summary}; {end}")
        write(arguments.json, dict(kills=kills, rows=summary, end=end))
        lost = max(kill["lost"] for kill in kills)
        return int("same" not in end or summary != kept(whole) or lost > MOST_LOST)


if __name__ == "__main__":
    raise SystemExit(main())
