"""Conversion of the package's messages to rclpy messages."""

from array import array
from importlib import import_module
from typing import Any

import numpy as np
from geometry_msgs.msg import Quaternion, Transform, TransformStamped, Vector3

import torchmembrane as tm
from torchmembrane.sensor.units import METRE


def type_of(kind: str) -> Any:
    """Return the class of a message type such as "geometry_msgs/msg/Wrench"."""
    package, _, name = kind.split("/")
    return getattr(import_module(f"{package}.msg"), name)


def make(kind: str, **fields: Any) -> Any:
    """Return an rclpy message of a type, with its fields."""
    if "level" in fields:
        fields["level"] = bytes([fields["level"]])
    if "data" in fields:
        fields["data"] = array("B", fields["data"].tobytes())  # bytes would be checked one by one
    return type_of(kind)(**fields)


def transform_of(sensor: tm.Sensor, tool_frame: str, frame_id: str) -> TransformStamped:
    """Return the pose of the camera in the frame of the tool, in metres, as a TF message.

    Raises:
        MembraneError: the sensor file has no `[tool]`.
    """
    if sensor.tool is None:
        raise tm.MembraneError(f"parameter tool_frame: {tool_frame}; the sensor file has no [tool], the camera's pose on it")
    x, y, z = (sensor.tool.translation / METRE[sensor.length_unit]).tolist()
    turned = Quaternion(**dict(zip("xyzw", quaternion(sensor.tool.rotation).tolist(), strict=True)))
    made = TransformStamped(child_frame_id=frame_id, transform=Transform(translation=Vector3(x=x, y=y, z=z), rotation=turned))
    made.header.frame_id = tool_frame
    return made


def quaternion(rotation: np.ndarray) -> np.ndarray:
    """Return the quaternion x, y, z, w of a rotation `[3, 3]`: the eigenvector of a symmetric matrix's largest eigenvalue
    (Bar-Itzhack, 2000)."""
    (a, b, c), (d, e, f), (g, h, i) = rotation
    symmetric = np.array([
        [a - e - i, d + b, g + c, h - f],
        [d + b, e - a - i, h + f, c - g],
        [g + c, h + f, i - a - e, d - b],
        [h - f, c - g, d - b, a + e + i],
    ])  # fmt: skip
    return np.linalg.eigh(symmetric)[1][:, -1]
