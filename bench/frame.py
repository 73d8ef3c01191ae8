"""Processor time per frame, image to result, at the default settings: a reconstructor from rest, and a tracker over a stream.

python bench/frame.py [--sensor examples/sensor.toml] [--images examples/*.png] [--rounds 15]

One thread; processor time, as other programs may share the cores; the median of all rounds and, in brackets, the least.
"""

import argparse
import time

import numpy as np
import torch

import torchmembrane as tm

IMAGES = [f"examples/{name}.png" for name in ("press_on_axis", "two_contacts", "flat_plate")]


def milliseconds(frames: int, rounds: int, run) -> str:
    """Of processor time per frame: median and least of so many rounds, after one that warms up."""
    run()
    taken = []
    for _ in range(rounds):
        start = time.process_time()
        run()
        taken.append(1e3 * (time.process_time() - start) / frames)
    return f"{np.median(taken):.0f} ms ({min(taken):.0f})"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sensor", default="examples/sensor.toml")
    parser.add_argument("--images", nargs="+", default=IMAGES)
    parser.add_argument("--rounds", type=int, default=15)
    args = parser.parse_args()
    torch.set_num_threads(1)
    reconstructor = tm.Reconstructor.from_file(args.sensor)
    images = reconstructor.read(*args.images)
    m, n = reconstructor.sensor.membrane.grid
    many = images.repeat(16 // len(images) + 1, 1, 1, 1)[:16]
    tracker = tm.Tracker(reconstructor)
    tracker(images[0])
    with torch.no_grad():
        print(f"{m} x {n} vertices, {len(reconstructor.rest_pixels)} markers, {images.shape[-1]} x {images.shape[-2]} px")
        print("one image:", milliseconds(1, args.rounds, lambda: reconstructor(images[:1])))
        print("in batches of 16:", milliseconds(16, max(args.rounds // 3, 2), lambda: reconstructor(many)))
        print("tracked, from the frame before:", milliseconds(1, args.rounds, lambda: tracker(images[0])))


if __name__ == "__main__":
    main()
