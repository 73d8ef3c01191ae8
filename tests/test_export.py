"""The exported model agrees with torch."""

import functools
import importlib.metadata
import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import onnx
import pytest
import torch
from onnxruntime import InferenceSession, SessionOptions
from torch import nn

from torchmembrane import MembraneError
from torchmembrane.control_flow import cond, traced
from torchmembrane.estimators.force_balance.settings import ForceBalanceSettings
from torchmembrane.files.images import to_grey
from torchmembrane.live.streams import ModelStream
from torchmembrane.onnx import export
from torchmembrane.onnx.export import Piece
from torchmembrane.onnx.graph import Assembly
from torchmembrane.onnx.trace import traced_model
from torchmembrane.reconstruct import Reconstructor
from torchmembrane.results.npz import load_frame
from torchmembrane.results.reconstruction import Reconstruction
from torchmembrane.results.status import Status
from torchmembrane.results.store import Mesh

ROOT = Path(__file__).parents[1]


@pytest.fixture(scope="module")
def images(small_images):
    return small_images


@pytest.fixture(scope="module")
def reconstructor(small_sensor):
    """With a coarser grid, which only finer ones than this would have; so coarse the default does not settle beside lost
    markers."""
    settings = ForceBalanceSettings(coarsest=5, fine_steps=24)
    made = Reconstructor.from_file(small_sensor / "sensor.toml", settings=settings)
    assert made.estimator.coarse.membrane.grid == (5, 5)
    return made


@pytest.fixture(scope="module")
def model_files(reconstructor, tmp_path_factory):
    """From rest, and from the frame before; what they share is traced once, and `export` checks the latter only."""
    files = {tracking: tmp_path_factory.mktemp("model") / "model.onnx" for tracking in (False, True)}
    known, trace = {}, export.traced_model

    def once(piece, inputs, outputs):
        key = piece.owner, piece.function, *inputs
        known[key] = known.get(key) or trace(piece, inputs, outputs)
        return known[key]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(export, "traced_model", once)
        export.export(reconstructor, files[True], tracking=True)
        patch.setattr(export, "checked", lambda *_: None)
        export.export(reconstructor, files[False])
    return files


@pytest.fixture(scope="module")
def model_file(model_files):
    return model_files[False]


@functools.cache
def opened(model: str | bytes) -> InferenceSession:
    """One session for each model, as it takes long to optimise one; what becomes of a file is kept as .ort beside it."""
    options = SessionOptions()
    options.intra_op_num_threads = 1
    if str(model).endswith(".onnx"):
        options.optimized_model_filepath = str(Path(model).with_suffix(".ort"))
    return InferenceSession(model, options, providers=["CPUExecutionProvider"])


@pytest.fixture(scope="module")
def ort_file(model_file):
    """The model in onnxruntime's own format."""
    opened(str(model_file))
    return model_file.with_suffix(".ort")


@pytest.fixture
def edge(monkeypatch):
    """The package for machines without torch, which runs the sessions that are open."""
    monkeypatch.syspath_prepend(ROOT / "export")
    import torchmembrane_edge

    monkeypatch.setattr("onnxruntime.InferenceSession", lambda model, *_, **__: opened(model))
    return torchmembrane_edge


@pytest.fixture(scope="module")
def run(model_file):
    session = opened(str(model_file))
    return lambda images: Reconstruction(*session.run(list(Reconstruction._fields), {"image": images.numpy()}))


def agree(result, expected):
    assert result.status.tolist() == expected.status.tolist()
    for name, bound in (("vertices", 1e-3), ("markers", 1e-3), ("pixels", 1e-3), ("normals", 1e-3), ("confidence", 1e-3)):
        mine, theirs = getattr(result, name), getattr(expected, name).numpy()
        assert (np.isnan(mine) == np.isnan(theirs)).all(), name
        assert np.nanmax(np.abs(mine - theirs), initial=0) < bound, name
    np.testing.assert_allclose(result.pressure, expected.pressure.numpy(), rtol=1e-3)
    np.testing.assert_allclose(result.force, expected.force.numpy(), atol=1e-3 * np.nanmax(np.abs(expected.force.numpy())))


def test_an_exported_file_ends_in_the_digest_of_what_is_before_it(model_file):
    content = model_file.read_bytes()
    whole = content[: -len(export.sealed(b""))]
    assert (
        content == export.sealed(whole) and onnx.ModelProto.FromString(content).graph == onnx.ModelProto.FromString(whole).graph
    )


def test_the_model_agrees_with_torch(run, reconstructor, images):
    images = reconstructor.read(*images)
    with torch.no_grad():
        together = reconstructor(images)
    assert together.status.tolist() == [Status.OK] * 3
    agree(run(images), together)
    assert together.displacement[2].norm(dim=-1).max() > 1
    agree(run(images[:1]), Reconstruction(*(field[:1] for field in together)))


def test_a_tracking_model_follows_dots_from_the_frames_before(model_files, reconstructor, images):
    images, session = reconstructor.read(*images), opened(str(model_files[True]))
    with torch.no_grad():
        before = reconstructor(images[[0, 1, 1]])
        before.pixels[2] = torch.nan
        expected = reconstructor(images, before)
    feed = {"image": images.numpy(), "previous_pixels": before.pixels.numpy()}
    agree(Reconstruction(*session.run(list(Reconstruction._fields), feed)), expected)


class Search(nn.Module):
    @traced
    def follow(self, x):
        return (x > 0).all(-1), 2 * x

    @traced
    def search(self, y):
        return (y - 1,)


def test_what_runs_unless_a_condition_holds_runs_only_then():
    tracer, search = export.Tracer(), Search()
    positive, doubled = search.follow(tracer.given("x", torch.ones(2, 3)))
    (y,) = cond(positive, (doubled,), lambda: search.search(doubled))
    tracer.assembly.named(y.name, "result")
    x, result = (onnx.helper.make_tensor_value_info(n, onnx.TensorProto.FLOAT, ["batch", 3]) for n in ("x", "result"))
    session = opened(tracer.assembly.model([x], [result], {}).SerializeToString())
    for x in (np.ones((3, 3), np.float32), -np.ones((1, 3), np.float32)):
        np.testing.assert_array_equal(session.run(None, {"x": x})[0], 2 * x if (x > 0).all() else 2 * x - 1)


def test_damaged_images_get_the_same_status(run, reconstructor, images):
    good = reconstructor.read(images[1])[0]
    blank, nan, noise, hidden = torch.zeros_like(good), good.clone(), torch.rand(good.shape), good.clone()
    nan[0, 5, 7] = torch.nan
    hidden[:, 45:65, 60:80] = 0.5
    filled = [torch.full_like(good, value) for value in (torch.nan, torch.inf, -1e30)]
    images = torch.stack([good, blank, nan, noise, hidden, *filled])
    with torch.no_grad():
        expected = reconstructor(images)
    assert expected.status.tolist() == [
        Status.OK,
        Status.BLANK,
        Status.BAD_VALUES,
        Status.TOO_FEW_MARKERS,
        Status.OK,
        *[Status.BAD_VALUES] * 3,
    ]
    agree(run(images), expected)


def test_the_file_is_plain_onnx_and_says_what_it_is(model_file, reconstructor):
    model = onnx.load(model_file)
    onnx.checker.check_model(model, full_check=True)
    assert model.ir_version == 8 and [(o.domain, o.version) for o in model.opset_import] == [("", 18)]
    assert {node.domain for node in model.graph.node} == {""}
    assert model_file.stat().st_size < 25e6
    assert [output.name for output in model.graph.output] == list(Reconstruction._fields)
    nodes = [inner for node in model.graph.node for inner in (node, *(n for a in node.attribute for n in a.g.node))]
    numbered = {name for node in nodes for name in node.output} - {*Reconstruction._fields}
    assert len(nodes) > 1000 and all(len(name) < 7 for name in numbered)
    assert {node.name.partition("/")[0] for node in nodes} == {"markers", "estimators", "reconstruct", ""}
    known = {entry.key: entry.value for entry in model.metadata_props}
    assert {int(code): text for code, text in json.loads(known["status_texts"]).items()} == {
        status.value: status.text for status in Status
    }
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


@pytest.fixture(scope="module")
def edge_calls(ort_file, images, bare_python, tmp_path_factory):
    """What the command says of good images, whose results are in a folder, of a broken one, and of no model, in one process."""
    folder = tmp_path_factory.mktemp("edge")
    (folder / "broken.png").write_bytes(b"no image")
    calls = [
        [str(ort_file), *map(str, images), "--out", str(folder), "--batch", "2"],
        [str(ort_file), str(folder / "broken.png"), str(images[0]), "--out", str(folder / "part")],
        ["nothing.onnx", "a.png", "--out", "b"],
    ]
    code = "codes = [main(call) for call in " + repr(calls) + "]; print('exit codes', codes)"
    return bare_python("from torchmembrane_edge.cli import main; " + code), folder


def test_edge_runs_without_torch(edge_calls, reconstructor, images, bare_python):
    for name in ("torch", "kornia", "torchmembrane"):
        assert "ModuleNotFoundError" in bare_python(f"import {name}").stderr
    done, folder = edge_calls
    assert done.returncode == 0 and "exit codes [0, " in done.stdout, done.stderr
    assert "3 reconstructed, 0 failed" in done.stdout
    with torch.no_grad():
        expected = reconstructor(reconstructor.read(*images))
    for i, path in enumerate(images):
        frame = load_frame(folder / f"{path.stem}.npz")
        assert np.abs(frame["vertices"] - expected.vertices[i].numpy()).max() < 1e-3
        assert {key: value.dtype for key, value in frame.items()} == {
            key: value.dtype for key, value in expected.frame(i).items()
        }
    mesh = Mesh.load(folder / "mesh.npz")
    np.testing.assert_array_equal(mesh.rest_vertices, reconstructor.estimator.membrane.rest.numpy())
    assert mesh.sensor == reconstructor.sensor.fingerprint and mesh.fixed.dtype == bool
    assert mesh.camera_in_tool.shape == (0, 4) and mesh.tool is None


def test_edge_opens_a_model_in_the_format_of_onnxruntime(model_file, ort_file, images, edge):
    from torchmembrane_edge.images import frames

    plain, converted = edge.Session(model_file), edge.Session(ort_file)
    assert converted.status_texts == plain.status_texts and converted.mesh["sensor"] == plain.mesh["sensor"]
    (frame,) = frames(images[2], plain.image_size)
    expected, found = plain.run(frame.image), converted.run(frame.image)
    for name, values in expected.items():
        np.testing.assert_array_equal(found[name], values, name)


@pytest.mark.parametrize("kind, shape", [(np.uint8, (5, 7, 3)), (np.uint16, (5, 7)), (np.float32, (5, 7, 3))])
def test_edge_sees_the_same_grey(kind, shape, monkeypatch):
    monkeypatch.syspath_prepend(ROOT / "export")
    from torchmembrane_edge.session import grey

    white = np.iinfo(kind).max if kind != np.float32 else 1
    image = (white * np.random.default_rng(0).random(shape)).astype(kind)
    np.testing.assert_array_equal(grey(image[None])[0], to_grey(image))


def test_edge_follows_a_video(model_files, reconstructor, images, edge):
    frames = reconstructor.read(*images)[:, 0].numpy()
    state, found = None, list(edge.Session(model_files[True]).track([*frames[:2], 0 * frames[0], frames[2]]))
    with torch.no_grad():
        for frame, k in zip(found, (0, 1, None, 2), strict=True):
            if k is None:
                assert frame["status"].tolist() == [Status.BLANK] and np.isnan(frame["vertices"]).all()
                state = None
                continue
            state = reconstructor(reconstructor.read(images[k]), state)
            assert np.abs(frame["vertices"] - state.vertices.numpy()).max() < 1e-3
    with pytest.raises(edge.EdgeError, match="does not track"):
        next(edge.Session(model_files[False]).track(frames))


def test_a_stream_by_a_model_gives_what_the_model_gives(model_files, reconstructor, images, edge, tmp_path):
    frames, sensor = reconstructor.read(*images)[:, 0].numpy(), reconstructor.sensor.fingerprint
    expected = edge.Session(model_files[True]).track(frames)
    stream = ModelStream(model_files[True], sensor)
    for image, each in zip(frames, expected, strict=True):
        frame = stream(image, 0.0)
        assert frame.keys() == each.keys() and all(np.array_equal(frame[key], each[key][0], equal_nan=True) for key in each)
    np.testing.assert_array_equal(stream.mesh.rest_vertices, reconstructor.estimator.membrane.rest.numpy())
    with pytest.raises(MembraneError, match="rest state baked in"):
        stream.rezero()
    with pytest.raises(MembraneError, match="of another sensor, 'cap'"):
        ModelStream(model_files[True], 64 * "0")
    with pytest.raises(MembraneError, match="--model .*no such file"):
        ModelStream(tmp_path / "none.onnx", sensor)


def test_edge_says_what_is_wrong(edge_calls):
    done, _ = edge_calls
    assert done.stdout.endswith(", 1, 2]\n"), done.stdout
    assert "broken.png: not readable" in done.stderr and "1 reconstructed, 1 failed" in done.stdout
    assert "nothing.onnx: no such file" in done.stderr


class Fall(nn.Module):
    def step(self, height, speed, drag, pull):
        return height + speed, speed * (1 - drag) - pull


def test_a_repeated_piece_is_a_loop():
    height, speed, drag = torch.rand(2, 3), torch.rand(2, 3), torch.rand(2, 3)
    pulls = np.array([0.1, 0.3, 0.2], np.float32)
    names = ("height", "speed", "drag", "pull")
    inputs = dict(zip(names, (height, speed, drag, torch.tensor(0.1)), strict=True))
    model, assembly = traced_model(Piece(Fall(), Fall.step), inputs, ["a", "b"]), Assembly()
    last = assembly.loop(model, {name: name for name in names[:3]}, 3, {"pull": pulls})
    for name, here in zip(("end", "rate"), last.values(), strict=True):
        assembly.named(here, name)
    value = lambda name: onnx.helper.make_tensor_value_info(name, onnx.TensorProto.FLOAT, ["batch", 3])  # noqa: E731
    model = assembly.model([value(name) for name in names[:3]], [value("end"), value("rate")], {})
    assert [node.op_type for node in model.graph.node] == ["Loop", "Identity", "Identity"]
    feeds = {name: inputs[name].numpy() for name in names[:3]}
    session = opened(model.SerializeToString())
    for pull in pulls:
        height, speed = height + speed, speed * (1 - drag) - pull
    for found, expected in zip(session.run(None, feeds), (height, speed), strict=True):
        np.testing.assert_allclose(found, expected.numpy(), rtol=1e-5)
