"""Every choice of the command is exported; bad models are refused."""

from contextlib import nullcontext
from dataclasses import replace

import numpy as np
import onnx
import onnxruntime
import pytest
import torch

from torchmembrane import MembraneError
from torchmembrane.camera.model import Camera
from torchmembrane.cli import main as cli
from torchmembrane.estimators.base import Observation
from torchmembrane.estimators.paper.estimator import FLOWS
from torchmembrane.estimators.registry import ESTIMATORS
from torchmembrane.onnx import check, export, trace
from torchmembrane.onnx.check import Agreement, check_images, checked
from torchmembrane.onnx.export import Piece
from torchmembrane.onnx.graph import Assembly
from torchmembrane.onnx.trace import traced_model
from torchmembrane.reconstruct import Reconstructor
from torchmembrane.sensor.parts import Cavity
from torchmembrane.sensor.sensor import Sensor
from torchmembrane.solve.inverse_root import by_products


@pytest.fixture(scope="module")
def sensor(small_sensor):
    return Sensor.from_file(small_sensor / "sensor.toml")


def nodes(graph):
    for node in graph.node:
        yield node
        for attribute in node.attribute:
            yield from nodes(attribute.g)


def ran(tracer, inputs, output):
    """What the traced graph gives for `inputs`, alone and together, by the name of one output; its operators are standard."""
    tracer.assembly.named(output.name, "output")
    shape = ["batch", *output.example.shape[1:]]
    described = [
        onnx.helper.make_tensor_value_info(k, onnx.TensorProto.FLOAT, ["batch", *v.shape[1:]]) for k, v in inputs.items()
    ]
    given = onnx.helper.make_tensor_value_info("output", onnx.TensorProto.FLOAT, shape)
    model = tracer.assembly.model(described, [given], {})
    assert {node.domain for node in nodes(model.graph)} == {""}
    session = onnxruntime.InferenceSession(model.SerializeToString(), providers=["CPUExecutionProvider"])
    for count in (1, 3):
        yield session.run(None, {name: values[:count].numpy() for name, values in inputs.items()})[0]


@pytest.mark.parametrize("estimator", ["minimum-energy", "paper"])
def test_every_solve_agrees_with_torch(sensor, estimator):
    made = Reconstructor(sensor, estimator, locator="fit")
    solve, tracer = made.estimator, export.Tracer()
    flow = 3 * torch.rand(3, 1, 2) * solve.free[:, None]
    origins, directions = made.camera.pixel_to_ray(made.vertex_pixels + flow)
    rays = {"origins": origins.expand(directions.shape).contiguous(), "directions": directions}
    confidence = torch.ones(directions.shape[:2])
    found = solve(Observation(*(tracer.given(name, values[:2]) for name, values in rays.items()), confidence[:2]))
    with torch.no_grad():
        expected = solve(Observation(**rays, confidence=confidence)).vertices
    assert (expected - solve.membrane.rest).norm(dim=-1).max() > 0.1
    for vertices in ran(tracer, rays, found.vertices):
        np.testing.assert_allclose(vertices, expected[: len(vertices)].numpy(), rtol=0, atol=1e-4)


@pytest.mark.parametrize("flow", FLOWS)
def test_every_flow_agrees_with_torch(sensor, flow):
    made = Reconstructor(sensor, "paper", settings=ESTIMATORS["paper"].Settings(flow=flow), locator="fit")
    inputs = {"u": 2 * torch.rand(3, 49, 2), "confidence": (torch.rand(3, 49) > 0.1).float()}
    tracer = export.Tracer()
    found = made.observation(*(tracer.given(name, values[:2]) for name, values in inputs.items()))
    with torch.no_grad():
        expected = made.observation(*inputs.values()).directions
    for directions in ran(tracer, inputs, found.directions):
        np.testing.assert_allclose(directions, expected[: len(directions)].numpy(), rtol=0, atol=1e-5)


def agree_as_pieces(piece, inputs, **tolerance):
    """The values of a piece, and that its model gives them of three frames and of one."""
    with torch.no_grad():
        expected = piece(*inputs.values())
    names = [f"output {k}" for k in range(len(expected))]
    model = traced_model(piece, {name: value[:2] for name, value in inputs.items()}, names)
    session = onnxruntime.InferenceSession(model.SerializeToString(), providers=["CPUExecutionProvider"])
    for count in (1, 3):
        found = session.run(names, {name: value[:count].numpy() for name, value in inputs.items()})
        for got, value in zip(found, expected, strict=True):
            np.testing.assert_allclose(got, value[:count].numpy(), **tolerance)
    return expected


BEHIND = {"ports": [(2, 3, 1.49)], "medium_index": 1.33}


@pytest.mark.parametrize("model, behind", [("fisheye", {}), ("fisheye", BEHIND), ("pinhole", {}), ("pinhole", BEHIND)])
def test_every_camera_agrees_with_torch(model, behind):
    camera = Camera(model, (640, 480), (400, 400), (320, 240), **behind).float()
    points = torch.rand(3, 20, 3) * torch.tensor([8.0, 6.0, 10.0]) + torch.tensor([-4.0, -3.0, 15.0])
    (pixels,) = agree_as_pieces(Piece(camera, Camera.point_to_pixel), {"points": points}, rtol=0, atol=1e-3)
    assert pixels.isfinite().all()
    agree_as_pieces(Piece(camera, Camera.pixel_to_ray), {"pixels": pixels}, rtol=0, atol=1e-5)


@pytest.mark.parametrize("cavity", [Cavity("liquid"), Cavity("gas", 1013.0), Cavity("open")], ids=lambda cavity: cavity.filling)
def test_the_step_of_every_cavity_agrees_with_torch(sensor, cavity):
    made = Reconstructor(replace(sensor, cavity=cavity)).estimator.gauss_newton
    x, p = made.membrane.rest + torch.rand(3, *made.membrane.rest.shape), made.cavity.rest_pressure * (1 + torch.rand(3))
    inputs = {"u": x - made.membrane.rest, "pressure": p, "products": torch.randn(3, 3, 3)}
    inputs |= {"load": torch.rand(3), "corner": torch.rand(3)}
    step = Piece(made, lambda owner, u, p, products, *corner: owner._shares(u, p, products, corner))
    (shares,) = agree_as_pieces(step, inputs, rtol=1e-4)
    assert (shares[:, 2].abs().max() > 0) == (cavity.filling != "open")
    error = Piece(made.cavity, lambda owner, volume, p: owner.volume_error(volume, p))
    agree_as_pieces(error, {"volume": made.membrane.volume(x), "pressure": p}, rtol=1e-4, atol=1e-6)


def test_nan_beside_a_surface_is_no_agreement(sensor, monkeypatch):
    class Session:
        def __init__(self, *_, **__):
            pass

        def get_inputs(self):
            return [onnx.helper.make_tensor_value_info("image", onnx.TensorProto.FLOAT, None)]

        def run(self, names, feed):
            frames = len(feed["image"])
            vertices = made.estimator.membrane.rest.numpy() * np.array([1, np.nan])[:frames, None, None]
            return vertices, np.zeros(frames, np.int32)

    made = Reconstructor(sensor, "minimum-energy")
    monkeypatch.setattr(check.onnxruntime, "InferenceSession", Session)
    rest = made.grey(check.Simulator(sensor).rest_image())
    found = check.compare(b"", made, rest.expand(2, -1, -1, -1))
    assert found.status == found.expected == [0, 0, 0] and np.isnan(found.distance)


class Lengths(torch.nn.Module):
    """The batch's length in shapes, of which one Reshape cannot have it free, and in whatever else it is given."""

    def __init__(self, further=lambda x, batch: x):
        super().__init__()
        self.further = further

    def forward(self, *x):
        batch = len(x[0])
        pairs = torch.cat([x[0], torch.zeros(batch, 3).expand(batch, 3)]).reshape(2, batch, 3)
        return self.further(pairs.mT.reshape(-1, batch * 3), batch)


@pytest.mark.parametrize("frames", [1, 2, 5])
@pytest.mark.parametrize("further", [lambda x, batch: x, lambda x, batch: x / batch])
def test_lengths_of_the_batch_stay_free(frames, further):
    model = traced_model(Lengths(further), {"x": torch.rand(2, 3)}, ["y"])
    x = torch.rand(frames, 3)
    found = onnxruntime.InferenceSession(model.SerializeToString()).run(None, {"x": x.numpy()})[0]
    np.testing.assert_array_equal(found, Lengths(further)(x))


@pytest.mark.parametrize("every, share", [(2, 0.7), (3, 0.45), (300, 0.03), (70_000, 0.01)])
def test_what_is_mostly_zero_is_stored_by_its_places(every, share):
    array, assembly = np.zeros((300, 500), np.float32), Assembly()
    array.ravel()[7::every] = np.random.default_rng(0).random(array.ravel()[7::every].size) + 1
    assembly.nodes.append(onnx.helper.make_node("MatMul", ["x", assembly.constant(array)], ["y"]))
    x, y = (onnx.helper.make_tensor_value_info(*given) for given in (("x", 1, ["batch", 300]), ("y", 1, ["batch", 500])))
    stored = assembly.model([x], [y], {}).SerializeToString()
    assert len(stored) < share * array.nbytes
    session = onnxruntime.InferenceSession(stored, providers=["CPUExecutionProvider"])
    np.testing.assert_array_equal(session.run(None, {"x": np.eye(300, dtype=np.float32)})[0], array)


class Composite(torch.nn.Module):
    """Operators that ONNX has and torch composes of others, one that it has not, and one that changes its argument."""

    def forward(self, x, y):
        angle = torch.atan2((x @ y).sum(-1), torch.einsum("bij,bkj->bi", x, y)) + torch.linalg.vector_norm(x, dim=-1)
        angle[:, 1:] += 2
        return torch.nn.functional.layer_norm(angle, (3,)), angle[:, None].expand_as(x).diff(dim=-1).clamp(max=1)


def test_a_model_in_a_folder_that_does_not_exist_is_refused_before_any_work(sensor, tmp_path, monkeypatch):
    monkeypatch.setattr(export, "Tracer", None)
    with pytest.raises(MembraneError, match="missing/model.onnx: the folder .*missing does not exist; make it first"):
        export.export(Reconstructor(sensor, "paper", locator="fit"), tmp_path / "missing" / "model.onnx")


def test_a_graph_captured_at_once_is_what_torch_makes_of_it_in_two_steps(monkeypatch):
    inputs = {"x": torch.rand(2, 3, 3), "y": torch.rand(2, 3, 3)}
    at_once = traced_model(Composite(), inputs, ["a", "b"])
    monkeypatch.setattr(trace.EXPORTER, "captured", torch.export.export)
    monkeypatch.setattr(trace.EXPORTER, "at_work", nullcontext)
    monkeypatch.setattr(torch.fx.config, "do_not_emit_stack_traces", True)  # which are all that would differ
    in_two_steps = traced_model(Composite(), inputs, ["a", "b"])
    assert [node.op_type for node in at_once.graph.node] == [node.op_type for node in in_two_steps.graph.node]
    for model in (at_once, in_two_steps):
        for node in model.graph.node:
            del node.metadata_props[:]  # the modules that it stood in
    assert at_once.SerializeToString(deterministic=True) == in_two_steps.SerializeToString(deterministic=True)


class WithOnes(torch.nn.Module):
    """Products with one: of an operator that torch's exporter writes so, of an output, of one that makes a longer shape."""

    def forward(self, x, y):
        return torch.addcmul(x, x, y), 1.0 * x, (x * torch.ones(1, 1, 1)).sum(0)


def test_products_with_one_are_left_out():
    inputs = {"x": torch.rand(2, 3), "y": torch.rand(2, 3)}
    model = traced_model(WithOnes(), inputs, ["a", "b", "c"])
    assert sorted(node.op_type for node in model.graph.node) == ["Add", "Mul", "Mul", "Mul", "ReduceSum"]
    session = onnxruntime.InferenceSession(model.SerializeToString(), providers=["CPUExecutionProvider"])
    found = session.run(None, {name: value.numpy() for name, value in inputs.items()})
    for value, expected in zip(found, WithOnes()(*inputs.values()), strict=True):
        np.testing.assert_allclose(value, expected, rtol=1e-6)


class Selected(torch.nn.Module):
    """Entries of rows, whole rows, and rows from the back; in a shape that is put together of lengths."""

    places, rows = torch.tensor([3, 0, 0, 2, 4], dtype=torch.int32), torch.tensor([1, 1, 0])

    def forward(self, x):
        entries = x.index_select(2, self.places)
        return entries.unflatten(-1, (5, 1)).flatten(0, 1), x.index_select(-1, self.places), x.index_select(1, self.rows)


@pytest.mark.parametrize("frames", [1, 2, 5])
def test_entries_of_rows_are_selected_one_by_one_and_whole_rows_as_such(frames):
    model = traced_model(Selected(), {"x": torch.rand(2, 2, 5)}, ["a", "b", "c"])
    nodes = [node.op_type for node in model.graph.node]
    assert nodes.count("GatherElements") == 1 and nodes.count("Gather") == 1  # of rows and from the back it is the same one
    assert "Concat" not in nodes
    x = torch.rand(frames, 2, 5)
    found = onnxruntime.InferenceSession(model.SerializeToString()).run(None, {"x": x.numpy()})
    for value, expected in zip(found, Selected()(x), strict=True):
        np.testing.assert_array_equal(value, expected)


def test_a_number_that_depends_on_the_batch_is_refused():
    with pytest.raises(ValueError, match="computes with the batch size as a value, not as a length"):
        traced_model(Lengths(lambda x, batch: x + float(2 * batch)), {"x": torch.rand(2, 3)}, ["y"])


class Rooted(torch.nn.Module):
    """Inverse roots of matrices larger than a leaf, or what cannot be traced behind one."""

    def __init__(self, further=lambda root: root):
        super().__init__()
        self.further = further

    def forward(self, *x):
        return self.further(by_products(x[0]))


def test_a_named_function_is_one_node_only_while_a_piece_is_traced():
    random = torch.randn(2, 60, 60)
    matrix = random @ random.mT + torch.eye(60)
    (node,) = traced_model(Rooted(), {"x": matrix}, ["y"]).graph.node
    assert (node.domain, node.op_type, list(node.attribute[0].ints)) == ("torchmembrane", "by_products", [60, 60])
    with pytest.raises(Exception, match="aten._linalg_check_errors"):
        traced_model(Rooted(torch.linalg.cholesky), {"x": matrix}, ["y"])
    root = by_products(matrix)
    torch.testing.assert_close(root @ matrix @ root.mT, torch.eye(60).expand(2, -1, -1), atol=1e-3, rtol=0)


def test_a_model_is_checked_on_the_sensor_at_rest_and_pressed(sensor):
    made = Reconstructor(sensor, "minimum-energy")
    with torch.no_grad():
        rest, pressed, again = made(check_images(made)).displacement.norm(dim=-1).amax(-1)
    assert max(rest, again) < 0.05 < 0.1 < pressed


@pytest.mark.parametrize(
    "found, said",
    [
        (Agreement(0.02, [0, 0], [0, 0]), "2.0e-02 from torch's"),
        (Agreement(0.0, [0, 0], [0, 2]), r"statuses \[0, 0\], torch's \[0, 2\]"),
        (Agreement(np.nan, [0, 0], [0, 0]), "nan from torch's"),
    ],
)
def test_what_is_not_the_same_is_refused(sensor, found, said, monkeypatch):
    monkeypatch.setattr(check, "compare", lambda *_: found)
    monkeypatch.setattr(check, "check_images", lambda *_: None)
    monkeypatch.setattr(check, "rounding", lambda *_: 0.0024)
    with pytest.raises(MembraneError, match=said):
        checked(b"", Reconstructor(sensor, "minimum-energy"))


def test_what_float32_makes_of_a_model_is_no_disagreement(sensor, monkeypatch):
    made = Reconstructor(sensor, "minimum-energy")
    assert 0 < check.rounding(made, check_images(made)) < check.LARGEST * made.estimator.membrane.size
    found = Agreement(0.02, [0], [0])
    monkeypatch.setattr(check, "compare", lambda *_: found)
    monkeypatch.setattr(check, "rounding", lambda *_: 0.0026)
    assert checked(b"", made) == found


@pytest.mark.parametrize("part", ["traced_model", "checked"])
def test_a_failure_is_said_in_one_line_and_nothing_is_written(part, small_sensor, tmp_path, monkeypatch, capsys):
    def refuse(*_):
        if part == "checked":
            raise MembraneError("export: not the same")
        raise onnx.shape_inference.InferenceError("\n[ShapeInferenceError] ranks differ\n  in node 3\n")

    monkeypatch.setattr(export, part, refuse)
    if part == "checked":
        monkeypatch.setattr(Reconstructor, "reconstruct_grey", lambda *_: None)
        monkeypatch.setattr(export, "_finished", lambda *_: onnx.ModelProto())
    code = cli.main(["export", str(small_sensor / "sensor.toml"), "-o", str(tmp_path / "model.onnx")])
    said = [line for line in capsys.readouterr().err.splitlines() if not line.startswith("export: ")]
    assert code == 2 and len(said) == 1 and list(tmp_path.iterdir()) == []
    assert ("not the same" if part == "checked" else "cannot be written as ONNX: [ShapeInferenceError] ranks differ") in said[0]


@pytest.mark.parametrize("follows, tracking", [(True, True), (False, True), (True, False)])
def test_a_tracking_model_is_given_where_dots_were(follows, tracking, small_sensor, tmp_path, monkeypatch):
    """Of any estimator; a texture, which is not followed, makes the same model as without tracking."""
    made = Reconstructor.from_file(small_sensor / "sensor.toml", estimator="minimum-energy")
    made.observer.locator.follows = follows
    names = []
    monkeypatch.setattr(Reconstructor, "reconstruct_grey", lambda _, *given: names.extend(value.name for value in given))
    monkeypatch.setattr(export, "_finished", lambda *_: onnx.ModelProto())
    monkeypatch.setattr(export, "checked", lambda *_: None)
    export.export(made, tmp_path / "model.onnx", tracking=tracking)
    assert names == (["image", "previous_pixels"] if follows and tracking else ["image"])


def test_single_precision_only(sensor, tmp_path):
    with pytest.raises(MembraneError, match=r"float64; expected torch.float32"):
        export.export(Reconstructor(sensor, "minimum-energy", dtype=torch.float64), tmp_path / "model.onnx")
