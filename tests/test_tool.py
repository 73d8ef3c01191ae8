"""Wrenches transform with the camera's pose in a tool's frame."""

import dataclasses
import json

import numpy as np
import onnx
import pytest
import torch
from onnx import TensorProto, helper
from PIL import Image
from scipy.spatial.transform import Rotation

import torchmembrane as tm
from torchmembrane.cli.describe import described
from torchmembrane.onnx.export import metadata_of
from torchmembrane.results.store import Mesh, Settings

TURN = Rotation.from_rotvec([20.0, -70.0, 110.0], degrees=True).as_matrix()
SHIFT = np.array([3.0, -12.0, 41.0])
TOOL = tm.Pose(TURN, SHIFT)


def wrench_of(forces, points, about=0.0):
    """Force and moment, summed up point by point."""
    return np.concatenate([forces.sum(0), np.cross(points - about, forces).sum(0)])


@pytest.fixture
def load():
    rng = np.random.default_rng(0)
    return rng.standard_normal((40, 3)), 10 * rng.standard_normal((40, 3)) + [0, 0, 20]


def test_a_wrench_in_the_tool_is_that_of_the_forces_there(load):
    forces, points = load
    there = wrench_of(TOOL.vectors(forces), TOOL.points(points))
    np.testing.assert_allclose(TOOL.wrench(wrench_of(forces, points)), there, atol=1e-12)


def test_the_force_keeps_its_size_and_the_moment_is_about_the_tool_s_origin(load):
    """Moment law: about another point `o` it is `M - o x f`; the tool's origin is `-R^T t` in the camera's frame."""
    forces, points = load
    origin = -TURN.T @ SHIFT
    np.testing.assert_allclose(TOOL.points(origin), 0, atol=1e-12)
    force, moment = np.split(TOOL.wrench(wrench_of(forces, points)), 2)
    expected = wrench_of(forces, points, about=origin)
    assert np.linalg.norm(force) == pytest.approx(np.linalg.norm(expected[:3]))
    np.testing.assert_allclose(TURN.T @ moment, expected[3:], atol=1e-10)


def test_power_does_not_depend_on_the_frame(load):
    """Of a rigid motion with velocity v of the frame's origin and spin w: `f v + M w`."""
    wrench, rng = wrench_of(*load), np.random.default_rng(1)
    velocity, spin = rng.standard_normal((2, 3))
    spin_there = TOOL.vectors(spin)
    velocity_there = TOOL.vectors(velocity) - np.cross(spin_there, SHIFT)
    there = TOOL.wrench(wrench) @ np.concatenate([velocity_there, spin_there])
    assert there == pytest.approx(wrench @ np.concatenate([velocity, spin]))


def test_a_rotation_vector_is_the_matrix_that_it_stands_for():
    for vector in ([0, 0, 0], [1e-9, 0, 0], [0, 90, 0], [180, 0, 0], [20, -70, 110], [300, 200, -100]):
        expected = Rotation.from_rotvec(vector, degrees=True).as_matrix()
        np.testing.assert_allclose(tm.Pose(vector, [0, 0, 0]).rotation, expected, atol=1e-14)
    right, _, ahead = tm.Pose([0, 90, 0], [0, 0, 0]).rotation.T
    np.testing.assert_allclose([right, ahead], [[0, 0, -1], [1, 0, 0]], atol=1e-15)


@pytest.mark.parametrize(
    "rotation, translation, words",
    [
        (np.diag([1.0, 1.0, -1.0]), SHIFT, "expected determinant 1; this one's is -1, a reflection"),
        (1.01 * TURN, SHIFT, "expected orthogonal rows of length one"),
        (TURN + [[0, 0.01, 0], [0, 0, 0], [0, 0, 0]], SHIFT, "expected orthogonal"),
        (np.zeros((3, 3)), SHIFT, "expected orthogonal"),
        (np.full((3, 3), np.nan), SHIFT, "three rows of three finite numbers"),
        (np.eye(4), SHIFT, "three rows of three finite numbers"),
        (TURN, SHIFT[:2], "translation is [3.0, -12.0]; expected three finite numbers"),
        (TURN, [0, 0, np.inf], "translation is [0.0, 0.0, inf]"),
    ],
)
def test_what_is_no_pose_is_refused_in_words(rotation, translation, words):
    with pytest.raises(tm.MembraneError) as caught:
        tm.Pose(rotation, translation)
    assert words in str(caught.value)


def test_three_decimals_of_a_rotation_are_enough():
    np.testing.assert_array_equal(tm.Pose(TURN.round(3), SHIFT).rotation, TURN.round(3))


@pytest.fixture(scope="module")
def sensor(small_sensor):
    return dataclasses.replace(tm.Sensor.from_file(small_sensor / "sensor.toml"), tool=TOOL)


@pytest.fixture(scope="module")
def reconstructor(sensor):
    return tm.Reconstructor(sensor)


@pytest.fixture(scope="module")
def results(reconstructor, small_images):
    with torch.no_grad():
        return reconstructor(reconstructor.read(*small_images))


def test_a_result_s_wrench_in_the_tool_is_that_of_its_tractions(sensor, reconstructor, results):
    area = reconstructor.estimator.membrane.rest_area[:, None]
    got = results.wrench_in(sensor.tool)
    assert got.shape == (3, 6) and got.dtype == results.wrench.dtype and results.force.norm(dim=1).min() > 0.1
    for k in range(3):
        forces = TOOL.vectors((results.traction[k] * area).double())
        expected = wrench_of(forces.numpy(), TOOL.points(results.vertices[k].double()).numpy())
        np.testing.assert_allclose(got[k], expected, atol=2e-4 * np.abs(expected).max())
    assert torch.equal(results.wrench, torch.cat([results.force, results.wrench[:, 3:]], 1))  # stays the camera's


def test_a_camera_mounted_upside_down_gives_the_same_wrench_in_the_tool(sensor, results, small_images):
    """The same sensor and presses, described in the frame of a camera turned by 180 degrees about its axis."""
    half_turn, camera = np.diag([-1.0, -1.0, 1.0]), sensor.camera
    centre = (np.array(camera.image_size) - 1 - camera.centre.numpy()).tolist()
    turned = dataclasses.replace(
        sensor,
        camera=tm.Camera(camera.model, camera.image_size, camera.focal.tolist(), centre),
        markers=dataclasses.replace(sensor.markers, positions=sensor.markers.positions @ half_turn),
        tool=tm.Pose(TURN @ half_turn, SHIFT),
    )
    images = np.stack([np.rot90(np.asarray(Image.open(path).convert("L")), 2) for path in small_images])
    with torch.no_grad():
        found = tm.Reconstructor(turned)(images)
    assert found.status.tolist() == results.status.tolist() == [0, 0, 0]
    error = (found.wrench_in(turned.tool) - results.wrench_in(TOOL)).abs().amax(1)
    assert (error < 2e-2 * results.wrench_in(TOOL).abs().amax(1)).all()
    apart = (found.wrench - results.wrench).abs().amax(1)
    assert (apart > 0.1 * results.wrench.abs().amax(1)).all()  # in the cameras' frames


def test_no_tool_is_said(results, small_sensor):
    bare = tm.Sensor.from_file(small_sensor / "sensor.toml")
    with pytest.raises(tm.MembraneError, match=r"pose is None; expected a Pose: .*\[tool\]"):
        results.wrench_in(bare.tool)
    assert "tool" not in "\n".join(described(bare))


def test_a_tool_is_written_and_read_back(sensor, tmp_path):
    written = sensor.to_file(tmp_path)
    assert "[tool]\nrotation = [[" in written.read_text()
    again = tm.Sensor.from_file(written)
    assert np.array_equal(again.tool.rotation, TURN) and np.array_equal(again.tool.translation, SHIFT)
    assert again.fingerprint == sensor.fingerprint
    for other in (None, tm.Pose(TURN, SHIFT + [0, 0, 1]), tm.Pose(TURN.T, SHIFT)):
        assert dataclasses.replace(sensor, tool=other).fingerprint != sensor.fingerprint


@pytest.mark.parametrize(
    "lines, words",
    [
        ("rotation = [0, 0, 90]", "[tool] translation is missing; expected a list of 3 finite numbers"),
        ("translation = [0, 0, 90]", "[tool] rotation is missing; expected three rows of three finite numbers"),
        ("rotation = [0, 0]\ntranslation = [0, 0, 9]", "[tool] rotation = [0, 0]; expected three rows of three finite numbers"),
        ("rotation = [[1, 0, 0], [0, 1, 0], [0, 0, -1]]\ntranslation = [0, 0, 9]", "this one's is -1, a reflection"),
        ("rotation = [[2, 0, 0], [0, 1, 0], [0, 0, 1]]\ntranslation = [0, 0, 9]", "expected orthogonal rows of length one"),
        ("rotation = [0, 0, 90]\ntranslation = [0, 0, nan]", "[tool] translation = [0, 0, nan]; expected a list of 3 finite"),
        ("rotation = [0, 0, 90]\ntranslation = [0, 0, 9]\nangle = 3", "[tool] angle is unknown"),
    ],
)
def test_every_mistake_in_a_tool_is_named(small_sensor, tmp_path, lines, words):
    path = tm.Sensor.from_file(small_sensor / "sensor.toml").to_file(tmp_path)
    path.write_text(f"{path.read_text()}\n[tool]\n{lines}\n")
    with pytest.raises(tm.MembraneError) as caught:
        tm.Sensor.from_file(path)
    message = str(caught.value)
    assert str(path) in message and "[tool]" in message and words in message and "\n" not in message


def test_check_says_the_tool_in_words(sensor):
    turned = dataclasses.replace(sensor, tool=tm.Pose([0, 90, 0], [1.5, 0, 30]))
    (line,) = (line for line in described(turned) if line.startswith("tool"))
    assert line.endswith("at 1.5, 0, 30 mm in the tool's frame, looks along 1, 0, 0, its image's right is along 0, 0, -1")


@pytest.fixture
def mesh(reconstructor):
    return Mesh.from_reconstructor(reconstructor, Settings.from_reconstructor(reconstructor, "npz"))


def test_stored_results_know_the_tool(results, mesh, tmp_path):
    mesh.save(tmp_path / "mesh.npz")
    tool = Mesh.load(tmp_path / "mesh.npz").tool
    torch.testing.assert_close(results.wrench_in(tool), results.wrench_in(TOOL))
    np.testing.assert_allclose(tool.wrench(results.frame(0)["wrench"]), results.wrench_in(TOOL)[0], rtol=1e-5, atol=1e-5)


def test_folders_of_before_and_sensors_without_a_tool_have_none(sensor, mesh, tmp_path):
    arrays = mesh._asdict()
    del arrays["camera_in_tool"]
    np.savez(tmp_path / "mesh.npz", **arrays)
    old = Mesh.load(tmp_path / "mesh.npz")
    assert old.tool is None and old.settings == mesh.settings and old.sensor == mesh.sensor
    bare = tm.Reconstructor(dataclasses.replace(sensor, tool=None))
    Mesh.from_reconstructor(bare, Settings.from_reconstructor(bare, "npz")).save(tmp_path / "mesh.npz")
    assert Mesh.load(tmp_path / "mesh.npz").tool is None


def model_that_says(metadata: dict[str, str], path):
    """A model of nothing but what its metadata say of the sensor."""
    image = helper.make_tensor_value_info("image", TensorProto.FLOAT, ["batch", 1, 120, 160])
    out = helper.make_tensor_value_info("wrench", TensorProto.FLOAT, ["batch", 1, 120, 160])
    graph = helper.make_graph([helper.make_node("Identity", ["image"], ["wrench"])], "nothing", [image], [out])
    model = helper.make_model(graph, ir_version=8, opset_imports=[helper.make_opsetid("", 18)])
    helper.set_model_props(model, metadata)
    onnx.save(model, path)
    return path


def test_an_exported_model_knows_the_tool(reconstructor, results, tmp_path, monkeypatch, request):
    monkeypatch.syspath_prepend(request.config.rootpath / "export")
    from torchmembrane_edge import EdgeError, Session

    metadata = metadata_of(reconstructor)
    session = Session(model_that_says(metadata, tmp_path / "tool.onnx"))
    got = session.wrench_in_tool({"wrench": results.wrench.numpy()})
    assert got.dtype == np.float32
    np.testing.assert_allclose(got, results.wrench_in(TOOL), rtol=1e-5, atol=1e-5)
    mesh = json.loads(metadata["mesh"])
    bare = metadata | {"mesh": json.dumps(mesh | {"camera_in_tool": []})}
    before = metadata | {"mesh": json.dumps({key: value for key, value in mesh.items() if key != "camera_in_tool"})}
    for without in (bare, before):
        with pytest.raises(EdgeError, match=r"has no tool; expected a model of a sensor file with \[tool\]"):
            Session(model_that_says(without, tmp_path / "none.onnx")).wrench_in_tool({})


def test_a_folder_of_results_is_read_with_its_tool(small_sensor, small_images, tmp_path, capsys):
    from torchmembrane.cli.main import main

    path = dataclasses.replace(tm.Sensor.from_file(small_sensor / "sensor.toml"), tool=TOOL).to_file(tmp_path / "sensor")
    assert main(["reconstruct", str(path), str(small_images[2]), "--out", str(tmp_path / "out"), "--device", "cpu"]) == 0
    found = tm.read_results(tmp_path / "out")
    np.testing.assert_allclose(
        found.batch().wrench_in(found.mesh.tool)[0, :3], TURN @ found["press2"]["force"], rtol=1e-4, atol=1e-4
    )
