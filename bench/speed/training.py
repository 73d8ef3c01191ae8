"""What a training step costs: forward with gradients and backward, over a forward without gradients.

python -m bench.speed.training [--sensor examples/sensor.toml] [--grid 17] [--batch 16] [--turns 9] [--json FILE]

Processor time on one thread, the two taken in turn as other programs may share the cores; the ratio is the turns' median.
From images the gradient is of the pixels, from markers located elsewhere that of their places.
"""

import argparse
import statistics
import time
import warnings
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import torch
from torch import Tensor

import torchmembrane as tm
from bench.data.record import write


def seconds(function: Callable[[Tensor], tm.Reconstruction], given: Tensor, train: bool) -> float:
    """Processor time of a forward, `train`: of a training step."""
    start = time.process_time()
    if train:
        result = function(given.detach().clone().requires_grad_())
        (result.displacement.square().sum() + result.force.square().sum()).backward()
    else:
        with torch.no_grad():
            function(given)
    return time.process_time() - start


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sensor", default="examples/sensor.toml")
    parser.add_argument("--grid", type=int, default=17)
    parser.add_argument("--batch", type=int, default=16)
    parser.add_argument("--turns", type=int, default=9)
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    warnings.simplefilter("ignore")
    torch.set_num_threads(1)
    sensor = tm.Sensor.from_file(args.sensor)
    reconstructor = tm.Reconstructor(replace(sensor, membrane=sensor.surface.membrane((args.grid, args.grid))))
    presses = sorted(Path(args.sensor).parent.glob("*.png"))
    images = reconstructor.read(*(path for path in presses if path.stem in ("two_contacts", "press_on_axis", "flat_plate")))
    images = images[torch.arange(args.batch) % len(images)]
    with torch.no_grad():
        pixels = reconstructor(images).pixels
    rows = []
    for name, function, given in (("images", reconstructor, images), ("markers", reconstructor.from_pixels, pixels)):
        turns = [(seconds(function, given, False), seconds(function, given, True)) for _ in range(args.turns + 1)][1:]
        forward, step = (statistics.median(times) for times in zip(*turns, strict=True))
        ratio = statistics.median(b / a for a, b in turns)
        rows.append(dict(of=name, batch=args.batch, grid=args.grid, forward=forward, step=step, ratio=ratio))
        print(f"{name}: forward {forward:.2f} s, training step {step:.2f} s of a batch of {args.batch}, {ratio:.2f} forwards")
    write(args.json, dict(sensor=args.sensor, rows=rows))


if __name__ == "__main__":
    main()
