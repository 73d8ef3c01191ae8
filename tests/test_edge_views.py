"""The edge package runs a model of two views.

`tests/test_export_views.py` runs an exported one.
"""

import json

import numpy as np
import onnx
import pytest
import torchmembrane_edge as edge
from onnx import TensorProto, helper
from PIL import Image
from test_edge import MESH, metadata
from torchmembrane_edge.cli import main

from torchmembrane.files.provenance import SourceFile

SIZES = {"left": (8, 6), "right": (5, 4)}


@pytest.fixture(scope="module")
def model(tmp_path_factory):
    """Gives the left image's mean less the right one's as the vertices' heights."""
    nodes = [helper.make_node("ReduceMean", [f"image_{name}"], [f"mean_{name}"], axes=[1, 2, 3]) for name in SIZES]
    nodes += [
        helper.make_node("Sub", ["mean_left", "mean_right"], ["mean4"]),
        helper.make_node("Reshape", ["mean4", "ones3"], ["mean"]),
        helper.make_node("Mul", ["mean", "surface"], ["vertices"]),
        helper.make_node("Identity", ["vertices"], ["displacement"]),
        helper.make_node("Reshape", ["mean4", "column"], ["mean2"]),
        helper.make_node("Mul", ["mean2", "push"], ["force"]),
        helper.make_node("Concat", ["force", "force"], ["wrench"], axis=1),
        helper.make_node("Reshape", ["mean4", "one"], ["mean1"]),
        helper.make_node("Less", ["mean1", "least"], ["never"]),
        helper.make_node("Cast", ["never"], ["status"], to=TensorProto.INT32),
    ]
    constants = {"ones3": np.array([-1, 1, 1]), "column": np.array([-1, 1]), "one": np.array([-1])}
    constants |= {"surface": np.ones((1, 9, 3), np.float32), "push": np.array([[0, 0, -1]], np.float32)}
    constants["least"] = np.array([-2], np.float32)
    shapes = {"vertices": [9, 3], "displacement": [9, 3], "force": [3], "wrench": [6]}

    def described(name, shape, kind=TensorProto.FLOAT):
        return helper.make_tensor_value_info(name, kind, ["batch", *shape])

    graph = helper.make_graph(
        nodes,
        "by_hand",
        [described(f"image_{name}", [1, height, width]) for name, (width, height) in SIZES.items()],
        [*(described(name, shape) for name, shape in shapes.items()), described("status", [], TensorProto.INT32)],
        [onnx.numpy_helper.from_array(value, name) for name, value in constants.items()],
    )
    made = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8)
    mesh = MESH | {"rest_pixels": [[[4.0, 3.0]], [[2.0, 2.0]]]}
    helper.set_model_props(made, metadata(mesh=json.loads(json.dumps(mesh))))
    path = tmp_path_factory.mktemp("model") / "model.onnx"
    path.write_bytes(made.SerializeToString())
    return path


def images(left, right, count=1):
    return [np.full((count, *SIZES[name][::-1]), value, np.uint8) for name, value in (("left", left), ("right", right))]


def test_each_view_is_its_own_input(model):
    session = edge.Session(model)
    assert session.views == ("left", "right") and session.image_sizes == [(8, 6), (5, 4)]
    for count in (1, 3):
        heights = session.run(images(204, 51, count))["vertices"]
        np.testing.assert_allclose(heights, np.full((count, 9, 3), 0.6), atol=1e-6)
    for wrong, said in (
        (images(0, 0)[0], "no list of 2; expected one with those of the views left, right"),
        (images(0, 0)[:1], "no list of 2"),
        ([images(0, 0)[0], images(0, 0, 2)[1]], r"\[1, 2\] images of the views left, right"),
        (images(0, 0)[::-1], "expected 8 x 6"),
    ):
        with pytest.raises(edge.EdgeError, match=said):
            session.run(wrong)


def test_the_command_takes_the_files_of_each_view(model, tmp_path, capsys):
    """Results bear the first view's name, and the hash of all files."""
    for number in range(2):
        for name, image in zip(SIZES, images(100 + number, 10), strict=True):
            Image.fromarray(image[0]).save(tmp_path / f"press{number}_{name}.png")
    (tmp_path / "press1_right.png").unlink()
    out = tmp_path / "out"
    assert main([str(model), f"{tmp_path}/press*.png", "--out", str(out)]) == 1
    assert "press1_right.png" in capsys.readouterr().err
    assert sorted(path.name for path in out.glob("press*")) == ["press0_left.npz"]
    np.testing.assert_allclose(np.load(out / "press0_left.npz")["vertices"], np.full((9, 3), 90 / 255), atol=1e-6)
    files = [tmp_path / f"press0_{name}.png" for name in SIZES]
    assert SourceFile.from_files(*files).content_hash in (out / "summary.csv").read_text().splitlines()[1]
    assert main([str(model), str(files[1]), "--out", str(out)]) == 2
    assert "expected images NAME_left, NAME_right of each frame" in capsys.readouterr().err
