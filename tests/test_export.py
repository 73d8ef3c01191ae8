"""The exported model against torch, and the package that runs it where torch is not installed."""

import importlib.metadata
import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import onnx
import onnxruntime
import pytest
import torch
from torch import nn

from torchmembrane import cli
from torchmembrane.assembly import Assembly, traced
from torchmembrane.export import Piece
from torchmembrane.images import to_grey
from torchmembrane.reconstruct import Reconstructor
from torchmembrane.results import BAD_VALUES, BLANK, OK, STATUS_TEXTS, TOO_FEW_MARKERS, Reconstruction, load_frame
from torchmembrane.store import Mesh

ROOT = Path(__file__).parents[1]
SENSOR = ROOT / "examples" / "sensor.toml"
IMAGES = [ROOT / "examples" / f"{name}.png" for name in ("press_on_axis", "two_contacts", "flat_plate")]


@pytest.fixture(scope="module")
def model_file(tmp_path_factory):
    path = tmp_path_factory.mktemp("model") / "model.onnx"
    assert cli.main(["export", str(SENSOR), "-o", str(path)]) == 0
    return path


@pytest.fixture(scope="module")
def reconstructor():
    return Reconstructor.from_file(SENSOR)


@pytest.fixture(scope="module")
def run(model_file):
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = 1
    session = onnxruntime.InferenceSession(str(model_file), options, providers=["CPUExecutionProvider"])
    return lambda images: Reconstruction(*session.run(list(Reconstruction._fields), {"image": images.numpy()}))


def agree(result, expected):
    assert result.status.tolist() == expected.status.tolist()
    for name, bound in (("vertices", 1e-3), ("markers", 1e-3), ("pixels", 1e-3), ("normals", 1e-3), ("confidence", 1e-3)):
        mine, theirs = getattr(result, name), getattr(expected, name).numpy()
        assert (np.isnan(mine) == np.isnan(theirs)).all(), name
        assert np.nanmax(np.abs(mine - theirs), initial=0) < bound, name
    np.testing.assert_allclose(result.pressure, expected.pressure.numpy(), rtol=1e-3)


def test_the_model_agrees_with_torch(run, reconstructor):
    images = reconstructor.read(*IMAGES)
    with torch.no_grad():
        together = reconstructor(images)
    assert together.status.tolist() == [OK] * 3
    agree(run(images), together)
    agree(run(images[:1]), Reconstruction(*(field[:1] for field in together)))


def test_damaged_images_get_the_same_status(run, reconstructor):
    good = reconstructor.read(IMAGES[0])[0]
    blank, nan, noise, hidden = torch.zeros_like(good), good.clone(), torch.rand(good.shape), good.clone()
    nan[0, 5, 7] = torch.nan
    hidden[:, 150:230, 250:330] = 0.5
    images = torch.stack([good, blank, nan, noise, hidden])
    with torch.no_grad():
        expected = reconstructor(images)
    assert expected.status.tolist() == [OK, BLANK, BAD_VALUES, TOO_FEW_MARKERS, OK]
    agree(run(images), expected)


def test_the_file_is_plain_onnx_and_says_what_it_is(model_file, reconstructor):
    model = onnx.load(model_file)
    onnx.checker.check_model(model, full_check=True)
    assert model.ir_version == 8 and [(o.domain, o.version) for o in model.opset_import] == [("", 18)]
    assert {node.domain for node in model.graph.node} == {""}
    assert model_file.stat().st_size < 25e6
    assert [output.name for output in model.graph.output] == list(Reconstruction._fields)
    known = {entry.key: entry.value for entry in model.metadata_props}
    assert {int(code): text for code, text in json.loads(known["status_texts"]).items()} == STATUS_TEXTS
    np.testing.assert_array_equal(json.loads(known["mesh"])["triangles"], reconstructor.estimator.membrane.triangles)


@pytest.fixture(scope="module")
def bare_python(tmp_path_factory):
    """A call of Python that sees, besides its standard library, only numpy, onnxruntime, Pillow and torchmembrane-edge."""
    site = tmp_path_factory.mktemp("site")
    for name in ("numpy", "onnxruntime", "flatbuffers", "packaging", "protobuf", "pillow"):
        for file in importlib.metadata.files(name):
            top = site / file.parts[0]
            if file.parts[0] not in ("..", "__pycache__") and not top.exists():
                top.symlink_to(Path(file.locate()).parents[len(file.parts) - 2] if len(file.parts) > 1 else file.locate())
    (site / "torchmembrane_edge").symlink_to(ROOT / "export" / "torchmembrane_edge")
    begin = f"import sys; sys.path.append({str(site)!r}); "
    return lambda code: subprocess.run([sys.executable, "-I", "-S", "-c", begin + code], capture_output=True, text=True)


def test_edge_runs_without_torch(model_file, reconstructor, bare_python, tmp_path):
    for name in ("torch", "kornia", "torchmembrane"):
        assert "ModuleNotFoundError" in bare_python(f"import {name}").stderr
    arguments = [str(model_file), *map(str, IMAGES), "--out", str(tmp_path), "--batch", "2"]
    done = bare_python(f"from torchmembrane_edge.cli import main; sys.exit(main({arguments!r}))")
    assert done.returncode == 0, done.stderr
    assert "3 reconstructed, 0 failed" in done.stdout
    with torch.no_grad():
        expected = reconstructor(reconstructor.read(*IMAGES))
    for i, path in enumerate(IMAGES):
        frame = load_frame(tmp_path / f"{path.stem}.npz")
        assert np.abs(frame["vertices"] - expected.vertices[i].numpy()).max() < 1e-3
        assert {key: value.dtype for key, value in frame.items()} == {
            key: value.dtype for key, value in expected.frame(i).items()
        }
    mesh = Mesh.load(tmp_path / "mesh.npz")
    np.testing.assert_array_equal(mesh.rest_vertices, reconstructor.estimator.membrane.rest.numpy())
    assert mesh.sensor == reconstructor.sensor.fingerprint and mesh.fixed.dtype == bool


@pytest.mark.parametrize("kind, shape", [(np.uint8, (5, 7, 3)), (np.uint16, (5, 7)), (np.float32, (5, 7, 3))])
def test_edge_sees_the_same_grey(kind, shape, monkeypatch):
    monkeypatch.syspath_prepend(ROOT / "export")
    from torchmembrane_edge.session import grey

    white = np.iinfo(kind).max if kind != np.float32 else 1
    image = (white * np.random.default_rng(0).random(shape)).astype(kind)
    np.testing.assert_array_equal(grey(image[None])[0], to_grey(image))


def test_edge_says_what_is_wrong(model_file, bare_python, tmp_path):
    (tmp_path / "broken.png").write_bytes(b"no image")
    images = [str(tmp_path / "broken.png"), str(IMAGES[0])]
    arguments = [str(model_file), *images, "--out", str(tmp_path)]
    done = bare_python(f"from torchmembrane_edge.cli import main; sys.exit(main({arguments!r}))")
    assert done.returncode == 1 and "broken.png: not readable" in done.stderr and "1 reconstructed, 1 failed" in done.stdout
    done = bare_python("from torchmembrane_edge.cli import main; sys.exit(main(['nothing.onnx', 'a.png', '--out', 'b']))")
    assert done.returncode == 2 and "nothing.onnx: no such file" in done.stderr


class Fall(nn.Module):
    def step(self, height, speed, drag, pull):
        return height + speed, speed * (1 - drag) - pull


def test_a_repeated_piece_is_a_loop():
    height, speed, drag = torch.rand(2, 3), torch.rand(2, 3), torch.rand(2, 3)
    pulls = np.array([0.1, 0.3, 0.2], np.float32)
    names = ("height", "speed", "drag", "pull")
    inputs = dict(zip(names, (height, speed, drag, torch.tensor(0.1)), strict=True))
    piece, assembly = traced(Piece(Fall(), Fall.step), inputs, ["a", "b"]), Assembly()
    last = assembly.repeat(piece, {name: name for name in names[:3]}, 3, {"pull": pulls})
    for name, here in zip(("end", "rate"), last.values(), strict=True):
        assembly.named(here, name)
    value = lambda name: onnx.helper.make_tensor_value_info(name, onnx.TensorProto.FLOAT, ["batch", 3])  # noqa: E731
    model = assembly.model([value(name) for name in names[:3]], [value("end"), value("rate")], {})
    assert [node.op_type for node in model.graph.node] == ["Loop", "Identity", "Identity"]
    feeds = {name: inputs[name].numpy() for name in names[:3]}
    session = onnxruntime.InferenceSession(model.SerializeToString(), providers=["CPUExecutionProvider"])
    for pull in pulls:
        height, speed = height + speed, speed * (1 - drag) - pull
    for found, expected in zip(session.run(None, feeds), (height, speed), strict=True):
        np.testing.assert_allclose(found, expected.numpy(), rtol=1e-5)
