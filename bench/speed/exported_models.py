"""What exported models cost: size, time of the export, time of a frame in onnxruntime; example sensor, two grids.

python -m bench.speed.exported_models [--sensor examples/sensor.toml] [--out out/measure/models] [--rounds 15] [--json FILE]

Force balance, the same tracking, and minimum energy, on the default grid and on 17 x 17 vertices. An export is the command
`torchmembrane export` in a process of its own. All times are processor times of one thread; those of a frame are taken in turn,
the median of all rounds and the least, of one image that is solved once. Tracking models start from its own pixels.
"""

import argparse
import os
import resource
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

import torchmembrane as tm
from bench.data.record import write
from bench.speed.frame import IMAGES, measured, model

KINDS = {
    "force balance": [],
    "the same, tracking": ["--tracking"],
    "minimum energy": ["--estimator", "minimum-energy"],
}


def export_seconds(sensor: Path, path: Path, options: list[str]) -> float:
    """Processor time of the command that writes a model."""
    before = processor_seconds()
    command = [sys.executable, "-m", "torchmembrane", "export", str(sensor), "--out", str(path), "--force", *options]
    subprocess.run(command, check=True, env=os.environ | {"OMP_NUM_THREADS": "1"})
    return processor_seconds() - before


def processor_seconds() -> float:
    """Of all processes that this one has waited for."""
    usage = resource.getrusage(resource.RUSAGE_CHILDREN)
    return usage.ru_utime + usage.ru_stime


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sensor", default="examples/sensor.toml")
    parser.add_argument("--out", type=Path, default=Path("out/measure/models"))
    parser.add_argument("--rounds", type=int, default=15)
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    torch.set_num_threads(1)
    args.out.mkdir(parents=True, exist_ok=True)
    sensor, rows, runs = tm.Sensor.from_file(args.sensor), [], {}
    for grid in (sensor.membrane.grid, (17, 17)):
        reconstructor = tm.Reconstructor(replace(sensor, membrane=sensor.surface.membrane(grid)))
        file = args.out / f"{grid[0]}" / "sensor.toml"
        file.parent.mkdir(exist_ok=True)
        reconstructor.sensor.to_file(file)
        images = reconstructor.read(*IMAGES)
        with torch.no_grad():
            pixels = reconstructor(images).pixels
        for kind, options in KINDS.items():
            path = file.parent / f"{kind.replace(', ', '_').replace(' ', '_')}.onnx"
            seconds = export_seconds(file, path, options)
            rows.append(dict(kind=kind, grid=grid[0], megabytes=path.stat().st_size / 1e6, export_seconds=seconds))
            runs[path.as_posix()] = (1, model(path, images, pixels))
            print(
                "{kind}, {grid} x {grid}: {megabytes:.1f} MB, exported in {export_seconds:.0f} s".format(**rows[-1]), flush=True
            )
    for row, (path, times) in zip(rows, measured(runs, args.rounds).items(), strict=True):
        row |= dict(median=float(np.median(times)), least=min(times))
        print(f"{path}: {row['median']:.1f} ms ({row['least']:.1f})")
    write(args.json, dict(sensor=args.sensor, rows=rows))


if __name__ == "__main__":
    main()
