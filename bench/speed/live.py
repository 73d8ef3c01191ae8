"""Latency, rate and dropped frames of `torchmembrane live`, from a rendered camera of 30 Hz.

python -m bench.speed.live [--seconds 20] [--only "17 x 17,default grid"] [--model video.onnx] [--json FILE]

The preset fingertip is pressed by a ball and dragged, 40 frames of 640 x 480 px with 35 dB noise, played back and forth from
memory at 30 Hz through what the command runs: capturing thread, mailbox, loop, one thread that computes. Printed for
each way of computing: frames captured, followed and dropped; rate; latency from the capture to the wrench, median and 95 %; its
median in the first and the last quarter of the time, which would differ if a lag built up; processor time of the whole program
for each frame that was followed; the machine's load, other programs' included. `--model` adds the exported tracking model on
17 x 17, which is written there if it does not exist yet (minutes). A second is played before each run and not counted.
"""

import argparse
import os
import tempfile
import time
import warnings
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import replace
from itertools import islice
from pathlib import Path
from threading import Event

import numpy as np
import torch

import torchmembrane as tm
from bench.data.record import write
from torchmembrane.live.background import Background
from torchmembrane.live.loop import StreamStats, follow
from torchmembrane.live.mailbox import capture
from torchmembrane.live.recording import Recording
from torchmembrane.live.sources import Timed, paced
from torchmembrane.live.streams import ModelStream, Stream, TrackedStream

RATE, FRAMES, NOISE_LEVEL = 30.0, 40, 35.0
FRICTION, RADIUS, DEPTH, DRAG = 0.5, 4.0, 2.0, 2.5  # lengths in mm


def rendered(sensor: tm.Sensor) -> list[np.ndarray]:
    """A ball presses and is dragged: grey images of 8 bits."""
    simulator = tm.simulate.Simulator(sensor, grid=(37, 37), appearance=tm.simulate.Appearance(noise=NOISE_LEVEL))
    ball, half = tm.simulate.Sphere(RADIUS).touching(simulator.membrane, (0, 0, -1)), FRAMES // 2
    offsets = [(0, 0, -DEPTH * k / half) for k in range(half)] + [(DRAG * k / half, 0, -DEPTH) for k in range(half)]
    path = [ball.moved(offset) for offset in offsets]
    states = tm.simulate.presses(simulator.membrane, simulator.elasticity, [path], friction=FRICTION, **simulator.cavity)
    return [simulator.image(state.vertices, np.random.default_rng(k)) for k, state in enumerate(states)]


def to_and_fro(images: list[np.ndarray]) -> Iterator[np.ndarray]:
    while True:
        yield from images
        yield from reversed(images[1:-1])


def measured(stream: Stream, images: list[np.ndarray], seconds: float, record: bool) -> dict:
    """One run."""
    stats, dropped, began = StreamStats(), 0, time.process_time()
    with ExitStack() as stack:
        watchers = []
        if record:
            folder = Path(stack.enter_context(tempfile.TemporaryDirectory())) / "record"
            later = stack.enter_context(Background(stack.enter_context(Recording(folder, stream.mesh)).keep))
            watchers.append(lambda seen, _: later(seen))
        played = islice(to_and_fro(images), round(seconds * RATE))
        mailbox = stack.enter_context(capture(paced(Timed(k / RATE, image) for k, image in enumerate(played))))
        follow(stream, mailbox, stats, watchers, Event())
        dropped = later.dropped if record else None
    milliseconds, times = 1000 * np.asarray(stats.latencies), np.asarray(stats.times) - stats.times[0]
    first, last = (milliseconds[(times >= a * seconds) & (times < b * seconds)] for a, b in ((0, 0.25), (0.75, 1)))
    return dict(
        captured=stats.captured,
        followed=stats.followed,
        dropped=stats.dropped,
        failed=stats.failed,
        not_recorded=dropped,
        rate=stats.rate(),
        median=float(np.median(milliseconds)),
        percent_95=float(np.percentile(milliseconds, 95)),
        first_quarter=float(np.median(first)),
        last_quarter=float(np.median(last)),
        processor=1000 * (time.process_time() - began) / stats.followed,
        load=os.getloadavg()[0],
    )


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=20.0)
    parser.add_argument("--only", type=lambda text: text.split(","))
    parser.add_argument("--model", type=Path)
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    warnings.simplefilter("ignore")
    torch.set_num_threads(1)
    sensor = tm.preset("fingertip")
    coarse = replace(sensor, membrane=sensor.surface.membrane((17, 17)))
    images = rendered(sensor)
    cases = {
        "17 x 17": (lambda: TrackedStream(tm.Reconstructor(coarse)), False),
        "17 x 17; recorded": (lambda: TrackedStream(tm.Reconstructor(coarse)), True),
        "default grid": (lambda: TrackedStream(tm.Reconstructor(sensor)), False),
    }
    if args.model:
        if not args.model.exists():
            args.model.parent.mkdir(parents=True, exist_ok=True)
            tm.export(tm.Reconstructor(coarse), args.model, tracking=True)
        cases["17 x 17; exported"] = lambda: ModelStream(args.model, coarse.fingerprint), False
        cases["17 x 17; exported; recorded"] = lambda: ModelStream(args.model, coarse.fingerprint), True
    rows = {}
    for name, (make, record) in cases.items():
        if args.only and name not in args.only:
            continue
        measured(stream := make(), images, 1.0, False)
        stream = make()
        rows[name] = row = measured(stream, images, args.seconds, record)
        left_out = f", {row['not_recorded']} not recorded" if record else ""
        print(
            "{name}: {captured} captured, {followed} followed, {dropped} dropped, {failed} failed{left_out}; {rate:.1f} Hz; "
            "latency {median:.0f} ms, 95 %: {percent_95:.0f}; first quarter {first_quarter:.0f}, last {last_quarter:.0f}; "
            "processor time {processor:.0f} ms a frame followed; load {load:.1f}".format(name=name, left_out=left_out, **row),
            flush=True,
        )
    write(args.json, dict(frames_per_second=RATE, seconds=args.seconds, cases=rows))


if __name__ == "__main__":
    main()
