"""Frames a second from image files to results in the steady state: one thread of one process, and worker processes.

    OMP_NUM_THREADS=1 python -m bench.speed.throughput SENSOR.toml IMAGE [--workers 2] [--frames 300] [--format parquet]
        [--device cuda] [--ray] [--json FILE]

Runs the command on copies of an image, once on N and once on 3 N of them; the rate is that of the difference, so that starting
does not count. `--ray` adds as many workers with --engine ray. Processor time, of all processes together, is given beside
the time on the clock: on a shared machine it alone says what the work costs.
"""

import os
import resource
import shutil
import subprocess
import sys
import time
from argparse import ArgumentParser, RawDescriptionHelpFormatter
from pathlib import Path
from tempfile import TemporaryDirectory

from bench.data.record import write


def timed(command: list[str]) -> tuple[float, float]:
    """Seconds on the clock, and of processors."""
    before, start = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
    subprocess.run(command, check=True, capture_output=True)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    spent = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return time.perf_counter() - start, spent


def main() -> None:
    parser = ArgumentParser(description=__doc__, formatter_class=RawDescriptionHelpFormatter)
    parser.add_argument("sensor")
    parser.add_argument("image", type=Path)
    parser.add_argument("--workers", type=int, default=len(os.sched_getaffinity(0)))
    parser.add_argument("--frames", type=int, default=300)
    parser.add_argument("--format", default="parquet")
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--ray", action="store_true")
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    with TemporaryDirectory() as name:
        folder, few, many = Path(name), arguments.frames, 3 * arguments.frames
        for count in (few, many):
            (folder / str(count)).mkdir()
            for k in range(count):
                shutil.copy(arguments.image, folder / str(count) / f"k{k:05d}{arguments.image.suffix}")
        runs = [("processes", 1), ("processes", arguments.workers)] + [("ray", arguments.workers)] * arguments.ray
        rows = []
        for engine, workers in dict.fromkeys(runs):  # with --workers 1 once: finished frames would be skipped
            times = []
            for count in (few, many):
                base = [sys.executable, "-m", "torchmembrane", "reconstruct", arguments.sensor, str(folder / str(count))]
                options = ["--format", arguments.format, "--workers", str(workers), "--device", arguments.device]
                options += ["--out", str(folder / f"{engine}{workers}_{count}")] + ["--engine", "ray"] * (engine == "ray")
                times.append(timed([*base, *options]))
            clock, spent = (b - a for a, b in zip(*times, strict=True))
            row = dict(engine=engine, workers=workers, rate=(many - few) / clock, milliseconds=1000 * spent / (many - few))
            rows.append(row | dict(cores=spent / clock, start=times[0][0] - few * clock / (many - few)))
            print(
                "{engine}, {workers} worker(s): {rate:5.1f} frames/s, {milliseconds:5.1f} ms of processor a frame, "
                "{cores:.2f} cores busy, start {start:.1f} s".format(**rows[-1]),
                flush=True,
            )
        print(f"load of the machine {os.getloadavg()[0]:.1f}")
    write(arguments.json, dict(frames=arguments.frames, rows=rows))


if __name__ == "__main__":
    main()
