"""The exported model of two views agrees with torch."""

import numpy as np
import pytest
import torch
import torchmembrane_edge as edge
from PIL import Image
from test_views import BESIDE, CAMERA, cap
from torchmembrane_edge.cli import main

import torchmembrane as tm
from torchmembrane.files.provenance import SourceFile
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
    """The reconstructor, of few steps, and its model that follows the dots."""
    settings = tm.ForceBalanceSettings(steps=5, retry_steps_factor=1)
    reconstructor, path = tm.Reconstructor(frames[0], settings=settings), tmp_path_factory.mktemp("views") / "model.onnx"
    export(reconstructor, path, tracking=True)
    return reconstructor, path, edge.Session(path)


def agrees(got, expected):
    """Every output of the model as torch's."""
    assert got.keys() == expected._asdict().keys()
    for name, value in expected._asdict().items():
        scale = float(value.nan_to_num().abs().max())
        pressed = expected.displacement.norm(dim=-1).amax(-1) > 0.1  # where nothing moves, any point is the deepest
        rows = pressed if name == "depth_deviation" else torch.ones_like(pressed)
        np.testing.assert_allclose(got[name][rows], value[rows].numpy(), rtol=0, atol=2e-3 * scale + 1e-4, err_msg=name)


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


def test_images_of_other_views_are_refused_in_words(frames, made):
    left, right = frames[1][0]
    for wrong, said in (
        (left, "no list of 2; expected one with those of the views left, right"),
        ([left], "no list of 2"),
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
    assert main([str(made[1]), f"{tmp_path}/press*.png", "--out", str(out)]) == 1
    assert "press1_right.png" in capsys.readouterr().err
    assert main([str(made[1]), str(tmp_path / "press0_right.png"), "--out", str(out)]) == 2
    assert "expected images NAME_left, NAME_right of each frame" in capsys.readouterr().err
