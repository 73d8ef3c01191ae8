"""The package rosbags with bounds: the unpacked size of a bag is checked before memory and time are spent.

This module replaces private parts of rosbags, which may change with any of its versions; `tests/test_rosbag.py` states what has
changed.
"""

import os
from collections.abc import Callable
from functools import cache, partial
from importlib import import_module
from types import SimpleNamespace
from typing import Any

from ..files.optional import load_rosbags

MOST_CHUNK_BYTES = 2**28
"""Largest size in bytes of an unpacked MCAP chunk, or of a message."""
MOST_RATIO = 256
"""Largest ratio of unpacked to packed size, for all chunks or a compressed file; smaller sizes than one chunk are always
allowed."""
WINDOW = 28
"""Base-2 logarithm of the additional memory in bytes that zstd may use."""
MOST_EVENTS = 2**16
"""Largest number of YAML parser events: values, and beginnings and ends of lists and tables."""
DEEPEST = 16
"""Largest nesting depth of lists and tables in YAML."""


@cache
def bounded_rosbags() -> Any:
    """Return the module `rosbags.highlevel`, patched for the whole process so that it refuses bags beyond these limits.

    Raises:
        MembraneError: rosbags is not installed.
    """
    highlevel = load_rosbags()
    metadata, reader, storage = map(_part, ("metadata", "reader", "storage_mcap"))
    options = {reader.zstd.DecompressionParameter.window_log_max: WINDOW}
    unzstd = partial(_unpacked, partial(reader.zstd.ZstdDecompressor, options=options))
    unlz4 = partial(_unpacked, import_module("lz4.frame").LZ4FrameDecompressor)
    storage.DECOMPRESSORS.update(zstd=unzstd, lz4=unlz4)
    reader.zstd = SimpleNamespace(decompress=unzstd, open=partial(_BoundedFile, reader.zstd.open))
    reader.YAML = metadata.YAML = _bounded_yaml(reader.YAML)
    return highlevel


def refuse_large(reader: Any) -> None:
    """Refuse an open bag whose chunks unpack to far more than its files' size, because many chunks may be in memory at once.

    Raises:
        ValueError: the bag is too large; the message states by how much.
    """
    for each in reader.readers:
        for storage in getattr(each.storage, "storages", [each.storage]):
            size = sum(chunk.uncompressed_size for chunk in getattr(storage, "chunks", []))
            _refuse_packed(size, os.path.getsize(storage.path))


def _refuse_packed(size: int, packed: int) -> None:
    if size > max(MOST_CHUNK_BYTES, MOST_RATIO * packed):
        raise ValueError(f"{packed} bytes unpack to {size} or more; at most {MOST_RATIO} times as many are read")


def _unpacked(decompressor: Callable[[], Any], content: bytes, size: int = MOST_CHUNK_BYTES) -> bytes:
    """Return unpacked data; refuse a declared size that is too large, and data that unpack to more than that."""
    if size > MOST_CHUNK_BYTES:
        raise ValueError(f"a chunk unpacks to {size} bytes; at most {MOST_CHUNK_BYTES} are read: record smaller chunks")
    unpacked: bytes = decompressor().decompress(content, max_length=size + 1)
    if len(unpacked) > size:
        raise ValueError(f"a chunk or message unpacks to more than {size} bytes")
    return unpacked


def _part(name: str) -> Any:
    return import_module(f"rosbags.rosbag2.{name}")


class _BoundedFile:
    """A compressed storage file, unpacked while it is read: `with _BoundedFile(zstd.open, file, "rb") as unpacked`."""

    def __init__(self, opened: Callable[..., Any], packed: Any, mode: str):
        self.file, self.packed, self.size = opened(packed, mode), os.fstat(packed.fileno()).st_size, 0

    def read(self, size: int = -1) -> bytes:
        block: bytes = self.file.read(size)
        self.size += len(block)
        _refuse_packed(self.size, self.packed)
        return block

    def __enter__(self) -> "_BoundedFile":
        return self

    def __exit__(self, *_: object) -> None:
        self.file.close()


def _bounded_yaml(yaml: Any) -> Any:
    """Return a subclass of `YAML` whose `load` checks the parser events of a text before it builds any objects."""
    from ruamel.yaml import AliasEvent, CollectionEndEvent, CollectionStartEvent

    class BoundedYaml(yaml):
        def load(self, stream: Any) -> Any:
            depth = 0
            for number, event in enumerate(yaml(typ="safe", pure=True).parse(stream)):
                depth += isinstance(event, CollectionStartEvent) - isinstance(event, CollectionEndEvent)
                if number > MOST_EVENTS or depth > DEEPEST:
                    raise ValueError(f"YAML of more than {MOST_EVENTS} values, or of more than {DEEPEST} levels")
                if isinstance(event, AliasEvent):
                    raise ValueError("YAML with references, which recordings do not contain")
            return super().load(stream)

    return BoundedYaml
