"""The exported model of two views agrees with torch."""

from dataclasses import replace

import numpy as np
import pytest
import torch
import torchmembrane_edge as edge
from PIL import Image
from test_views import BESIDE, CAMERA, cap
from torchmembrane_edge.cli import main

import torchmembrane as tm
from torchmembrane.files.provenance import SourceFile
from torchmembrane.live.streams import ModelStream
from torchmembrane.onnx.export import export
from torchmembrane.sensor.views import View
from torchmembrane.simulate import Simulator, Sphere
from torchmembrane.simulate.dataset import stroke_to

pytestmark = pytest.mark.full  # an export of two views takes some 90 s of processor time, opening its session 25


@pytest.fixture(scope="module")
def frames():
    """A sensor with two views, their images at rest and of two presses, [W, H, W'] uint8 each."""
    simulator = Simulator(cap(View("right", CAMERA, BESIDE)))
    stroke = stroke_to(simulator, Sphere(3.0), np.array([0.0, 1.0, 18.0]), np.array([0.0, 0.0, -1.0]), 1.0)
    rng = np.random.default_rng(0)
    pressed = [simulator.images(state.vertices, rng) for state in simulator.presses(stroke, ["push"], 2)]
    return simulator.at_rest(), [simulator.images(simulator.membrane.rest, rng), *pressed]


@pytest.fixture(scope="module")
def made(frames, tmp_path_factory):
    """The reconstructor, and its model that follows the dots."""
    reconstructor, path = tm.Reconstructor(frames[0]), tmp_path_factory.mktemp("views") / "model.onnx"
    export(reconstructor, path, tracking=True)
    return reconstructor, path, edge.Session(path)


def agrees(got, expected):
    """Every output of the model as torch's."""
    assert got.keys() == expected._asdict().keys()
    for name, value in expected._asdict().items():
        scale = float(value.nan_to_num().abs().max())
        pressed = expected.displacement.norm(dim=-1).amax(-1) > 0.1  # where nothing moves, any point is the deepest
        rows = pressed.numpy() if name == "depth_deviation" else slice(None)
        np.testing.assert_allclose(got[name][rows], value.numpy()[rows], rtol=0, atol=2e-3 * scale + 1e-4, err_msg=name)


def test_a_model_of_two_views_gives_what_torch_gives(frames, made):
    """In batches of three and one; a view that is dark is left out in both; from the frame before."""
    reconstructor, _, session = made
    assert session.views == ("left", "right") and session.image_sizes == [(160, 120)] * 2 and session.tracks
    left, right = (np.stack([frame[w] for frame in frames[1]]) for w in (0, 1))
    dark = np.full_like(left[:1], 30)
    previous, before = None, None
    for images in ([left, right], [left[:1], right[:1]], [left[1:2], right[1:2]], [left[1:2], dark], [dark, dark]):
        alone = len(images[0]) == 1
        with torch.no_grad():
            expected = reconstructor(images, before if alone else None)
        got = session.run(images, previous if alone else None)
        agrees(got, expected)
        previous, before = (got, expected) if alone else (None, None)
    assert got["status"].tolist() == [4] and expected.status.tolist() == [4]
    assert session.run([left[1:2], dark])["status"].tolist() == [10]


def test_a_view_without_a_picture_is_left_out_by_the_model_too(frames, made):
    """As `live --model` does it: NaN in place of what a camera did not give."""
    left = frames[1][1][0]
    frame = ModelStream(made[1], made[0].sensor.fingerprint)([left, None], 0.0)
    with torch.no_grad():
        expected = made[0]([left, None])
    assert int(frame["status"]) == int(expected.status[0]) == 10 and not frame["confidence"][1].any()
    np.testing.assert_allclose(frame["vertices"], expected.vertices[0].numpy(), atol=2e-3)


def test_a_model_of_regions_takes_the_image_that_they_share(frames, tmp_path):
    """One input, of the whole image; its outputs are those of torch, and one dark region is left out."""
    cameras = [CAMERA, tm.Camera("pinhole", (160, 120), (100, 100), (79.5 + 160, 59.5))]
    wholes = [tm.Camera("pinhole", (320, 120), camera.focal.tolist(), camera.centre.tolist()) for camera in cameras]
    first, other = (whole.in_mode((160 * w, 0, 160, 120)) for w, whole in enumerate(wholes))
    views = View("left", first, is_region=True), View("right", other, BESIDE, is_region=True)
    simulator = Simulator(replace(cap(camera=first), views=views))
    reconstructor, path = tm.Reconstructor(simulator.at_rest()), tmp_path / "model.onnx"
    export(reconstructor, path)
    session = edge.Session(path)
    assert session.views == () and session.image_sizes == [(320, 120)] and session.mesh["rest_pixels"].shape == (2, 49, 2)
    images = np.stack([np.concatenate(frame, 1) for frame in frames[1]])
    images[2, :, 160:] = 30
    with torch.no_grad():
        expected = reconstructor(images)
    got = session.run(images)
    agrees(got, expected)
    assert got["status"].tolist()[2] == 10 and 10 not in got["status"].tolist()[:2]


def test_images_of_other_views_are_refused_in_words(frames, made):
    left, right = frames[1][0]
    for wrong, said in (
        (left, "not a list of 2; expected one with those of the views left, right"),
        ([left], "not a list of 2"),
        ([left, np.stack([right] * 2)], r"\[1, 2\] images of the views left, right"),
        ([left, right[:100]], "expected 160 x 120"),
    ):
        with pytest.raises(edge.EdgeError, match=said):
            made[2].run(wrong)


def test_the_command_takes_an_image_of_each_view(frames, made, tmp_path, capsys):
    """Results, tables and hashes are those of the first view's name, and as of `torchmembrane reconstruct`."""
    for number, frame in enumerate(frames[1]):
        for name, image in zip(("left", "right"), frame, strict=True):
            Image.fromarray(image).save(tmp_path / f"press{number}_{name}.png")
    out = tmp_path / "out"
    assert main([str(made[1]), f"{tmp_path}/press*.png", "--out", str(out)]) == 0
    results = tm.read_results(out)
    assert results.names == ["press0_left", "press1_left", "press2_left"] and results.mesh.views == 2
    tracked = list(made[2].track(frames[1]))
    for name, expected in zip(results.names, tracked, strict=True):
        np.testing.assert_array_equal(results[name]["vertices"], expected["vertices"][0])
    files = [tmp_path / f"press1_{name}.png" for name in ("left", "right")]
    row = next(row for row in (out / "summary.csv").read_text().splitlines() if row.startswith("press1_left"))
    assert SourceFile.from_files(*files).content_hash in row
    files[1].unlink()
    assert main([str(made[1]), f"{tmp_path}/press*.png", "--out", str(out)]) == 0
    assert "left out: the answer is the others': right (" in capsys.readouterr().err
    assert main([str(made[1]), str(tmp_path / "press0_right.png"), "--out", str(out)]) == 2
    assert "expected images NAME_left, NAME_right of each frame" in capsys.readouterr().err
