"""Damage of TIFF files that decoding passes over: wrong checksums, and bytes pushed into uncompressed pixels."""

import struct
import zlib
from collections.abc import Iterator
from typing import IO, Any, NamedTuple

from PIL.TiffImagePlugin import ImageFileDirectory_v2

COMPRESSION, PLACES, LENGTHS = 259, (273, 324), (279, 325)
"""Tags: of the data, and of its strips or tiles."""
UNCOMPRESSED, DEFLATED = 1, (8, 32946)
SIZES = {1: 1, 2: 1, 3: 2, 4: 4, 5: 8, 6: 1, 7: 1, 8: 2, 9: 4, 10: 8, 11: 4, 12: 8, 13: 4, 16: 8, 17: 8, 18: 8}
"""Bytes of a value, by its type."""
FURTHER = {330, 34665, 34853, 40965}
"""Tags that lead to further directories, whose data are not looked for."""
MOST_ENTRIES, MOST_PAGES = 4096, 2**17


class _Entry(NamedTuple):
    tag: int
    end: int


def refuse_damaged_page(tags: ImageFileDirectory_v2, file: IO[bytes]) -> None:
    """Refuse a page whose compressed data do not have their checksum: decoders stop when they have all pixels.

    Args:
        tags: of the page.
        file: that holds it.

    Raises:
        ValueError: a strip, or a tile, is damaged.
    """
    if tags.get(COMPRESSION) not in DEFLATED:
        return
    for place, length in _data(tags):
        file.seek(place)
        try:
            zlib.decompress(file.read(length))
        except zlib.error as error:
            raise ValueError(f"damaged data of a TIFF: {error}") from error


def refuse_displaced(tags: ImageFileDirectory_v2, file: IO[bytes]) -> None:
    """Refuse an uncompressed file of one page with bytes behind all that it holds: some may have been pushed in before.

    Bytes that are alike are taken for padding.

    Args:
        tags: of the page.
        file: that holds it.

    Raises:
        ValueError: there are such bytes.
    """
    if tags.get(COMPRESSION) != UNCOMPRESSED:
        return
    entries, data = list(_entries(file)), _data(tags)
    if not data or FURTHER & {entry.tag for entry in entries}:
        return
    end = max([place + length for place, length in data] + [entry.end for entry in entries])
    file.seek(end)
    if len(set(behind := file.read())) > 1:
        raise ValueError(
            f"{len(behind)} bytes behind the data of an uncompressed TIFF; where bytes were added, pixels are displaced"
        )


def _data(tags: ImageFileDirectory_v2) -> list[tuple[int, int]]:
    """Place and length of each strip or tile; none where the file does not say the lengths."""
    places, lengths = (next((tags[tag] for tag in pair if tag in tags), ()) for pair in (PLACES, LENGTHS))
    return list(zip(places, lengths, strict=False))


def _entries(file: IO[bytes]) -> Iterator[_Entry]:
    """All entries of all directories, with where the entry or its values end in the file."""
    file.seek(0)
    head = file.read(16)
    order, big = "<" if head[:2] == b"II" else ">", head[2:4] in (b"+\0", b"\0+")
    counter, entry, offset = ("Q", "HHQ8s", "Q") if big else ("H", "HHL4s", "L")

    def read(form: str, at: int) -> tuple[Any, ...]:
        file.seek(at)
        return struct.unpack(order + form, file.read(struct.calcsize(order + form)))

    step, inside = struct.calcsize("=" + entry), struct.calcsize("=" + offset)
    (at,) = read(offset, 8 if big else 4)
    for _ in range(MOST_PAGES):
        if not at:
            break
        (count,) = read(counter, at)
        at += struct.calcsize("=" + counter)
        for _ in range(min(count, MOST_ENTRIES)):
            tag, kind, values, value = read(entry, at)
            at += step
            size = SIZES.get(kind, 0) * values
            yield _Entry(tag, at if size <= inside else size + struct.unpack(order + offset, value)[0])
        yield _Entry(0, at + inside)
        (at,) = read(offset, at)
