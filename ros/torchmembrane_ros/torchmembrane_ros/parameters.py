"""Parameters of the node, which are set at its start and do not change while it runs."""

from rcl_interfaces.msg import IntegerRange, ParameterDescriptor
from rclpy.node import Node

import torchmembrane as tm

RELIABILITIES = ("auto", "reliable", "best_effort")
PARAMETERS = {
    "sensor": ("sensor.toml", "Path of the sensor file."),
    "compressed": (False, "Whether image is a CompressedImage."),
    "reliability": ("auto", "Of the subscription to image: auto (reliable where all publishers are), reliable or best_effort."),
    "depth": (5, "Images that are kept for the node; of those that wait it takes the newest."),
    "frame_id": ("", "Frame of what is published; empty: the image's."),
    "tool_frame": (
        "",
        "Frame of the tool: [tool] of the sensor file is sent to /tf_static, from here to frame_id; empty: nothing.",
    ),
    "autostart": (True, "Whether the node configures and activates itself; else a lifecycle manager does."),
}
"""Default and description of each parameter."""
MOST_IMAGES = 1000
"""Largest value of `depth`."""


def declare(node: Node) -> None:
    """Declare the parameters, all read-only, with their descriptions and ranges."""
    for name, (default, description) in PARAMETERS.items():
        span = [IntegerRange(from_value=1, to_value=MOST_IMAGES, step=1)] if name == "depth" else []
        descriptor = ParameterDescriptor(description=description, read_only=True, integer_range=span)
        node.declare_parameter(name, default, descriptor)


def refuse_wrong(node: Node) -> None:
    """Refuse values that types and ranges do not exclude.

    Raises:
        MembraneError: `reliability` is not one of its choices, or `tool_frame` is given without `frame_id`.
    """
    reliability, tool_frame, frame_id = (node.get_parameter(name).value for name in ("reliability", "tool_frame", "frame_id"))
    if reliability not in RELIABILITIES:
        raise tm.MembraneError(f"parameter reliability: {reliability}; expected one of {', '.join(RELIABILITIES)}")
    if tool_frame and not frame_id:
        raise tm.MembraneError(f"parameter tool_frame: {tool_frame} without frame_id; expected both, one frame in the other")
