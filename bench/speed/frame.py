"""Processor time per frame, image to result, at the default settings: a reconstructor from rest, and a tracker over a stream.

python -m bench.speed.frame [--sensor examples/sensor.toml] [--images examples/*.png] [--rounds 15] [--models MODEL.onnx ...]
    [--json FILE]

One thread; processor time, as other programs may share the cores; the median of all rounds and, in brackets, the least. Every
round also takes 0.45 GFLOP of products of 186 x 186 matrices, of which the medians are told as multiples: cores differ, and
minutes do. Models as `torchmembrane export` writes them are run by onnxruntime, on one image; those that track from its own
pixels. Markers alone are found in inference mode, as a frame's are.
"""

import argparse
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import onnxruntime
import torch

import torchmembrane as tm
from bench.data.record import write

IMAGES = [f"examples/{name}.png" for name in ("press_on_axis", "two_contacts", "flat_plate")]
SIZE, FLOPS = 186, 0.45e9


def unit() -> Callable[[], None]:
    """0.45 GFLOP of products."""
    a, b = torch.rand(2, SIZE, SIZE)
    product = torch.empty_like(a)

    def run() -> None:
        for _ in range(round(FLOPS / (2 * SIZE**3))):
            torch.mm(a, b, out=product)

    return run


def model(path: Path, images: torch.Tensor, pixels: torch.Tensor) -> Callable[[], object]:
    """One frame in onnxruntime."""
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads, options.log_severity_level, options.enable_mem_reuse = 1, 3, False
    session = onnxruntime.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])
    given = {"image": images[:1].numpy(), "previous_pixels": pixels[:1].numpy()}
    feed = {each.name: given[each.name] for each in session.get_inputs()}
    return lambda: session.run(None, feed)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sensor", default="examples/sensor.toml")
    parser.add_argument("--images", nargs="+", default=IMAGES)
    parser.add_argument("--rounds", type=int, default=15)
    parser.add_argument("--models", nargs="*", type=Path, default=[])
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    torch.set_num_threads(1)
    reconstructor = tm.Reconstructor.from_file(args.sensor)
    images = reconstructor.read(*args.images)
    m, n = reconstructor.sensor.membrane.grid
    many = images.repeat(16 // len(images) + 1, 1, 1, 1)[:16]
    tracker = tm.Tracker(reconstructor)
    with torch.no_grad():
        pixels = tracker(images[0]).pixels
        runs = {
            "one image": (1, lambda: reconstructor(images[:1])),
            "in batches of 16": (16, lambda: reconstructor(many)),
            "tracked, from the frame before": (1, lambda: tracker(images[0])),
            "markers alone": (1, torch.inference_mode()(lambda: reconstructor.observer(images[:1]))),
            "markers alone, followed": (1, torch.inference_mode()(lambda: reconstructor.observer(images[:1], pixels))),
        } | {f"onnxruntime, {path.name}": (1, model(path, images, pixels)) for path in args.models}
        taken = measured({"unit": (1, unit())} | runs, args.rounds)
    print(f"{m} x {n} vertices, {len(reconstructor.rest_pixels)} markers, {images.shape[-1]} x {images.shape[-2]} px")
    rows = {name: dict(median=float(np.median(times)), least=min(times)) for name, times in taken.items()}
    print("0.45 GFLOP: {median:.2f} ms ({least:.2f})".format(**rows["unit"]))
    for name in runs:
        rows[name]["units"] = rows[name]["median"] / rows["unit"]["median"]
        print("{name}: {median:.1f} ms ({least:.1f}), {units:.1f} times that".format(name=name, **rows[name]))
    write(args.json, dict(grid=[m, n], markers=len(reconstructor.rest_pixels), rows=rows))


def measured(runs: dict[str, tuple[int, Callable[[], object]]], rounds: int) -> dict[str, list[float]]:
    """Milliseconds of processor time a frame of every round, after one that warms up."""
    taken: dict[str, list[float]] = {name: [] for name in runs}
    for round_ in range(-1, rounds):
        for name, (frames, run) in runs.items():
            start = time.process_time()
            run()
            if round_ >= 0:
                taken[name].append(1e3 * (time.process_time() - start) / frames)
    return taken


if __name__ == "__main__":
    main()
