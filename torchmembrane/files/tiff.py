"""Detection of TIFF damage that decoders ignore: wrong checksums, displaced pixels, compressed data that are too long."""

import re
import struct
import zlib
from collections.abc import Iterator
from typing import IO, TYPE_CHECKING, Any, NamedTuple

if TYPE_CHECKING:
    from PIL.TiffImagePlugin import ImageFileDirectory_v2

WIDTH, HEIGHT, BITS, COMPRESSION, COLOURS, FILL_ORDER, ROWS, PLANES = 256, 257, 258, 259, 262, 266, 278, 284
PLACES, LENGTHS, TILE = (273, 324), (279, 325), (322, 323)
"""Tag numbers of a page, and of its strips or tiles."""
UNCOMPRESSED, DEFLATED, LZW, PACKBITS, REVERSED, SUBSAMPLED, APART = 1, (8, 32946), 5, 32773, 2, 6, 2
"""Values of the tags above."""
CLEAR, END, MOST_CODES = 256, 257, 4096
"""LZW codes that begin a new table and end the data, and the largest number of codes in a table."""
OLD_LZW = re.compile(b"\0[\x01\x03\x05\x07\x09\x0b\x0d\x0f]")
"""First bytes of LZW data with the old bit order, which is not checked."""
SIZES = {1: 1, 2: 1, 3: 2, 4: 4, 5: 8, 6: 1, 7: 1, 8: 2, 9: 4, 10: 8, 11: 4, 12: 8, 13: 4, 16: 8, 17: 8, 18: 8}
"""Size of a value in bytes, by TIFF type."""
FURTHER = {330, 34665, 34853, 40965}
"""Tags that point to further directories; their data are not located."""
MOST_ENTRIES, MOST_PAGES = 4096, 2**17


class _Entry(NamedTuple):
    tag: int
    end: int


def refuse_damaged_page(tags: "ImageFileDirectory_v2", file: IO[bytes]) -> None:
    """Refuse a page whose compressed data have a wrong checksum or continue after its last pixel, where decoders stop.

    Args:
        tags: tags of the page.
        file: open file that holds the page.

    Raises:
        ValueError: a strip or tile is damaged.
    """
    compression = tags.get(COMPRESSION)
    sizes = {LZW: _lzw_size, PACKBITS: _packbits_size}
    unknown = tags.get(FILL_ORDER) == REVERSED or tags.get(COLOURS) == SUBSAMPLED
    if compression not in (*DEFLATED, *sizes) or (unknown and compression in sizes):
        return
    for number, (place, length) in enumerate(_data(tags)):
        file.seek(place)
        data = file.read(length)
        try:
            if compression in DEFLATED:
                zlib.decompress(data)
            elif not (compression == LZW and OLD_LZW.match(data)) and sizes[compression](data) not in _sizes(tags, number):
                raise ValueError("the decompressed data have another size than the file declares")
        except (zlib.error, ValueError) as error:
            raise ValueError(f"damaged data of a TIFF: {error}") from error


def refuse_displaced(tags: "ImageFileDirectory_v2", file: IO[bytes]) -> None:
    """Refuse an uncompressed single-page file with extra bytes at its end: bytes may have been inserted before them.

    Extra bytes that are all equal are treated as padding.

    Args:
        tags: tags of the page.
        file: open file that holds the page.

    Raises:
        ValueError: the file has such bytes.
    """
    if tags.get(COMPRESSION) != UNCOMPRESSED:
        return
    try:
        entries, data = list(_entries(file)), _data(tags)
    except struct.error:  # a directory that ends early, or one after the last
        return
    if not data or FURTHER & {entry.tag for entry in entries}:
        return
    end = max([place + length for place, length in data] + [entry.end for entry in entries])
    file.seek(end)
    if len(set(behind := file.read())) > 1:
        raise ValueError(
            f"{len(behind)} bytes behind the data of an uncompressed TIFF; where bytes were added, pixels are displaced"
        )


def _data(tags: "ImageFileDirectory_v2") -> list[tuple[int, int]]:
    """Return offset and length of each strip or tile; an empty list if the file does not state the lengths."""
    places, lengths = (next((tags[tag] for tag in pair if tag in tags), ()) for pair in (PLACES, LENGTHS))
    return list(zip(places, lengths, strict=False))


def _sizes(tags: "ImageFileDirectory_v2", number: int) -> tuple[int, ...]:
    """Return the size in bytes to which each strip or tile may unpack; the last strip may be as long as the others."""
    bits = tags.get(BITS, (1,))[: 1 if tags.get(PLANES) == APART else None]
    if TILE[0] in tags:
        width, rows, left = tags[TILE[0]], tags[TILE[1]], tags[TILE[1]]
    else:
        width, height = tags[WIDTH], tags[HEIGHT]
        rows = min(tags.get(ROWS, height), height)
        left = min(rows, height - number % -(-height // rows) * rows)
    line = -(-width * sum(bits) // 8)
    return left * line, rows * line


def _lzw_size(data: bytes) -> int:
    """Return the number of bytes to which the LZW data of a TIFF unpack, up to their end code."""
    sizes, before, total, width, held, have = [1] * CLEAR + [0, 0], 0, 0, 9, 0, 0
    for byte in data:
        held, have = (held << 8 | byte) & 0xFFFFF, have + 8
        if have < width:
            continue
        have -= width
        code = held >> have & (1 << width) - 1
        if code == CLEAR:
            sizes, before, width = [1] * CLEAR + [0, 0], 0, 9
            continue
        if code == END:
            break
        if before and len(sizes) < MOST_CODES:
            sizes.append(before + 1)
        if code >= len(sizes):
            raise ValueError("an LZW code that is not known yet")
        before = sizes[code]
        total += before
        if len(sizes) >= (1 << width) - 1 and width < 12:
            width += 1
    return total


def _packbits_size(data: bytes) -> int:
    """Return the number of bytes to which PackBits data unpack."""
    at = total = 0
    while at < len(data):
        head = data[at]
        if head < 128:
            at, total = at + head + 2, total + head + 1
        else:
            at, total = at + (2 if head > 128 else 1), total + (257 - head if head > 128 else 0)
    return total


def _entries(file: IO[bytes]) -> Iterator[_Entry]:
    """Yield all entries of all directories, each with the file offset at which the entry or its values end."""
    file.seek(0)
    head = file.read(16)
    order, big = "<" if head[:2] == b"II" else ">", head[2:4] in (b"+\0", b"\0+")
    counter, entry, offset = ("Q", "HHQ8s", "Q") if big else ("H", "HHL4s", "L")

    def read(form: str, at: int) -> tuple[Any, ...]:
        file.seek(at)
        return struct.unpack(order + form, file.read(struct.calcsize(order + form)))

    step, inside = struct.calcsize("=" + entry), struct.calcsize("=" + offset)
    (at,) = read(offset, 8 if big else 4)
    seen: set[int] = set()
    while at and at not in seen and len(seen) < MOST_PAGES:  # the last one of a damaged file may lead to an earlier one
        seen.add(at)
        (count,) = read(counter, at)
        at += struct.calcsize("=" + counter)
        for _ in range(min(count, MOST_ENTRIES)):
            tag, kind, values, value = read(entry, at)
            at += step
            size = SIZES.get(kind, 0) * values
            yield _Entry(tag, at if size <= inside else size + struct.unpack(order + offset, value)[0])
        yield _Entry(0, at + inside)
        (at,) = read(offset, at)
