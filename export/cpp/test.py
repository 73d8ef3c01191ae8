"""Compare the C++ example with the Python package: the same status, wrench and pressure, and a one-line error.

python export/cpp/test.py FRAME MODEL.onnx IMAGE...; FRAME is what `cmake --build` made of main.cpp.
"""

import re
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
import onnx
from PIL import Image

sys.path.insert(0, str(Path(__file__).parents[1]))
from torchmembrane_edge import Session

NUMBER = re.compile(r"-?\d+\.?\d*(?:e[-+]\d+)?")
PRINTED = 1e-5  # six digits are printed


def main(frame: str, model: str, *images: str) -> None:
    session = Session(model)
    with tempfile.TemporaryDirectory() as folder:
        grey = Path(folder) / "image.pgm"
        call = lambda path: subprocess.run([frame, model, path], capture_output=True, text=True)  # noqa: E731
        for image in images:
            pixels = Image.open(image).convert("L")
            pixels.save(grey)
            compare(call(grey), session, session.run(np.asarray(pixels)), image)
        Image.new("L", pixels.size, 128).save(grey)
        compare(call(grey), session, session.run(np.full(pixels.size[::-1], 128, np.uint8)), "blank")
        Image.new("L", (7, 5), 128).save(grey)
        done = call(grey)
        assert done.returncode == 2 and "the image is 7 x 5 px, the sensor's are" in done.stderr, done
        apart = Path(folder) / "apart.onnx"
        apart.write_bytes(of_views(model))
        done = subprocess.run([frame, apart, grey], capture_output=True, text=True)
        assert done.returncode == 2 and "takes an image for each view" in done.stderr, done
        grey.write_bytes(grey.read_bytes()[:-1])
        done = call(grey)
        assert done.returncode == 2 and "ends before its last pixel" in done.stderr, done


def of_views(path: str) -> bytes:
    """Return a model that takes an image for each of two views and gives the first one; its metadata are those of a model."""
    shape = ["batch", 1, 5, 7]
    given = [onnx.helper.make_tensor_value_info(f"image_{name}", onnx.TensorProto.FLOAT, shape) for name in ("left", "right")]
    seen = onnx.helper.make_tensor_value_info("seen", onnx.TensorProto.FLOAT, shape)
    graph = onnx.helper.make_graph([onnx.helper.make_node("Identity", ["image_left"], ["seen"])], "views", given, [seen])
    made = onnx.helper.make_model(graph, opset_imports=[onnx.helper.make_opsetid("", 17)], ir_version=8)
    made.metadata_props.extend(onnx.load(path).metadata_props)
    return made.SerializeToString()


def compare(done: subprocess.CompletedProcess, session: Session, results: dict, image: str) -> None:
    expected = {key: value[0] for key, value in results.items()}
    lines = dict(line.split(": ", 1) for line in done.stdout.splitlines())
    code = int(expected["status"])
    assert lines["status"] == f"{code}, {session.status_texts[code]}", done
    if np.isnan(expected["force"]).any():
        assert done.returncode == 1 and list(lines) == ["status"], done
        print(f"{image}: status {lines['status']}")
        return
    assert done.returncode == 0, done
    wrench = numbers(lines["wrench"])
    error = np.abs(wrench - expected["wrench"]).max() / np.abs(expected["wrench"]).max()
    assert error < PRINTED, (image, wrench, expected["wrench"])
    pressures = numbers(lines["pressure"].replace(f"{session.length_unit}^2", ""))
    np.testing.assert_allclose(pressures, [expected["pressure"], expected["pressure_change"]], rtol=PRINTED)
    contacts = [name for name in lines if name.startswith("contact")]
    assert len(contacts) == np.isfinite(expected["contact_points"][:, 0]).sum(), done
    for i, name in enumerate(contacts):
        found = numbers(lines[name].replace(f"{session.length_unit}^2", ""))
        keys = ("contact_points", "contact_force", "contact_normal")
        np.testing.assert_allclose(
            found, [*np.ravel([expected[key][i] for key in keys]), expected["contact_area"][i]], 1e-4, 1e-5
        )
    print(f"{image}: status {lines['status']}; wrench within {error:.0e} of the Python package's")


def numbers(line: str) -> np.ndarray:
    return np.array([float(number) for number in NUMBER.findall(line)])


if __name__ == "__main__":
    main(*sys.argv[1:])
