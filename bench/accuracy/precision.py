"""An exported model in half precision and in 8-bit integers: size, time, and whether an answer is left.

python -m bench.accuracy.precision MODEL.onnx IMAGE... [--json FILE]

float16: every constant and operator but the inputs and outputs, by onnxruntime's converter. int8: weights of matrix products
and convolutions, by onnxruntime's dynamic quantisation. If there is no such MODEL yet, the example sensor is
exported on 17 x 17 vertices. Printed against the file as it is (float32): MB, the best of five runs of a frame, and for every
image the status, the largest difference of a vertex (length unit) and of the force (relative).
"""

import argparse
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import onnx
from onnxruntime.quantization import quantize_dynamic
from onnxruntime.transformers.float16 import convert_float_to_float16
from PIL import Image

import torchmembrane as tm
from bench.data.record import write

sys.path.insert(0, str(Path(__file__).parents[2] / "export"))
from torchmembrane_edge import EdgeError, Session

EXAMPLE = Path(__file__).parents[2] / "examples/sensor.toml"


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("model", type=Path)
    parser.add_argument("images", type=Path, nargs="+")
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    if not args.model.exists():
        export_example(args.model)
    images = [np.asarray(Image.open(path).convert("L")) for path in args.images]
    plain, rows = Session(args.model), []
    expected = [plain.run(image) for image in images]
    with tempfile.TemporaryDirectory() as folder:
        for name, convert in (("float32", None), ("float16", to_float16), ("int8", quantize_dynamic)):
            path = Path(folder) / f"{name}.onnx" if convert else args.model
            rows.append(dict(precision=name, **measure(path, args.model, convert, images, expected)))
            print(rows[-1], flush=True)
    write(args.json, dict(model=args.model.name, rows=rows))


def export_example(path: Path) -> None:
    sensor = tm.Sensor.from_file(EXAMPLE)
    path.parent.mkdir(parents=True, exist_ok=True)
    tm.export(tm.Reconstructor(replace(sensor, membrane=sensor.surface.membrane((17, 17)))), path)


def to_float16(model: Path, out: Path) -> None:
    onnx.save(convert_float_to_float16(onnx.load(model), keep_io_types=True), out)


def measure(path: Path, model: Path, convert, images: list, expected: list) -> dict:
    if convert:
        convert(model, path)
    row = dict(megabytes=path.stat().st_size / 1e6)
    try:
        session = Session(path)
    except EdgeError as error:
        print(error)
        return row | dict(not_loaded=True)
    found = [session.run(image) for image in images]
    row["milliseconds"] = min(milliseconds(session, images[0]) for _ in range(5))
    row["status"] = [int(result["status"][0]) for result in found]
    pairs, size = list(zip(found, expected, strict=True)), np.linalg.norm
    row["vertices"] = [float(np.abs(a["vertices"] - b["vertices"]).max()) for a, b in pairs]
    row["force"] = [float(size(a["force"] - b["force"]) / size(b["force"])) for a, b in pairs]
    return row


def milliseconds(session: Session, image: np.ndarray) -> float:
    start = time.perf_counter()
    session.run(image)
    return 1000 * (time.perf_counter() - start)


if __name__ == "__main__":
    main()
