"""The node of ROS 2 beside stand-ins of rclpy and its messages: it was not run in a live ROS 2."""

import sys
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path
from types import ModuleType, SimpleNamespace
from unittest.mock import MagicMock

import numpy as np
import pytest
from PIL import Image

import torchmembrane as tm
from torchmembrane.io.images import to_grey

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
        self.callback, self.kind = callback, kind

    def create_service(self, kind, name, callback):
        self.service = callback

    def get_logger(self):
        return SimpleNamespace(warning=self.warnings.append)


@pytest.fixture
def node(small_sensor, monkeypatch):
    types = "Vector3 Wrench WrenchStamped CompressedImage FluidPressure Image PointCloud2 PointField".split()
    messages = dict.fromkeys(types, Message)
    modules = {"rclpy": {}, "rclpy.node": {"Node": FakeNode}, "std_srvs": {}, "std_srvs.srv": {"Trigger": MagicMock()}}
    modules |= {"geometry_msgs": {}, "geometry_msgs.msg": messages, "sensor_msgs": {}, "sensor_msgs.msg": messages}
    modules["rclpy.qos"] = dict.fromkeys(("HistoryPolicy", "QoSProfile", "ReliabilityPolicy"), MagicMock())
    for name, content in modules.items():
        module = ModuleType(name)
        module.__dict__.update(content)
        monkeypatch.setitem(sys.modules, name, module)
    monkeypatch.setitem(PARAMETERS, "sensor", str(small_sensor / "sensor.toml"))
    spec = spec_from_file_location("node", NODE)
    module = module_from_spec(spec)
    spec.loader.exec_module(module)
    return module.TrackerNode()


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
