"""The exported model agrees with torch."""

import importlib.metadata
import json
import subprocess
import sys
from dataclasses import replace
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
from torchmembrane.sensor.parts import Cavity
from torchmembrane.sensor.sensor import Sensor

ROOT = Path(__file__).parents[1]


@pytest.fixture(scope="module")
def images(small_images):
    return small_images


CASES = {"slack gas, tracked": ("gas", True), "liquid, tracked": ("liquid", True), "liquid, from rest": ("liquid", False)}
"""What fills the sensor, and whether its model follows dots; from a frame before of NaN that one starts from rest, too."""


@pytest.fixture(scope="module", params=[pytest.param(key, marks=pytest.mark.full if k else []) for k, key in enumerate(CASES)])
def case(request):
    return CASES[request.param]


@pytest.fixture(scope="module")
def tracking(case):
    return case[1]


@pytest.fixture(scope="module")
def reconstructor(small_sensor, case):
    """On grids that have a coarser one; frames take steps until rounding no longer decides which was the last one. The sheet
    full of gas is so slack that it is solved in double precision."""
    sensor, lines = Sensor.from_file(small_sensor / "sensor.toml"), 11 if case[0] == "gas" else 17
    sensor = replace(sensor, membrane=sensor.surface.membrane((lines, lines)))
    if case[0] == "gas":
        sensor = replace(sensor, material=replace(sensor.material, prestretch=1.1), cavity=Cavity("gas", 1013.0))
    made = Reconstructor(sensor, settings=ForceBalanceSettings(steps=(400, 200, 100), settled_step_tol=2e-6))
    assert made.estimator.coarse is not None and made.estimator.solves_in_double == (case[0] == "gas")
    return made


@pytest.fixture(scope="module")
def shares():
    """What `export` tells of its progress."""
    return []


@pytest.fixture(scope="module")
def model_file(reconstructor, tracking, shares, tmp_path_factory):
    """The model, whose session is opened once: by `export`, which checks it."""
    path, checked = tmp_path_factory.mktemp("model") / "model.onnx", []
    shares.clear()

    def session(model, *_, **__):
        checked.append(model)
        return opened(str(path), model)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("onnxruntime.InferenceSession", session)
        export.export(reconstructor, path, tracking=tracking, progress=lambda share, step: shares.append((share, step)))
    assert path.read_bytes() == export.sealed(*checked)
    return path


SESSIONS: dict[str, InferenceSession] = {}


def opened(path: str, model: bytes | None = None) -> InferenceSession:
    """One session for each model, as it takes long to optimise one; what becomes of it is kept as .ort beside the file."""
    if path not in SESSIONS:
        options = SessionOptions()
        options.intra_op_num_threads, options.log_severity_level, options.enable_mem_reuse = 1, 3, False
        if path.endswith(".onnx"):
            options.optimized_model_filepath = str(Path(path).with_suffix(".ort"))
        SESSIONS[path] = InferenceSession(model or path, options, providers=["CPUExecutionProvider"])
    return SESSIONS[path]


@pytest.fixture
def edge(monkeypatch):
    """The package for machines without torch, which runs the sessions that are open."""
    monkeypatch.syspath_prepend(ROOT / "export")
    import torchmembrane_edge

    monkeypatch.setattr("onnxruntime.InferenceSession", lambda model, *_, **__: opened(str(model)))
    return torchmembrane_edge


@pytest.fixture(scope="module")
def run(model_file, tracking, reconstructor):
    """The model's result of images, from rest or from pixels of the frames before."""
    session = opened(str(model_file))

    def run(images, before=None):
        feed = {"image": images.numpy()}
        if tracking:
            nothing = torch.full((len(images), *reconstructor.rest_pixels.shape), torch.nan)
            feed["previous_pixels"] = (nothing if before is None else before).numpy()
        return Reconstruction(*session.run(list(Reconstruction._fields), feed))

    return run


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


def test_the_share_told_before_the_last_pieces_is_that_of_the_nodes_of_so_many_grids(model_file, shares):
    """It neither stays behind nor stands still long before the check."""
    told = [share for share, step in shares if not step.startswith("check")]
    assert told == sorted(told) and told[0] == 0.0
    assert 0.7 * export.CHECK < told[-1] <= export.CHECK and told.count(export.CHECK) <= 2
    assert shares[-1] == (export.CHECK, "check against torch")


def test_the_model_agrees_with_torch(run, reconstructor, images):
    images = reconstructor.read(*images)
    with torch.no_grad():
        together = reconstructor(images)
    assert together.status.tolist() == [Status.OK] * 3
    agree(run(images), together)
    assert together.displacement[2].norm(dim=-1).max() > 1
    agree(run(images[:1]), Reconstruction(*(field[:1] for field in together)))


def test_a_tracking_model_follows_dots_from_the_frames_before(run, tracking, reconstructor, images):
    images = reconstructor.read(*images)
    with torch.no_grad():
        before = reconstructor(images[[0, 1, 1]])
        before.pixels[2] = torch.nan
        expected = reconstructor(images, before if tracking else None)
    agree(run(images, before.pixels), expected)


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
    session = InferenceSession(tracer.assembly.model([x], [result], {}).SerializeToString())
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


ONCE = """
import functools, json, onnxruntime
from torchmembrane_edge import Session
from torchmembrane_edge.cli import main
make = onnxruntime.InferenceSession
once = functools.cache(lambda model: make(model, providers=["CPUExecutionProvider"]))
onnxruntime.InferenceSession = lambda model, *_, **__: once(model)
"""
"""Opens a model once in a process."""


@pytest.fixture(scope="module")
def edge_calls(model_file, images, bare_python, tmp_path_factory):
    """What the command says of good images, whose results are in a folder, of a broken one, and of no model, in one process;
    the model is in onnxruntime's own format, with the texts of statuses last."""
    folder, model = tmp_path_factory.mktemp("edge"), str(model_file.with_suffix(".ort"))
    (folder / "broken.png").write_bytes(b"no image")
    calls = [
        [model, *map(str, images), "--out", str(folder), "--batch", "2"],
        [model, str(folder / "broken.png"), str(images[0]), "--out", str(folder / "part")],
        ["nothing.onnx", "a.png", "--out", "b"],
    ]
    said = f"print('exit codes', [main(call) for call in {calls!r}]); print(json.dumps(Session({model!r}).status_texts))"
    return bare_python(ONCE + said), folder


def test_edge_runs_without_torch(edge_calls, reconstructor, tracking, images, bare_python):
    for name in ("torch", "kornia", "torchmembrane"):
        assert "ModuleNotFoundError" in bare_python(f"import {name}").stderr
    done, folder = edge_calls
    assert done.returncode == 0 and "exit codes [0, " in done.stdout, done.stderr
    assert "3 reconstructed, 0 failed" in done.stdout
    expected = None
    for path in images:
        frame = load_frame(folder / f"{path.stem}.npz")
        with torch.no_grad():
            expected = reconstructor(reconstructor.read(path), expected if tracking else None)
        assert np.abs(frame["vertices"] - expected.vertices[0].numpy()).max() < 1e-3
        assert {key: value.dtype for key, value in frame.items()} == {
            key: value.dtype for key, value in expected.frame(0).items()
        }
    mesh = Mesh.load(folder / "mesh.npz")
    np.testing.assert_array_equal(mesh.rest_vertices, reconstructor.estimator.membrane.rest.float().numpy())
    assert mesh.sensor == reconstructor.sensor.fingerprint and mesh.fixed.dtype == bool
    assert mesh.camera_in_tool.shape == (0, 4) and mesh.tool is None


def test_edge_opens_a_model_in_the_format_of_onnxruntime(model_file, tracking, edge_calls, images, edge):
    """It says of itself and gives what the model as ONNX does, but for rounding: onnxruntime joins other nodes in it."""
    from torchmembrane_edge.images import frames

    plain, (done, folder) = edge.Session(model_file), edge_calls
    assert {int(code): text for code, text in json.loads(done.stdout.splitlines()[-1]).items()} == plain.status_texts
    assert Mesh.load(folder / "mesh.npz").sensor == plain.mesh["sensor"]
    read = [next(iter(frames(path, plain.image_size))).image for path in images]
    expected = plain.track(read) if tracking else map(plain.run, read)
    for path, results in zip(images, expected, strict=True):
        found = load_frame(folder / f"{path.stem}.npz")
        for name, values in results.items():
            rounding = 3e-5 * max(1.0, np.nanmax(abs(values[0]))) if values.dtype.kind == "f" else 0
            np.testing.assert_allclose(found[name], values[0], rtol=0, atol=rounding, err_msg=name)


@pytest.mark.parametrize("kind, shape", [(np.uint8, (5, 7, 3)), (np.uint16, (5, 7)), (np.float32, (5, 7, 3))])
def test_edge_sees_the_same_grey(kind, shape, monkeypatch):
    monkeypatch.syspath_prepend(ROOT / "export")
    from torchmembrane_edge.session import grey

    white = np.iinfo(kind).max if kind != np.float32 else 1
    image = (white * np.random.default_rng(0).random(shape)).astype(kind)
    np.testing.assert_array_equal(grey(image[None])[0], to_grey(image))


def test_edge_follows_a_video(model_file, tracking, reconstructor, images, edge):
    frames = reconstructor.read(*images)[:, 0].numpy()
    session = edge.Session(model_file)
    if not tracking:
        with pytest.raises(edge.EdgeError, match="does not track"):
            next(session.track(frames))
        return
    state, found = None, list(session.track([*frames[:2], 0 * frames[0], frames[2]]))
    with torch.no_grad():
        for frame, k in zip(found, (0, 1, None, 2), strict=True):
            if k is None:
                assert frame["status"].tolist() == [Status.BLANK] and np.isnan(frame["vertices"]).all()
                state = None
                continue
            state = reconstructor(reconstructor.read(images[k]), state)
            assert np.abs(frame["vertices"] - state.vertices.numpy()).max() < 1e-3


def test_a_stream_by_a_model_gives_what_the_model_gives(model_file, tracking, reconstructor, images, edge, tmp_path):
    frames, sensor = reconstructor.read(*images)[:, 0].numpy(), reconstructor.sensor.fingerprint
    session = edge.Session(model_file)
    expected = session.track(frames) if tracking else map(session.run, frames)
    stream = ModelStream(model_file, sensor)
    for image, each in zip(frames, expected, strict=True):
        frame = stream(image, 0.0)
        assert frame.keys() == each.keys() and all(np.array_equal(frame[key], each[key][0], equal_nan=True) for key in each)
    np.testing.assert_array_equal(stream.mesh.rest_vertices, reconstructor.estimator.membrane.rest.float().numpy())
    with pytest.raises(MembraneError, match="contains a fixed rest state"):
        stream.rezero()
    with pytest.raises(MembraneError, match="belongs to another sensor, 'cap'"):
        ModelStream(model_file, 64 * "0")
    with pytest.raises(MembraneError, match="--model .*no such file"):
        ModelStream(tmp_path / "none.onnx", sensor)


def test_edge_says_what_is_wrong(edge_calls):
    done, _ = edge_calls
    assert "exit codes [0, 1, 2]\n" in done.stdout, done.stdout
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
    session = InferenceSession(model.SerializeToString())
    for pull in pulls:
        height, speed = height + speed, speed * (1 - drag) - pull
    for found, expected in zip(session.run(None, feeds), (height, speed), strict=True):
        np.testing.assert_allclose(found, expected.numpy(), rtol=1e-5)
