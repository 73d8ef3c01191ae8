"""URDF and MJCF hold the rest surface and the sensor's frames."""

from dataclasses import replace
from xml.etree import ElementTree

import numpy as np
import pytest
import trimesh

import torchmembrane as tm
from torchmembrane.integrations.robot_model import roll_pitch_yaw, write_robot_model
from torchmembrane.presets import NAMES

TOOL = tm.Pose(np.array([10.0, 70.0, -40.0]), np.array([1.5, 0.0, 30.0]))


@pytest.mark.parametrize("name", NAMES)
def test_meshes_are_closed_and_face_outwards(name, tmp_path):
    """The membrane's volume is that between rim and surface, by the divergence theorem positive for outward triangles."""
    sensor = tm.preset(name)
    write_robot_model(sensor, tmp_path)
    for mesh in ("membrane", "rim"):
        loaded = trimesh.load(tmp_path / f"{mesh}.stl")
        assert loaded.is_watertight and loaded.is_winding_consistent and loaded.volume > 0
    rest = sensor.membrane.rest.double().numpy() / 1000
    found = trimesh.load(tmp_path / "membrane.stl").vertices
    apart = np.linalg.norm(rest[:, None] - found[None], axis=-1)
    assert apart.min(1).max() < 1e-7 and (apart.min(0) > 1e-7).sum() == 1  # m; the middle of the lid


def test_frames_are_the_camera_s_on_the_tool(tmp_path):
    sensor = replace(tm.preset("fingertip"), tool=TOOL)
    write_robot_model(sensor, tmp_path)
    origin = ElementTree.parse(tmp_path / "fingertip.urdf").find("joint/origin")
    np.testing.assert_allclose(np.array(origin.get("xyz").split(), float), TOOL.translation / 1000)
    roll, pitch, yaw = np.array(origin.get("rpy").split(), float)
    np.testing.assert_allclose(turned(2, yaw) @ turned(1, pitch) @ turned(0, roll), TOOL.rotation, atol=1e-8)
    camera = ElementTree.parse(tmp_path / "fingertip.xml").find("worldbody/body/camera")
    x, y = np.array(camera.get("xyaxes").split(), float).reshape(2, 3)
    np.testing.assert_allclose(-np.cross(x, y), TOOL.rotation[:, 2], atol=1e-8)  # MuJoCo's camera looks along -z
    np.testing.assert_allclose(x, TOOL.rotation[:, 0], atol=1e-8)
    loaded = trimesh.load(tmp_path / "membrane.stl").vertices
    expected = TOOL.points(sensor.membrane.rest.double().numpy()) / 1000
    assert np.linalg.norm(expected[:, None] - loaded[None], axis=-1).min(1).max() < 1e-7


def test_the_camera_s_field_of_view_is_that_of_the_image_s_height(tmp_path):
    """A pinhole of that field of view has the sensor's focal length along v."""
    sensor = tm.preset("bubble")
    lens = tm.Camera("pinhole", (640, 360), (440.0, 410.0), (320.0, 180.0))
    write_robot_model(replace(sensor, camera=lens, markers=replace(sensor.markers, rest_image=None)), tmp_path)
    camera = ElementTree.parse(tmp_path / "bubble.xml").find("worldbody/body/camera")
    assert 180 / np.tan(np.radians(float(camera.get("fovy"))) / 2) == pytest.approx(410.0, rel=1e-4)
    assert camera.get("resolution") == "640 360"


def test_normals_in_the_meshes_are_those_of_their_triangles_by_the_right_hand(tmp_path):
    write_robot_model(tm.preset("bubble"), tmp_path)
    for mesh in ("membrane", "rim"):
        content = (tmp_path / f"{mesh}.stl").read_bytes()
        rows = np.frombuffer(content[84:], [("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
        a, b, c = rows["corners"].transpose(1, 0, 2).astype(float)
        normal = np.cross(b - a, c - a)
        np.testing.assert_allclose(rows["normal"], normal / np.linalg.norm(normal, axis=1, keepdims=True), atol=1e-4)


@pytest.mark.parametrize("pitch", [-np.pi / 2, -0.4, 0.0, 1.2, np.pi / 2])
def test_angles_give_their_rotation_back(pitch):
    rotation = turned(2, 0.7) @ turned(1, pitch) @ turned(0, -2.1)
    roll, found, yaw = roll_pitch_yaw(rotation)
    np.testing.assert_allclose(turned(2, yaw) @ turned(1, found) @ turned(0, roll), rotation, atol=1e-9)


def turned(axis, angle):
    a, b = (k for k in range(3) if k != axis)
    sign = -1 if axis == 1 else 1
    rotation = np.eye(3)
    rotation[a, a] = rotation[b, b] = np.cos(angle)
    rotation[a, b], rotation[b, a] = -sign * np.sin(angle), sign * np.sin(angle)
    return rotation


@pytest.mark.parametrize("name, stem", [("left/finger 2", "left_finger_2"), ("..", "sensor"), ("Finger-1.b", "Finger-1.b")])
def test_any_name_of_a_sensor_gives_files(tmp_path, name, stem):
    write_robot_model(replace(tm.preset("fingertip"), name=name), tmp_path / "robot")
    assert ElementTree.parse(tmp_path / "robot" / f"{stem}.urdf").getroot().get("name") == name
    assert {file.name for file in tmp_path.rglob("*.xml")} == {f"{stem}.xml"}
