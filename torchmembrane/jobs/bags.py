"""ROS bags as inputs of a job: checks of their CameraInfo messages, and a bag of the results."""

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from ..camera.model import Camera
from ..errors import MembraneError
from ..files.folder_lock import WHOLE, Shard
from ..integrations.frame_messages import SiUnits
from ..integrations.rosbag import BagWriter, StampedMessage, camera_remark, image_topic, is_mcap, messages
from ..results.read import read_results
from ..results.store import Mesh
from .inputs import Inputs, picture_name
from .moments import TimedPicture, moments

if TYPE_CHECKING:
    from ..reconstruct import Reconstructor


def bag_remarks(inputs: Inputs, cameras: Sequence[Camera]) -> Iterator[str]:
    """Yield the differences between the CameraInfo messages of the bags and the sensor file, in words.

    Args:
        inputs: inputs of the job.
        cameras: cameras of the image topics.

    Raises:
        MembraneError: a bag cannot be read, has several candidate topics, or holds images of another size.
    """
    for path in inputs.bags:
        for topic, camera in zip(inputs.image_topics, cameras, strict=True):
            if remark := camera_remark(path, image_topic(path, topic)[0], camera):
                yield f"{path}: {remark}"


def result_bag(path: Path, inputs: Inputs, mesh: Mesh, reconstructor: "Reconstructor", shard: Shard) -> BagWriter:
    """Return the writer of the bag that will receive the results.

    Raises:
        MembraneError: none of the inputs is a bag, only a shard of the frames is reconstructed, the estimator finds no forces
            or only relative ones, or the path holds something else.
    """
    if shard != WHOLE:
        raise MembraneError(
            "--bag with --shard: leave --bag out; when all shards are done, run the command once more with --bag and "
            "without --shard"
        )
    if not inputs.bags:
        raise MembraneError(f"--bag {path}: none of the inputs is a bag; expected one, because the results take its times")
    if not reconstructor.finds_tractions:
        raise MembraneError(f"--bag {path}: the estimator {mesh.estimator} finds no forces; expected --estimator force-balance")
    return BagWriter(path, SiUnits(mesh, reconstructor.sensor.gas_pressure), is_mcap(inputs.bags[0]))


def write_bag(writer: BagWriter, inputs: Inputs, results: Path) -> int:
    """Write messages for all bag frames that have results in a folder; return the number of frames with a wrench.

    All results are in the frame of the first view's camera, also those of moments at which this view has no picture.
    """
    found = read_results(results)
    names = set(found.names)
    with writer:
        for path in inputs.bags:
            topics = [image_topic(path, topic)[0] for topic in inputs.image_topics]
            of_first = next(messages(path, topics[0]), None)
            for number, moment in enumerate(moments([_timed(messages(path, topic)) for topic in topics])):
                of_first = of_first if moment[0] is None else moment[0].picture
                name = picture_name(path, number)
                if name in names:
                    frame_id = "" if of_first is None else of_first.message.header.frame_id
                    writer.add(next(each.picture for each in moment if each is not None), found[name], frame_id)
    return writer.written


def _timed(found: Iterator[StampedMessage]) -> Iterator[TimedPicture[StampedMessage]]:
    return (TimedPicture(each.time, each) for each in found)
