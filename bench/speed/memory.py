"""What a batch takes of memory, beside what `--batch auto` takes it for.

python -m bench.speed.memory [--kind dots|texture] [--lines 17 33] [--widths 640 1920] [--batches 1 4 16] [--json FILE]

The dome of scaling.py, pressed; each batch in a process of its own with one thread, its peak over what the process
held before.
"""

import argparse
import ctypes
import warnings
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from multiprocessing import get_context
from pathlib import Path

import numpy as np
import torch

import torchmembrane as tm
from bench.data.record import write
from bench.robustness.fuzz import clear_peak, peak
from bench.speed.scaling import NOISE_LEVEL, dome
from torchmembrane.files.images import to_grey
from torchmembrane.jobs.workers import frame_bytes
from torchmembrane.sensor.parts import Markers
from torchmembrane.simulate.appearance import noisy
from torchmembrane.simulate.dataset import stroke_to
from torchmembrane.simulate.indenters import Sphere
from torchmembrane.simulate.pattern import Speckle
from torchmembrane.simulate.render import Renderer
from torchmembrane.simulate.simulator import Simulator

DOTS = 150


def peak_of(kind: str, lines: int, width: int, batch: int, at_rest: np.ndarray, pressed: np.ndarray) -> int:
    """Bytes of a batch, in this process."""
    torch.set_num_threads(1)
    warnings.simplefilter("ignore")
    bare = dome(lines, DOTS, width)
    markers = replace(bare.markers, rest_image=at_rest) if kind == "dots" else Markers("texture", rest_image=at_rest)
    reconstructor = tm.Reconstructor(replace(bare, markers=markers))
    images = torch.from_numpy(pressed).expand(batch, 1, -1, -1).contiguous()
    ctypes.CDLL(None).malloc_trim(0)
    clear_peak()
    before = peak()
    with torch.no_grad():
        reconstructor(images)
    return peak() - before


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--kind", choices=["dots", "texture"], default="dots")
    parser.add_argument("--lines", type=int, nargs="+", default=[17, 33])
    parser.add_argument("--widths", type=int, nargs="+", default=[640, 1920])
    parser.add_argument("--batches", type=int, nargs="+", default=[1, 4, 16])
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    torch.set_num_threads(1)
    base = Simulator(dome(33, DOTS, 640))
    stroke = stroke_to(base, Sphere(6.0), base.membrane.rest[len(base.membrane.rest) // 2], np.array([-0.2, 0.1, -1.0]), 3.0)
    pressed, rows = list(base.presses(stroke, ["push"]))[-1].vertices, []
    for width in args.widths:
        pattern = Speckle(0.02 * base.membrane.size, 0) if args.kind == "texture" else None
        renderer = Renderer(dome(33, DOTS, width), base.grid, pattern)
        pair = [
            to_grey((255 * noisy(renderer(x), NOISE_LEVEL, np.random.default_rng(seed))).round().byte().numpy())
            for seed, x in enumerate((base.membrane.rest, pressed))
        ]
        for lines in args.lines:
            for batch in args.batches:
                with ProcessPoolExecutor(1, get_context("spawn")) as pool:
                    found = pool.submit(peak_of, args.kind, lines, width, batch, *pair).result()
                size = pair[0].shape[::-1]
                assumed = batch * frame_bytes(size, lines**2)
                rows.append(dict(kind=args.kind, lines=lines, size=size, batch=batch, bytes=found, assumed=assumed))
                said = f"{found / batch / 2**20:5.0f} a frame, taken for {assumed / 2**20:6.0f}"
                print(
                    f"{lines} x {lines}, {size[0]} x {size[1]}, batch {batch:2d}: {found / 2**20:6.0f} MB, {said}", flush=True
                )
    write(args.json, dict(rows=rows))


if __name__ == "__main__":
    main()
