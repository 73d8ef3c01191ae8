"""Processor time of loading an exported model, and of a frame of it, with onnxruntime's reuse of memory and without.

python -m bench.speed.loading [MODEL.onnx] [--rounds 60] [--loads 3] [--json FILE]

Without a MODEL.onnx, the example sensor is exported. One thread; processor time, as other programs may share the cores. The
edge package loads models without the reuse. Times of loading are medians over the loads. The frame is noise, and a tracking
model gets no previous frame. Both sessions run it in turn; the ratio is the median over the runs.
"""

import argparse
import tempfile
import time
from pathlib import Path

import numpy as np
import onnxruntime

import torchmembrane as tm
from bench.data.record import write

TYPES = {"tensor(float)": np.float32, "tensor(uint8)": np.uint8}


def session_of(path: Path, reuse: bool) -> tuple[onnxruntime.InferenceSession, float]:
    """Return a session of the model, and the seconds that loading it takes."""
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads, options.log_severity_level, options.enable_mem_reuse = 1, 3, reuse
    start = time.process_time()
    session = onnxruntime.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])
    return session, time.process_time() - start


def frame_of(session: onnxruntime.InferenceSession) -> dict[str, np.ndarray]:
    """Return inputs of one frame: noise as images, NaN as results of the frame before."""
    rng, feed = np.random.default_rng(0), {}
    for given in session.get_inputs():
        noise = rng.random([1, *given.shape[1:]])
        feed[given.name] = (noise if given.name.startswith("image") else np.nan * noise).astype(TYPES[given.type])
    return feed


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("model", type=Path, nargs="?")
    parser.add_argument("--rounds", type=int, default=60)
    parser.add_argument("--loads", type=int, default=3)
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        model = args.model or Path(folder) / "model.onnx"
        if not args.model:
            tm.export(tm.Reconstructor.from_file("examples/sensor.toml"), model)
        found = measure(model, args.loads, args.rounds)
    print(f"{args.model or 'the example sensor'}: {found['megabytes']:.1f} MB, onnxruntime {found['onnxruntime']}")
    print(f"loading: {found['load_reuse']:.1f} s with reuse of memory, {found['load']:.1f} s without")
    print(f"a frame: {1e3 * found['frame']:.0f} ms with, without {found['ratio']:.2f} times as long")
    write(args.json, found)


def measure(model: Path, times_loaded: int, rounds: int) -> dict:
    """Return the model's size, and seconds of processor time with reuse and without."""
    loads = [[session_of(model, reuse) for reuse in (True, False)] for _ in range(times_loaded)]
    sessions, feed, times = [session for session, _ in loads[-1]], frame_of(loads[-1][0][0]), []
    for _ in range(rounds):
        both = []
        for session in sessions:
            start = time.process_time()
            session.run(None, feed)
            both.append(time.process_time() - start)
        times.append(both)
    reuse, without = np.median([[seconds for _, seconds in both] for both in loads], 0)
    first, second = np.array(times[1:]).T
    return dict(
        megabytes=model.stat().st_size / 1e6,
        onnxruntime=onnxruntime.__version__,
        load_reuse=float(reuse),
        load=float(without),
        frame=float(np.median(first)),
        ratio=float(np.median(second / first)),
    )


if __name__ == "__main__":
    main()
