"""ROS 2 bags (rosbag2: MCAP and sqlite3) through the package rosbags: images are read; wrenches, tractions, pressures
written."""

import os
import sqlite3
from collections import Counter
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from os import SEEK_END
from pathlib import Path
from types import TracebackType
from typing import Any, NamedTuple

from ..camera.model import Camera
from ..errors import MembraneError
from ..files.atomic import ROOM, make_folder, writing
from ..files.optional import load_rosbags
from ..files.safe_read import in_one_line, read_text, regular_size
from ..interruption import unfinished
from ..results.reconstruction import Frame
from .bounded_rosbags import bounded_rosbags, refuse_large
from .frame_messages import Message, SiUnits, has_wrench
from .messages import camera_mismatch, info_topic, size_of

BAGS, ROS_1, METADATA = (".mcap", ".db3"), ".bag", "metadata.yaml"
MOST_METADATA_BYTES = 2**20
MOST_BYTES = 2**50
"""Largest size in bytes of a storage file, which is never read as a whole."""
MCAP_MARK, SQLITE_MARK, ROS_1_MARK = b"\x89MCAP0\r\n", b"SQLite format 3\0", b"#ROSBAG"
"""The first bytes of storage files; an MCAP file also ends with them."""
IMAGE_TYPES = ("sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage")
INFO_TYPE = "sensor_msgs/msg/CameraInfo"
NAMESPACE = "/torchmembrane"
"""Namespace of the written topics, like that of a node of this name."""
OURS = "torchmembrane reconstruct --bag"
"""Mark in the metadata of the bags that this module writes."""


class StampedMessage(NamedTuple):
    """A message, and the time of its reception, ns."""

    received: int
    message: Any

    @property
    def time(self) -> float:
        """Time in the message's header, seconds since 1970, or the time of reception if that is empty."""
        stamp = self.message.header.stamp
        return float(stamp.sec + 1e-9 * stamp.nanosec) or 1e-9 * self.received


def is_bag(path: Path) -> bool:
    """Return whether a path is a bag's `metadata.yaml`, which stands for its folder, or a storage file, even one of ROS 1."""
    return path.name == METADATA or path.suffix.lower() in (*BAGS, ROS_1)


def metadata_of(folder: Path) -> list[Path]:
    """Return the `metadata.yaml` of a bag's folder; an empty list for any other folder."""
    return [path for path in (folder / METADATA,) if path.is_file()]


def _metadata(path: Path) -> str:
    return read_text(path, MOST_METADATA_BYTES, f"a bag's {METADATA}")


def is_mcap(bag: Path) -> bool:
    """Return whether a bag is stored as MCAP rather than sqlite3."""
    stored = bag.parent.iterdir() if bag.name == METADATA else [bag]
    return any(".mcap" in path.suffixes for path in stored)


def image_topic(bag: Path, topic: str | None) -> tuple[str, int]:
    """Return the image topic of a bag, and its number of images.

    Args:
        bag: path of its `metadata.yaml`, or of a storage file.
        topic: the topic to use; None: the only one.

    Raises:
        MembraneError: there is no image topic, or there are several and none is named; or the bag cannot be read.
    """
    with _opened(bag) as reader:
        topics, others = Counter[str](), set[str]()
        for each in reader.connections:
            if each.msgtype in IMAGE_TYPES:
                topics[each.topic] += each.msgcount
            else:
                others.add(each.topic)
    if not topics:
        raise MembraneError(f"{bag}: no topic of images; its topics: {', '.join(sorted(others)) or 'none'}")
    named = ", ".join(sorted(topics))
    if topic is None and len(topics) != 1:
        raise MembraneError(f"{bag}: image topics: {named}; expected one: name it by --topic")
    found = topic or next(iter(topics))
    if found not in topics:
        raise MembraneError(f"{bag}: no images on topic {found}; image topics: {named}")
    return found, topics[found]


def messages(bag: Path, topic: str, kinds: tuple[str, ...] = IMAGE_TYPES) -> Iterator[StampedMessage]:
    """Yield the messages of a topic that have one of these types, in the order of their reception.

    Raises:
        MembraneError: the bag cannot be read, or not to its end.
    """
    with _opened(bag) as reader:
        connections = [each for each in reader.connections if each.topic == topic and each.msgtype in kinds]
        for connection, received, content in reader.messages(connections=connections) if connections else ():
            yield StampedMessage(received, reader.deserialize(content, connection.msgtype))


def camera_remark(bag: Path, topic: str, camera: Camera) -> str | None:
    """Return in words how the CameraInfo beside an image topic differs from the sensor file; None if it does not.

    Raises:
        MembraneError: the CameraInfo and the images have another size than the sensor file.
    """
    first = next(messages(bag, info_topic(topic), (INFO_TYPE,)), None)
    try:
        return None if first is None else camera_mismatch(first.message, camera)
    except MembraneError as error:
        image = next(messages(bag, topic), None)
        if image is not None and size_of(image.message) == camera.image_size:
            return f"{error}; the images are of the file's size, and CameraInfo is not compared"
        raise MembraneError(f"{bag}, {info_topic(topic)}: {error}") from error


class BagWriter:
    """A bag of results: `with BagWriter("out", units, mcap=True) as bag`, then `bag.add(image, frame, frame_id)`.

    Every frame adds its messages on `TOPICS` in `NAMESPACE`, with the time stamp and the time of reception of its image.

    Args:
        path: path of the folder: new, or that of an earlier bag of results, which is replaced when the new one is complete.
        units: units of the results.
        mcap: whether to store as MCAP; otherwise as sqlite3.

    Raises:
        MembraneError: the path holds something else, or rosbags is not installed.
    """

    def __init__(self, path: str | Path, units: SiUnits, mcap: bool):
        self.path, self.units, self.mcap = Path(path), units, mcap
        self.written = 0
        if os.path.lexists(self.path) and not _is_ours(self.path):
            raise MembraneError(f"{path}: exists already, and is not a bag of results alone; expected a new folder")
        load_rosbags()

    def __enter__(self) -> "BagWriter":
        from rosbags.rosbag2 import StoragePlugin, Writer
        from rosbags.typesys import Stores, get_typestore

        self._store = get_typestore(Stores.ROS2_JAZZY)
        plugin = StoragePlugin.MCAP if self.mcap else StoragePlugin.SQLITE3
        self._folder = make_folder(self.path.parent) / f".bag-{os.getpid()}"
        self._ending = ExitStack()
        self._ending.enter_context(unfinished(self._folder))
        with writing(self.path, self._folder):
            self._folder.mkdir()
        self._writer = Writer(self._folder / self.path.name, version=9, storage_plugin=plugin)
        self._writer.set_custom_data("made by", OURS)
        self._writer.open()
        self._connections: dict[str, Any] = {}
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None) -> None:
        with self._ending, _writing_bag(self.path):
            self._writer.close()
            if kind is None:
                if self.path.exists():
                    self.path.rename(self._folder / ".before")
                self._writer.path.rename(self.path)

    def add(self, image: StampedMessage, frame: Frame, frame_id: str) -> None:
        """Write a frame's messages; `written` counts the frames that have a wrench.

        Args:
            image: message of the image from which the frame was reconstructed.
            frame: result of the frame.
            frame_id: coordinate frame of the results, that of the first view's camera.
        """
        given = image.message.header.stamp
        with _writing_bag(self.path):
            stamp = self._new("builtin_interfaces/msg/Time", sec=given.sec, nanosec=given.nanosec)
            header = self._new("std_msgs/msg/Header", stamp=stamp, frame_id=frame_id)
            for topic, message in self.units.messages(frame).items():
                self._write(topic, image.received, message._replace(fields={"header": header, **message.fields}))
        self.written += has_wrench(frame)

    def _write(self, topic: str, received: int, message: Message) -> None:
        if topic not in self._connections:
            connection = self._writer.add_connection(f"{NAMESPACE}/{topic}", message.kind, typestore=self._store)
            self._connections[topic] = connection
        content = self._store.serialize_cdr(message.built(self._new), message.kind)
        self._writer.write(self._connections[topic], received, content)

    def _new(self, kind: str, **fields: Any) -> Any:
        return self._store.types[kind](**fields)


def _is_ours(path: Path) -> bool:
    """Return whether a path is a bag of results whose folder holds nothing else."""
    if path.is_symlink() or not any(OURS in _metadata(found) for found in metadata_of(path)):
        return False
    return all(found.name == METADATA or found.suffix in BAGS for found in path.iterdir())


@contextmanager
def _writing_bag(path: Path) -> Iterator[None]:
    """Turn file system errors in the block into errors that name the bag."""
    with writing(path):
        try:
            yield
        except sqlite3.OperationalError as error:
            raise MembraneError(f"{path}: not written ({error}); expected {ROOM}") from error


@contextmanager
def _opened(bag: Path) -> Iterator[Any]:
    """Yield a reader of a bag."""
    if bag.suffix.lower() == ROS_1:
        raise MembraneError(f"{bag}: {_of_ros_1(bag)}")
    if bag.name == METADATA:
        _metadata(bag)
    else:
        regular_size(bag, MOST_BYTES, "a bag of ROS 2")
    highlevel, path = bounded_rosbags(), bag.parent if bag.name == METADATA else bag
    from rosbags.typesys import Stores, get_typestore

    try:
        with highlevel.AnyReader([path], default_typestore=get_typestore(Stores.ROS2_JAZZY)) as reader:
            refuse_large(reader)
            yield reader
    except MembraneError:
        raise
    except Exception as error:  # of a damaged file, of whatever kind
        cause = _damage(bag) or f"({in_one_line(error)})"
        raise MembraneError(f"{bag}: not readable as a bag of ROS 2 {cause}") from error


def _damage(bag: Path) -> str | None:
    """Return what is wrong with a bag's files and the remedy, if their first and last bytes reveal it."""
    files = [each for each in bag.parent.iterdir() if each.suffix in BAGS and each.is_file()] if bag.name == METADATA else [bag]
    for path in files:
        with open(path, "rb") as file:
            begin, size = file.read(32), file.seek(0, SEEK_END)
            file.seek(max(0, size - len(MCAP_MARK)))
            end = file.read()
        pages = int.from_bytes(begin[28:32], "big") * int.from_bytes(begin[16:18], "big")
        early = f"({path.name} ends early, as of a recording or a copy that was cut off)"
        if not begin:
            return f"({path.name} is empty): was it recorded, or copied, to its end?"
        if begin.startswith(ROS_1_MARK):
            return f"({path.name}): {_of_ros_1(path)}"
        if begin.startswith(MCAP_MARK) and end != MCAP_MARK:
            return f"{early}: `mcap recover {path.name} -o whole.mcap` keeps what is in it; give whole.mcap"
        if begin.startswith(SQLITE_MARK) and size < pages:
            return f"{early}: `sqlite3 {path.name} .recover | sqlite3 whole.db3` keeps what is in it; give whole.db3"
    return None


def _of_ros_1(path: Path) -> str:
    return f"a bag of ROS 1; expected one of ROS 2: `rosbags-convert --src {path.name} --dst {path.stem}`, then give the folder"
