"""The node of ROS 2 beside stand-ins of rclpy and its messages: it was not run in a live ROS 2."""

import sys
from dataclasses import replace
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path
from types import ModuleType, SimpleNamespace
from unittest.mock import MagicMock

import numpy as np
import pytest
from PIL import Image

import torchmembrane as tm
from torchmembrane.files.images import to_grey
from torchmembrane.sensor.parts import Cavity

NODE = Path(__file__).parents[1] / "ros/torchmembrane_ros/torchmembrane_ros/node.py"
PARAMETERS = {"compressed": False}


class Message(SimpleNamespace):
    FLOAT32 = 7


class FakeNode:
    """What the node asks of `rclpy.node.Node`; what is published is kept by topic."""

    def __init__(self, name):
        self.published, self.warnings = {}, []

    def declare_parameter(self, name, default):
        return SimpleNamespace(value=PARAMETERS.get(name, default))

    def create_publisher(self, kind, topic, depth):
        self.published[topic] = []
        return SimpleNamespace(publish=self.published[topic].append)

    def create_subscription(self, kind, topic, callback, quality):
        if topic == "image":
            self.callback, self.kind = callback, kind
        else:
            self.info_topic, self.info_callback = topic, callback

    def resolve_topic_name(self, topic):
        return f"/finger/{topic}"

    def create_service(self, kind, name, callback):
        self.service = callback

    def get_logger(self):
        return SimpleNamespace(warning=self.warnings.append)


@pytest.fixture
def node_of(monkeypatch):
    """The node of a sensor file."""
    types = "Vector3 Wrench WrenchStamped CameraInfo CompressedImage FluidPressure Image PointCloud2 PointField".split()
    messages = dict.fromkeys(types, Message)
    modules = {"rclpy": {}, "rclpy.node": {"Node": FakeNode}, "std_srvs": {}, "std_srvs.srv": {"Trigger": MagicMock()}}
    modules |= {"geometry_msgs": {}, "geometry_msgs.msg": messages, "sensor_msgs": {}, "sensor_msgs.msg": messages}
    modules["rclpy.qos"] = dict.fromkeys(("HistoryPolicy", "QoSProfile", "ReliabilityPolicy"), MagicMock())
    for name, content in modules.items():
        module = ModuleType(name)
        module.__dict__.update(content)
        monkeypatch.setitem(sys.modules, name, module)

    def made(path):
        monkeypatch.setitem(PARAMETERS, "sensor", str(path))
        spec = spec_from_file_location("node", NODE)
        module = module_from_spec(spec)
        spec.loader.exec_module(module)
        return module.TrackerNode()

    return made


@pytest.fixture
def node(node_of, small_sensor):
    return node_of(small_sensor / "sensor.toml")


def message(levels, header="header"):
    height, width = levels.shape
    return Message(
        encoding="mono8", height=height, width=width, step=width, is_bigendian=0, data=levels.tobytes(), header=header
    )


def test_an_image_s_messages_are_the_tracker_s_result(node, small_sensor, small_images):
    levels = np.asarray(Image.open(small_images[2]))
    node.callback(message(levels))
    frame = tm.Tracker(tm.Reconstructor.from_file(small_sensor / "sensor.toml"))(to_grey(levels)).frame(0)
    (wrench,), (cloud,) = node.published["wrench"], node.published["points"]
    assert wrench.header == cloud.header == "header" and node.published["pressure"] == []  # a liquid
    found = [getattr(wrench.wrench.force, axis) for axis in "xyz"]
    np.testing.assert_allclose(found, frame["force"], rtol=1e-6)
    points = np.frombuffer(cloud.data, "<f4").reshape(cloud.width, -1)
    np.testing.assert_allclose(points[:, :3], frame["vertices"] / 1000, rtol=1e-6)
    assert [field.name for field in cloud.fields] == "x y z normal_traction shear_x shear_y shear_z".split()


def test_of_a_gas_the_absolute_pressure_is_published(node_of, small_sensor, small_images, tmp_path):
    sensor = replace(tm.Sensor.from_file(small_sensor / "sensor.toml"), cavity=Cavity("gas", pressure=1013.0))
    node = node_of(sensor.to_file(tmp_path / "sensor.toml"))
    levels = np.asarray(Image.open(small_images[2]))
    node.callback(message(levels))
    change = tm.Tracker(tm.Reconstructor(sensor))(to_grey(levels)).pressure_change.item()
    (found,) = node.published["pressure"]
    assert change > 0 and found.header == "header"
    assert found.fluid_pressure == pytest.approx(101300 + 1e6 * change, rel=1e-9)  # Pa


def test_forces_that_are_relative_are_refused_at_the_start(node_of, small_sensor, tmp_path):
    full = tm.Sensor.from_file(small_sensor / "sensor.toml")
    sensor = replace(full, material=replace(full.material, shear_modulus=None, thickness=None))
    with pytest.raises(tm.MembraneError, match="forces of cap are relative, messages are in newtons"):
        node_of(sensor.to_file(tmp_path / "sensor.toml"))


def test_what_has_no_surface_is_logged_and_not_published(node, small_images):
    levels = np.asarray(Image.open(small_images[2]))
    node.callback(message(0 * levels))
    node.callback(message(levels[:-1]))
    assert node.published["wrench"] == [] and node.published["points"] == []
    assert len(node.warnings) == 2 and "119 px" in node.warnings[1]


def test_rezero_takes_the_latest_image(node, small_images):
    early = node.service(None, Message())
    assert not early.success and "no frame yet" in early.message
    levels = np.asarray(Image.open(small_images[0]))
    node.callback(message(levels))
    assert node.service(None, Message()).success
    node.callback(message(levels))
    wrench = node.published["wrench"][-1].wrench
    assert max(abs(getattr(wrench.force, axis)) for axis in "xyz") < 0.01


@pytest.mark.parametrize("binning", [0, 1, 2, 3])
def test_the_first_camera_info_is_compared_as_its_binning_says(node, small_sensor, binning):
    camera, b = tm.Sensor.from_file(small_sensor / "sensor.toml").camera, max(binning, 1)
    (width, height), (f, g), (u, v) = camera.image_size, camera.focal.tolist(), camera.centre.tolist()
    chip = {"width": b * width, "height": b * height, "distortion_model": "plumb_bob", "d": []}
    k = [b * f, 0, b * u + (b - 1) / 2, 0, b * g, b * v + (b - 1) / 2, 0, 0, 1]
    roi = Message(x_offset=0, y_offset=0, width=0, height=0, do_rectify=False)
    info = Message(**chip, k=k, binning_x=binning, binning_y=binning, roi=roi)
    assert node.info_topic == "/finger/camera_info"
    node.info_callback(info)
    assert node.warnings == []
    node.compared, info.k = False, [*k[:2], k[2] + 3 * b, *k[3:]]
    for _ in range(2):
        node.info_callback(info)
    (said,) = node.warnings
    assert "3.0 px off" in said


def test_a_camera_info_of_another_size_is_logged(node):
    roi = Message(x_offset=0, y_offset=0, width=0, height=0, do_rectify=False)
    info = Message(width=640, height=480, distortion_model="plumb_bob", d=[], k=[0.0] * 9, binning_x=1, binning_y=1, roi=roi)
    node.info_callback(info)
    assert "CameraInfo is of 640 x 480 px images, the sensor file of 160 x 120" in node.warnings[0]


@pytest.mark.parametrize("encoding", ["yuv422_yuy2", "yuv422", "nv12"])
def test_images_of_usb_cameras_are_followed(node, small_sensor, small_images, encoding):
    levels = np.asarray(Image.open(small_images[2]))
    grey = np.full_like(levels, 128)
    packed = {"yuv422_yuy2": np.stack([levels, grey], -1), "yuv422": np.stack([grey, levels], -1)}
    content = packed.get(encoding, np.concatenate([levels, grey[: len(grey) // 2]]))
    sent = message(levels)
    sent.encoding, sent.data = encoding, content.tobytes()
    sent.step = levels.shape[1] * (2 if encoding in packed else 1)
    node.callback(sent)
    node.callback(message(levels))
    first, second = (each.wrench.force.z for each in node.published["wrench"])
    assert first == pytest.approx(second, abs=1e-4) and node.warnings == []
