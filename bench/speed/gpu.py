"""What a frame costs on a GPU, markers and solve apart, against the batch: time, kernels, memory; graphs of kernels.

python -m bench.speed.gpu [--device cuda] [--sensor FILE] [--images FILES] [--batches 1 4 16 64 256 1024] [--graph]
    [--compiled] [--json FILE]

Wall time, the device waited for, the median of `--repeats` calls, over the batch. Kernels are those of one call (on the CPU,
for a try without a GPU, the operators). --graph: images to results recorded once as a CUDA graph and replayed, in which all
frames take all steps; --compiled: `torch.compile` of the same, minutes to compile. The first batch that does not fit ends the
table.
"""

import argparse
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch
from torch.autograd import DeviceType
from torch.profiler import ProfilerActivity, profile

import torchmembrane as tm
from bench.data.record import write

IMAGES = [f"examples/{name}.png" for name in ("press_on_axis", "two_contacts", "flat_plate")]
WARM_UP = 3


def waited(device: torch.device) -> None:
    if device.type == "cuda":
        torch.cuda.synchronize(device)


def milliseconds(run: Callable[[], object], device: torch.device, repeats: int) -> float:
    """Of wall time for one call, after some that warm up: the median."""
    for _ in range(WARM_UP):
        run()
    taken = []
    for _ in range(repeats):
        waited(device)
        start = time.perf_counter()
        run()
        waited(device)
        taken.append(1e3 * (time.perf_counter() - start))
    return float(np.median(taken))


def kernels(run: Callable[[], object], device: torch.device) -> int:
    """That one call launches; on the CPU operators that no other calls."""
    kind = ProfilerActivity.CUDA if device.type == "cuda" else ProfilerActivity.CPU
    with profile(activities=[kind]) as profiled:
        run()
        waited(device)
    if device.type == "cuda":
        return sum(event.device_type == DeviceType.CUDA for event in profiled.events())
    return sum(event.name.startswith("aten::") and event.cpu_parent is None for event in profiled.events())


def recorded(run: Callable[[], object], device: torch.device) -> Callable[[], object]:
    """The call as a CUDA graph, replayed."""
    aside = torch.cuda.Stream(device)
    aside.wait_stream(torch.cuda.current_stream(device))
    with torch.cuda.stream(aside):
        for _ in range(WARM_UP):
            run()
    torch.cuda.current_stream(device).wait_stream(aside)
    graph = torch.cuda.CUDAGraph()
    with torch.cuda.graph(graph):
        run()
    return graph.replay


def measured(reconstructor: tm.Reconstructor, images: torch.Tensor, repeats: int, graph: bool, compiled: bool) -> dict:
    """One row."""
    device, batch = images.device, len(images)
    if device.type == "cuda":
        torch.cuda.reset_peak_memory_stats(device)
    flow = reconstructor.observer(images)
    pixels = reconstructor.rest_pixels + flow.displacement
    parts = dict(
        markers=lambda: reconstructor.observer(images),
        solve=lambda: reconstructor.from_pixels(pixels, flow.confidence),
        whole=lambda: reconstructor(images),
    )
    row = {name: milliseconds(run, device, repeats) / batch for name, run in parts.items()}
    row |= {f"{name}_kernels": kernels(run, device) for name, run in parts.items()}
    if device.type == "cuda":
        row["megabytes"] = torch.cuda.max_memory_allocated(device) / 2**20
    if graph:
        row["graph"] = milliseconds(recorded(parts["whole"], device), device, repeats) / batch
    if compiled:
        one = torch.compile(reconstructor)
        row["compiled"] = milliseconds(lambda: one(images), device, repeats) / batch
    return dict(batch=batch, **row)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--device", default="cuda", type=torch.device)
    parser.add_argument("--sensor", default="examples/sensor.toml")
    parser.add_argument("--images", nargs="+", default=IMAGES)
    parser.add_argument("--batches", type=int, nargs="+", default=[1, 4, 16, 64, 256, 1024])
    parser.add_argument("--repeats", type=int, default=7)
    parser.add_argument("--graph", action="store_true")
    parser.add_argument("--compiled", action="store_true")
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    if args.device.type == "cuda" and not torch.cuda.is_available():
        raise SystemExit("--device cuda: torch finds no GPU here; expected one, or --device cpu for a try")
    reconstructor = tm.Reconstructor.from_file(args.sensor)
    few = reconstructor.read(*args.images)
    reconstructor.to(args.device)
    rows: list[dict] = []
    for batch in args.batches:
        images = few.repeat(batch // len(few) + 1, 1, 1, 1)[:batch].to(args.device)
        try:
            with torch.no_grad():
                rows.append(measured(reconstructor, images, args.repeats, args.graph, args.compiled))
        except torch.cuda.OutOfMemoryError:
            print(f"batch {batch}: does not fit")
            break
        print(", ".join(f"{name} {value:.4g}" for name, value in rows[-1].items()), flush=True)
    write(args.json, dict(rows=rows))


if __name__ == "__main__":
    main()
