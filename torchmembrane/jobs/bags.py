"""Bags among the inputs of a job: what their cameras say, and a bag of the results."""

from collections.abc import Iterator
from pathlib import Path

from ..camera.model import Camera
from ..errors import MembraneError
from ..integrations.messages import SiUnits, has_wrench
from ..integrations.rosbag import BagWriter, camera_remark, image_topic, messages
from ..io.read import read_results
from ..io.store import Mesh
from ..sensor.sensor import Sensor
from .inputs import Inputs, picture_name


def bag_remarks(inputs: Inputs, camera: Camera) -> Iterator[str]:
    """What the bags' CameraInfos say otherwise than the sensor file.

    Raises:
        MembraneError: a bag cannot be read, it is not clear which of its topics is meant, or it is of images of another size.
    """
    for path in inputs.bags:
        if remark := camera_remark(path, image_topic(path, inputs.topic)[0], camera):
            yield f"{path}: {remark}"


def result_bag(path: Path, inputs: Inputs, mesh: Mesh, sensor: Sensor) -> BagWriter:
    """Where the results of bags will be written to.

    Raises:
        MembraneError: none of the inputs is a bag, forces are relative, or there is something at the path already.
    """
    if not inputs.bags:
        raise MembraneError(f"--bag {path}: none of the inputs is a bag, whose messages' times the results' would have")
    return BagWriter(path, SiUnits(mesh, sensor.gas_pressure), inputs.bags[0].suffix.lower() == ".mcap")


def write_bag(writer: BagWriter, inputs: Inputs, results: Path) -> int:
    """Write messages of all frames of the bags that have a surface in a folder of results; returns their number."""
    found = read_results(results)
    names = set(found.names)
    with writer:
        for path in inputs.bags:
            topic, _ = image_topic(path, inputs.topic)
            for number, image in enumerate(messages(path, topic)):
                name = picture_name(path, number)
                if name in names and has_wrench(frame := found[name]):
                    writer.add(image, frame)
    return writer.written
