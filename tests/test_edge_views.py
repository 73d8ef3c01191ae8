"""The edge package runs a model of two views.

`tests/test_export_views.py` runs an exported one.
"""

import json
import os

import numpy as np
import onnx
import pytest
import torchmembrane_edge as edge
from onnx import TensorProto, helper
from PIL import Image
from test_edge import MESH, metadata
from torchmembrane_edge.cli import main
from torchmembrane_edge.images import view_frames

from torchmembrane.files.provenance import SourceFile

SIZES = {"left": (8, 6), "right": (5, 4)}


@pytest.fixture(scope="module")
def model(tmp_path_factory):
    """Gives the left image's mean less the right one's as the vertices' heights; without a right one the left one's alone."""
    nodes = [helper.make_node("ReduceMean", [f"image_{name}"], [f"mean_{name}"], axes=[1, 2, 3]) for name in SIZES]
    nodes += [
        helper.make_node("IsNaN", ["mean_right"], ["lacks4"]),
        helper.make_node("Where", ["lacks4", "zero", "mean_right"], ["right4"]),
        helper.make_node("Sub", ["mean_left", "right4"], ["mean4"]),
        helper.make_node("Reshape", ["mean4", "ones3"], ["mean"]),
        helper.make_node("Mul", ["mean", "surface"], ["vertices"]),
        helper.make_node("Identity", ["vertices"], ["displacement"]),
        helper.make_node("Reshape", ["mean4", "column"], ["mean2"]),
        helper.make_node("Mul", ["mean2", "push"], ["force"]),
        helper.make_node("Concat", ["force", "force"], ["wrench"], axis=1),
        helper.make_node("Reshape", ["lacks4", "one"], ["lacks"]),
        helper.make_node("Cast", ["lacks"], ["lacks1"], to=TensorProto.INT32),
        helper.make_node("Mul", ["lacks1", "ten"], ["status"]),
    ]
    constants = {"ones3": np.array([-1, 1, 1]), "column": np.array([-1, 1]), "one": np.array([-1])}
    constants |= {"surface": np.ones((1, 9, 3), np.float32), "push": np.array([[0, 0, -1]], np.float32)}
    constants |= {"zero": np.zeros(1, np.float32), "ten": np.array([10], np.int32)}
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
    mesh = MESH | {"rest_pixels": [[[4.0, 3.0]], [[2.0, 2.0]]], "view_names": " ".join(SIZES)}
    texts = json.dumps({"0": "ok", "10": "a view shows too little"})
    helper.set_model_props(made, metadata(mesh, status_texts=texts))
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
        (images(0, 0)[0], "not a list of 2; expected one with those of the views left, right"),
        (images(0, 0)[:1], "not a list of 2"),
        ([images(0, 0)[0], images(0, 0, 2)[1]], r"\[1, 2\] images of the views left, right"),
        (images(0, 0)[::-1], "expected 8 x 6"),
        ([None, None], r"\[\] images of the views left, right; expected the same number for each, for at least one view"),
    ):
        with pytest.raises(edge.EdgeError, match=said):
            session.run(wrong)
    found = session.run([images(204, 0, 2)[0], None])
    assert found["status"].tolist() == [10, 10]
    np.testing.assert_allclose(found["vertices"], np.full((2, 9, 3), 0.8), atol=1e-6)


def test_the_command_takes_the_files_of_each_view(model, tmp_path, capsys):
    """Results bear the first view's name, and the hash of all files; a view without an image is left out, and named."""
    for number in range(2):
        for name, image in zip(SIZES, images(100 + number, 10), strict=True):
            Image.fromarray(image[0]).save(tmp_path / f"press{number}_{name}.png")
    (tmp_path / "press1_right.png").unlink()
    out = tmp_path / "out"
    assert main([str(model), f"{tmp_path}/press*.png", "--out", str(out), "--batch", "2"]) == 0
    assert "press1_left.png: a view shows too little" in (said := capsys.readouterr().err) and "right (" in said
    for number, height in enumerate((90, 101)):
        found = np.load(out / f"press{number}_left.npz")["vertices"]
        np.testing.assert_allclose(found, np.full((9, 3), height / 255), atol=1e-6)
    lacking = (out / "summary.csv").read_text().splitlines()[2]
    assert "right (" in lacking and SourceFile.from_files(tmp_path / "press1_left.png").content_hash in lacking
    files = [tmp_path / f"press0_{name}.png" for name in SIZES]
    assert SourceFile.from_files(*files).content_hash in (out / "summary.csv").read_text().splitlines()[1]
    Image.fromarray(images(100, 10)[0][0]).save(tmp_path / "press.png")
    assert main([str(model), str(tmp_path / "press.png"), "--out", str(out)]) == 2
    assert "expected images NAME_left, NAME_right of each frame" in capsys.readouterr().err
    for name in SIZES:
        (tmp_path / f"broken_{name}.png").write_bytes(b"no image")
    assert main([str(model), f"{tmp_path}/broken*.png", "--out", str(out)]) == 1
    assert "view left: " in (said := capsys.readouterr().err) and "view right: " in said


def test_a_frame_may_lack_the_first_view_and_views_may_have_different_endings(model, tmp_path):
    for (name, image), ending in zip(zip(SIZES, images(100, 10), strict=True), ("png", "bmp"), strict=True):
        Image.fromarray(image[0]).save(tmp_path / f"both_{name}.{ending}")
    Image.fromarray(images(100, 51)[1][0]).save(tmp_path / "alone_right.png")
    assert main([str(model), f"{tmp_path}/*_*.*", "--out", str(tmp_path / "out")]) == 0
    for name, height in (("both", 90 / 255), ("alone", np.nan)):  # this model needs the left image
        found = np.load(tmp_path / "out" / f"{name}_left.npz")["vertices"]
        np.testing.assert_allclose(found, np.full((9, 3), height), atol=1e-6)


@pytest.mark.parametrize("latest", SIZES)
def test_the_source_of_a_frame_is_that_of_all_views_files_as_torchmembrane_has_it(latest, tmp_path):
    """Size, hash and the time of the latest change, whichever view's file it is."""
    files = [tmp_path / f"press_{name}.png" for name in SIZES]
    for name, image, file in zip(SIZES, images(100, 10), files, strict=True):
        Image.fromarray(image[0]).save(file)
        os.utime(file, (1.7e9 + 60 * (name == latest),) * 2)
    (frame,) = view_frames(files[0], list(SIZES), list(SIZES.values()), None)
    expected = SourceFile.from_files(*files)
    known = ("path", "file_size", "file_modified", "content_hash")
    assert {key: frame.origin[key] for key in known} == {key: getattr(expected, key) for key in known}


def test_pictures_of_a_stack_that_one_view_lacks(model, tmp_path, capsys):
    """Frames bear the first view's name and the picture's number, also where that view has none."""
    for name, count in (("left", 1), ("right", 2)):
        pages = [Image.fromarray(page) for page in images(100, 10, count)[list(SIZES).index(name)]]
        pages[0].save(tmp_path / f"run_{name}.tif", save_all=True, append_images=pages[1:])
    made = view_frames(tmp_path / "run_left.tif", list(SIZES), list(SIZES.values()), None)
    assert [(frame.name, list(frame.lacking)) for frame in made] == [("run_left", []), ("run_left_000001", ["left"])]
