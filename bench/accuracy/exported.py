"""Exported models against torch on cases, and their speed in onnxruntime with one thread.

python -m bench.accuracy.exported CASES [--estimator force-balance] [--tracking] [--only SENSOR ...] [--threads 1] [--json FILE]

CASES as for accuracy.py. For each sensor the model is exported (seconds, MB, nodes), loaded, and run on every image in batches
of 1, 3 and 16. Printed: the largest difference of vertices (length unit), markers (length unit), pixels (px) and force
(relative), whether all statuses are equal; milliseconds a frame, best and median, with what its parts take: markers,
reconstruct (image check, rays and result) and estimators, from onnxruntime's own profile of single frames.
"""

import argparse
import json
import tempfile
import time
import warnings
from collections import Counter
from pathlib import Path

import numpy as np
import onnxruntime
import torch

import torchmembrane as tm
from bench.accuracy.accuracy import cases_in
from bench.data.record import write
from torchmembrane.estimators.registry import ESTIMATORS

BATCHES = (1, 3, 16)


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("cases", type=Path)
    parser.add_argument("--estimator", choices=ESTIMATORS, default=next(iter(ESTIMATORS)))
    parser.add_argument("--tracking", action="store_true", help="every frame from its own result, as if it came again")
    parser.add_argument("--only", nargs="*", help="sensors to take, by parts of their file names")
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    warnings.simplefilter("ignore")
    torch.set_num_threads(args.threads)
    cases, rows = cases_in(args.cases), []
    for sensor in sorted({case["sensor"] for case in cases}):
        if args.only and not any(part in sensor for part in args.only):
            continue
        images = [args.cases / image for case in cases if case["sensor"] == sensor for image in case["images"]]
        rows.append(dict(sensor=sensor, **measure(args.cases / sensor, images, args.estimator, args.tracking, args.threads)))
        print(json.dumps(rows[-1]), flush=True)
    write(args.json, dict(estimator=args.estimator, rows=rows))


def measure(sensor: Path, files: list[Path], estimator: str, tracking: bool, threads: int) -> dict:
    reconstructor = tm.Reconstructor.from_file(sensor, estimator)
    with tempfile.TemporaryDirectory() as folder:
        path, start = Path(folder) / "model.onnx", time.perf_counter()
        model = tm.export(reconstructor, path, tracking=tracking)
        row = dict(export_seconds=time.perf_counter() - start, megabytes=path.stat().st_size / 1e6, nodes=count(model.graph))
        start = time.perf_counter()
        session = open_session(path, threads)
        row["load_seconds"] = time.perf_counter() - start
        images = reconstructor.read(*files)
        row |= differences(reconstructor, session, images, tracking)
        for batch in (1, 16):
            feed, _ = given(reconstructor, images[:1].expand(batch, -1, -1, -1).contiguous(), tracking)
            row[f"milliseconds_{batch}"] = seconds(lambda feed=feed: session.run(None, feed), 1000 / batch)
        row["parts"] = parts(path, folder, given(reconstructor, images[:1], tracking)[0], threads)
    return row


def count(graph) -> int:
    inner = [attribute.g for node in graph.node for attribute in node.attribute if attribute.HasField("g")]
    return len(graph.node) + sum(count(body) for body in inner)


def open_session(path: Path, threads: int, **settings) -> onnxruntime.InferenceSession:
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads, options.enable_mem_reuse = threads, False
    for key, value in settings.items():
        setattr(options, key, value)
    return onnxruntime.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])


def seconds(call, scale: float, repeats: int = 20) -> dict[str, float]:
    call()
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        call()
        times.append(scale * (time.perf_counter() - start))
    return dict(best=min(times), median=float(np.median(times)))


def given(reconstructor, images, tracking: bool) -> tuple[dict[str, np.ndarray], tm.Reconstruction | None]:
    """A model's inputs, and the result whose dots it follows; a texture is not followed."""
    if not (tracking and reconstructor.observer.locator.follows):
        return {"image": images.numpy()}, None
    with torch.no_grad():
        before = reconstructor(images)
    return {"image": images.numpy(), "previous_pixels": before.pixels.numpy()}, before


def differences(reconstructor, session, images, tracking: bool) -> dict:
    """Largest differences over all images and batches, damaged ones among them."""
    black, bad = torch.zeros_like(images[:1]), images[:1].clone()
    bad[..., 9, 9] = torch.nan
    images = torch.cat([images, black, bad])
    largest, statuses_equal = Counter(), True
    for batch in BATCHES:
        for part in images.repeat(-(-batch // len(images)), 1, 1, 1).split(batch):
            feed, before = given(reconstructor, part, tracking)
            with torch.no_grad():
                expected = reconstructor(part, before) if tracking else reconstructor(part)
            got = tm.Reconstruction(*session.run(list(tm.Reconstruction._fields), feed))
            statuses_equal &= got.status.tolist() == expected.status.tolist()
            for name in ("vertices", "markers", "pixels", "force"):
                mine, theirs = getattr(got, name), getattr(expected, name).numpy()
                scale = max(float(np.nanmax(np.abs(theirs), initial=0.0)), 1e-9) if name == "force" else 1.0
                statuses_equal &= bool((np.isnan(mine) == np.isnan(theirs)).all())
                largest[name] = max(largest[name], float(np.nanmax(np.abs(mine - theirs), initial=0.0)) / scale)
    return dict(differences=dict(largest), statuses_equal=statuses_equal)


def parts(path: Path, folder: str, feed: dict[str, np.ndarray], threads: int, repeats: int = 20) -> dict[str, float]:
    """Milliseconds a frame by part, which the nodes' names begin with; what profiling itself costs is in them."""
    session = open_session(path, threads, enable_profiling=True, profile_file_prefix=f"{folder}/profile")
    for _ in range(repeats):
        session.run(None, feed)
    events = json.loads(Path(session.end_profiling()).read_text())
    total = Counter()
    for event in events:
        whole_loop = event.get("args", {}).get("op_name") == "Loop"
        if event.get("cat") == "Node" and event["name"].endswith("kernel_time") and not whole_loop:
            part, inside, _ = event["name"].partition("/")
            total[part if inside else "put in by onnxruntime"] += event["dur"] / 1000 / repeats
    return dict(total)


if __name__ == "__main__":
    main()
