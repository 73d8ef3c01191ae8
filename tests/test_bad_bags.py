"""Damaged or hostile bags are refused in one line, in little memory."""

import os
import re
import resource
import sqlite3
import struct
import time
from importlib import import_module
from pathlib import Path

import numpy as np
import pytest

from torchmembrane.errors import MembraneError
from torchmembrane.integrations import bounded_rosbags
from torchmembrane.integrations.rosbag import image_topic, messages
from torchmembrane.jobs.inputs import find_inputs

pytest.importorskip("rosbags")
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer  # noqa: E402
from rosbags.typesys import Stores, get_typestore  # noqa: E402

STORE, TOPIC, IMAGE = get_typestore(Stores.ROS2_HUMBLE), "/finger/image_raw", "sensor_msgs/msg/Image"
MAGIC = b"\x89MCAP0\r\n"


def image(levels):
    stamp = STORE.types["builtin_interfaces/msg/Time"](0, 0)
    height, width = levels.shape
    header = STORE.types["std_msgs/msg/Header"](stamp, "finger")
    return STORE.types[IMAGE](header, height, width, "mono8", 0, width, levels.ravel())


def write_bag(path, plugin=StoragePlugin.MCAP, topics=((TOPIC, IMAGE),), frames=3, mode=None, size=40):
    """A bag of images of noise; on topics of other types nothing is written."""
    writer, rng = Writer(path, version=8, storage_plugin=plugin), np.random.default_rng(0)
    if mode is not None:
        writer.set_compression(mode, CompressionFormat.ZSTD)
    with writer:
        for topic, kind in topics:
            connection = writer.add_connection(topic, kind, typestore=STORE)
            for k in range(frames if kind == IMAGE else 0):
                levels = rng.integers(0, 256, (size, size), np.uint8)
                writer.write(connection, 10**18 + k, STORE.serialize_cdr(image(levels), IMAGE))
    return path / "metadata.yaml"


def storage_of(bag):
    (found,) = (path for path in bag.parent.iterdir() if path.name != bag.name)
    return found


def refusal(bag, topic=None):
    """The one line that a bag is refused with, in little time and memory."""
    start, before = time.perf_counter(), resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with pytest.raises(MembraneError) as caught:
        for _ in messages(bag, image_topic(bag, topic)[0]):
            pass
    taken, more = time.perf_counter() - start, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before
    assert str(caught.value).startswith(str(bag)) and str(caught.value).isprintable()
    assert taken < 20 and more < 700_000  # s, kB
    return str(caught.value)


@pytest.mark.parametrize(
    "name, content", [("run.bag", b"#ROSBAG V2.0\n" + bytes(4096)), ("run.mcap", b"#ROSBAG V2.0\n" + bytes(99))]
)
def test_a_bag_of_ros_1_is_said_to_be_one(tmp_path, name, content):
    (tmp_path / name).write_bytes(content)
    assert find_inputs([tmp_path / name]).bags == [tmp_path / name]
    said = refusal(tmp_path / name)
    assert "a bag of ROS 1; expected one of ROS 2" in said and f"rosbags-convert --src {name} --dst run" in said


CUT = {"half": lambda size: size // 2, "all but a byte": lambda size: size - 1, "the beginning": lambda size: 5000}


@pytest.mark.parametrize(
    "plugin, remedy", [(StoragePlugin.MCAP, "mcap recover {} -o whole.mcap"), (StoragePlugin.SQLITE3, "sqlite3 {} .recover")]
)
@pytest.mark.parametrize("cut", CUT)
def test_a_bag_that_was_cut_off_is_refused_with_the_remedy(tmp_path, plugin, remedy, cut):
    bag = write_bag(tmp_path / "run", plugin, size=120)
    storage = storage_of(bag)
    whole = storage.read_bytes()
    for path in (bag, tmp_path / storage.name):  # the folder, and the file alone
        (storage if path is bag else path).write_bytes(whole[: CUT[cut](len(whole))])
        said = refusal(path)
        assert f"{storage.name} ends early" in said and remedy.format(storage.name) in said


@pytest.mark.parametrize(
    "name, content, said",
    [
        ("a.mcap", b"", "a.mcap is empty"),
        ("a.db3", b"", "a.db3 is empty"),
        ("a.mcap", b"no bag" * 20, "not readable as a bag of ROS 2 .File magic is invalid"),
        ("a.db3", b"no bag" * 2000, "not readable as a bag of ROS 2"),
        ("a.mcap", MAGIC + bytes(60) + MAGIC, "not readable as a bag of ROS 2"),
    ],
)
def test_files_that_are_no_bags_are_refused(tmp_path, name, content, said):
    (tmp_path / name).write_bytes(content)
    assert re.search(said, refusal(tmp_path / name))


def test_a_pipe_is_not_waited_for(tmp_path):
    os.mkfifo(tmp_path / "run.mcap")
    assert "it is a pipe" in refusal(tmp_path / "run.mcap")


def test_topics_are_listed_where_the_one_that_is_meant_is_not_known(tmp_path):
    info, tf = "sensor_msgs/msg/CameraInfo", "tf2_msgs/msg/TFMessage"
    none = write_bag(tmp_path / "none", topics=(("/tf", tf), ("/finger/camera_info", info)))
    assert "no topic of images; its topics: /finger/camera_info, /tf" in refusal(none)
    assert "no topic of images; its topics: /finger/camera_info, /tf" in refusal(none, "/finger/image_raw")
    assert "no topic of images; its topics: none" in refusal(write_bag(tmp_path / "bare", topics=()))
    two = write_bag(tmp_path / "two", topics=(("/b/image", IMAGE), ("/a/image", IMAGE), ("/tf", tf)))
    assert "image topics: /a/image, /b/image; expected one: name it by --topic" in refusal(two)
    assert "no images on topic /tf; image topics: /a/image, /b/image" in refusal(two, "/tf")
    assert image_topic(two, "/b/image") == ("/b/image", 3)
    assert image_topic(write_bag(tmp_path / "empty", frames=0), None) == (TOPIC, 0)


def test_a_bag_without_its_metadata_is_told_how_to_get_them(tmp_path):
    bag = write_bag(tmp_path / "run")
    bag.unlink()
    with pytest.raises(MembraneError, match="`ros2 bag reindex run` makes: or give its files"):
        find_inputs([tmp_path / "run"])
    assert image_topic(storage_of(bag), None) == (TOPIC, 3)


def record(code, content):
    return struct.pack("<BQ", code, len(content)) + content


def text(value):
    return struct.pack("<I", len(value)) + value


def chunk(size, packing, packed):
    return record(6, struct.pack("<QQQI", 0, 1, size, 0) + text(packing) + struct.pack("<Q", len(packed)) + packed)


def mcap(*records, summary=b""):
    """A file of MCAP with these records; without a summary it is read through to find what it holds."""
    body = MAGIC + record(1, text(b"ros2") + text(b"")) + b"".join(records) + record(15, bytes(4))
    return body + summary + record(2, struct.pack("<QQI", len(body) if summary else 0, 0, 0)) + MAGIC


def index(size, packing, packed):
    return record(
        8,
        struct.pack("<QQQQ", 0, 1, 40, 100)
        + text(b"")
        + struct.pack("<Q", 0)
        + text(packing)
        + struct.pack("<QQ", packed, size),
    )


def packers():
    zstd = import_module("rosbags.rosbag2.storage_mcap").zstd
    return {b"zstd": zstd.compress, b"lz4": import_module("lz4.frame").compress}


@pytest.mark.parametrize("packing", [b"zstd", b"lz4"])
def test_chunks_are_not_unpacked_beyond_what_is_read(tmp_path, packing):
    """One that says how large it is, one that lies, and many small ones."""
    packed, half = packers()[packing](bytes(2**29)), packers()[packing](bytes(2**20))
    path = tmp_path / "bomb.mcap"
    for content, said in (
        (
            mcap(chunk(2**29, packing, packed)),
            "a chunk unpacks to 536870912 bytes; at most 268435456 are read: record smaller",
        ),
        (mcap(chunk(100, packing, packed)), "unpacks to more than 100 bytes"),
        (mcap(chunk(2**40, packing, half)), "a chunk unpacks to 1099511627776 bytes"),
        (
            mcap(summary=index(2**28, packing, 999) * 500),
            "bytes unpack to 134217728000 or more; at most 256 times as many are read",
        ),
    ):
        path.write_bytes(content)
        assert said in refusal(path)


def test_a_compressed_file_is_not_unpacked_beyond_what_is_read(tmp_path, monkeypatch):
    monkeypatch.setattr(bounded_rosbags, "MOST_CHUNK_BYTES", 2**20)
    bag = write_bag(tmp_path / "run", mode=CompressionMode.FILE, size=900)
    assert image_topic(bag, None) == (TOPIC, 3)  # noise, of its own size
    storage_of(bag).write_bytes(packers()[b"zstd"](bytes(2**24)))
    assert "at most 256 times as many are read" in refusal(bag)


def test_a_compressed_message_is_not_unpacked_beyond_what_is_read(tmp_path):
    bag = write_bag(tmp_path / "run", StoragePlugin.SQLITE3, mode=CompressionMode.MESSAGE)
    with sqlite3.connect(storage_of(bag)) as connection:
        connection.execute("UPDATE messages SET data = ?", [packers()[b"zstd"](bytes(2**28 + 1))])
    connection.close()
    assert "a chunk or message unpacks to more than 268435456 bytes" in refusal(bag)


YAML = {
    "many values": lambda: "x: [" + "1, " * 300_000 + "1]",
    "many lines": lambda: "".join(f"k{k}: 1\n" for k in range(80_000)),
    "deep lists": lambda: "x: " + "[" * 100_000,
    "references": lambda: (
        "a0: &a0 {k: 1}\n" + "".join(f"a{k}: &a{k} {{<<: [{', '.join([f'*a{k - 1}'] * 9)}]}}\n" for k in range(1, 12))
    ),
    "too large": lambda: "# " + "x" * 2**20,
    "no YAML": lambda: "a: b: c: {",
    "no UTF-8": lambda: "\udcff",
    "no metadata": lambda: "a: 1",
    "nothing": lambda: "",
}


@pytest.mark.parametrize("kind", YAML)
def test_metadata_are_bounded_before_they_are_read(tmp_path, kind, monkeypatch):
    monkeypatch.setattr(bounded_rosbags, "MOST_EVENTS", 2**13)  # quicker
    bag = write_bag(tmp_path / "run")
    bag.write_bytes(YAML[kind]().encode("utf-8", "surrogateescape"))
    said = refusal(bag)
    assert "not readable as a bag of ROS 2" in said or "expected a bag's metadata.yaml" in said


def test_a_recording_of_many_topics_and_files_is_within_the_bounds(tmp_path):
    bag = write_bag(tmp_path / "run", topics=[(TOPIC, IMAGE), *((f"/t{k}", "std_msgs/msg/String") for k in range(100))])
    assert image_topic(bag, None) == (TOPIC, 3)


PACKINGS = [(plugin, mode) for plugin in StoragePlugin for mode in (None, CompressionMode.FILE, CompressionMode.MESSAGE)]


@pytest.mark.parametrize("plugin, mode", [*PACKINGS, (StoragePlugin.MCAP, CompressionMode.STORAGE)])
def test_bags_of_every_packing_are_read_within_the_bounds(tmp_path, plugin, mode):
    bag = write_bag(tmp_path / "run", plugin, mode=mode, frames=5)
    topic, count = image_topic(bag, None)
    found = [each.message.data for each in messages(bag, topic)]
    rng = np.random.default_rng(0)
    assert count == len(found) == 5
    assert all(np.array_equal(each, rng.integers(0, 256, (40, 40), np.uint8).ravel()) for each in found)


def test_chunks_of_lz4_are_read(tmp_path):
    """As `rosbags` does not write them: those of a recording, packed anew."""
    content = b"".join(
        record(5, struct.pack("<HIQQ", 1, k, k, k) + STORE.serialize_cdr(image(np.full((2, 3), k, np.uint8)), IMAGE))
        for k in range(4)
    )
    schema, _ = STORE.generate_msgdef(IMAGE)
    head = record(3, struct.pack("<H", 1) + text(IMAGE.encode()) + text(b"ros2msg") + text(schema.encode()))
    head += record(4, struct.pack("<HH", 1, 1) + text(TOPIC.encode()) + text(b"cdr") + text(b""))
    path = tmp_path / "run.mcap"
    path.write_bytes(mcap(chunk(len(head + content), b"lz4", packers()[b"lz4"](head + content))))
    topic, count = image_topic(path, None)
    assert [int(each.message.data[0]) for each in messages(path, topic)] == [0, 1, 2, 3] and count == 4


def test_what_is_replaced_of_rosbags_is_there():
    """Names that the bounds are put in place of: a version of rosbags that has others reads without bounds."""
    metadata, reader, storage = (import_module(f"rosbags.rosbag2.{name}") for name in ("metadata", "reader", "storage_mcap"))
    bounded_rosbags.bounded_rosbags()
    assert storage.DECOMPRESSORS.keys() == {"", "lz4", "zstd"}
    assert reader.YAML is metadata.YAML and reader.YAML.__name__ == "BoundedYaml"
    assert set(vars(reader.zstd)) == {"decompress", "open"}
    assert {"zstd.decompress", "zstd.open"} == {
        f"zstd.{word}" for word in ("decompress", "open") if f"zstd.{word}(" in Path(reader.__file__).read_text()
    }
