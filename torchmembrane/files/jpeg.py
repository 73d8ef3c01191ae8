"""Checks of JPEG files from cameras: complete files, files with padding, and damaged files."""

import re
from collections.abc import Iterator
from itertools import pairwise

END = b"\xff\xd9"
FRAMES = (0xC0, 0xC1, 0xC2)
"""Markers that begin the header of a Huffman-coded frame."""
SCAN, RESTART_INTERVAL = 0xDA, 0xDD
FILL, BARE = 0xFF, (0x01, *range(0xD0, 0xD9))
"""The fill byte that may precede a marker, and the markers that have no segment."""
RESTART = re.compile(rb"\xff[\xd0-\xd7]")
SEGMENT = re.compile(rb"\xff[^\x00\xd0-\xd7\xff]")
"""Patterns of the restart markers within scan data, and of the markers after it."""
FEWEST_ALIKE = 4
"""Smallest number of equal bytes at the end of the data that is taken for padding."""
MOST_DATA_ALIKE = 2
"""Largest number of data bytes that may equal the padding after them; if there are more, the camera has filled lost data."""
MOST_ODD = 16
"""Largest number of padding bytes that are not all equal."""
LONGEST_SIDE = 65535


def is_whole(content: bytes) -> bool:
    """Return whether a JPEG file is complete: the decoder gives no warning, or only a warning about padding.

    Some cameras put padding bytes between the data of a picture, or of a restart interval, and the next marker: any number of
    equal bytes, or up to `MOST_ODD` arbitrary ones. Such padding is not damage. A picture that ends early or cannot be decoded
    is damaged.

    Args:
        content: content of the file, grey or with three colours.

    Limitations:
        Damage is not detected if the decoder gives no warning for it, or if the decoder loses synchronisation and ends up to
        `MOST_ODD` bytes early.

    Example:
        >>> from io import BytesIO
        >>> from PIL import Image
        >>> file = BytesIO()
        >>> Image.linear_gradient("L").save(file, "JPEG")
        >>> data = file.getvalue().removesuffix(END)
        >>> [is_whole(data + padding + END) for padding in (b"", bytes(500), bytes(range(16)), bytes(range(99)))]
        [True, True, True, False]
        >>> is_whole(data[:-9] + END), is_whole(data[:-9] + bytes(99) + END)
        (False, False)
    """
    return _is_decoded(content) or all(any(map(_is_decoded, trials)) for trials in _without_padding(content))


def _is_decoded(content: bytes) -> bool:
    """Return whether libjpeg decodes a file without a warning."""
    from kornia_rs.io import ImageDecoder

    try:
        ImageDecoder().decode_gray8(content)
    except Exception:  # it raises nothing narrower
        return False
    return True


def _without_padding(content: bytes) -> Iterator[Iterator[bytes]]:
    """For each restart interval, yield candidate files that contain this interval alone and end where its data may end; the
    picture is treated as one interval if it has no restart markers or several scans."""
    header = _Header.from_bytes(content)
    end = content.find(END, header.length) if header else -1
    if header is None or end < 0:
        yield iter(())
        return
    data = content[header.length : end]
    sizes = list(header.interval_sizes()) if header.restart and not SEGMENT.search(data) else []
    if not sizes:
        yield (content[: header.length] + shorter + END for shorter in _shorter(data))
        return
    borders = [(0, 0), *(marker.span() for marker in RESTART.finditer(data)), (len(data), len(data))]
    intervals = [data[before[1] : after[0]] for before, after in pairwise(borders)]
    if len(intervals) != len(sizes):
        yield iter(())
        return
    for interval, size in zip(intervals, sizes, strict=True):
        start = header.of_size(content, size)
        yield (start + data + END for data in (interval, *_shorter(interval)))


def _shorter(data: bytes) -> Iterator[bytes]:
    """Yield the data with possible padding at the end removed."""
    other = len(data.rstrip(data[-1:]))
    if len(data) - other >= FEWEST_ALIKE:
        yield from (data[: other + kept] for kept in range(MOST_DATA_ALIKE + 1))
    else:
        yield from (data[:-odd] for odd in range(1, min(MOST_ODD, len(data)) + 1))


class _Header:
    """The part of a file before the data of its first scan.

    Attributes:
        length: length of the header in bytes.
        size_at: offset of the picture size.
        size: height and width of the picture, px.
        unit: height and width of a coding unit (MCU), px.
        restart: number of coding units in a restart interval; 0 if there are none.
    """

    def __init__(self, content: bytes, length: int, frame: int, restart: int):
        self.length, self.size_at, self.restart = length, frame + 5, restart
        self.size = int.from_bytes(content[frame + 5 : frame + 7], "big"), int.from_bytes(content[frame + 7 : frame + 9], "big")
        samplings = content[frame + 11 : frame + 11 + 3 * content[frame + 9] : 3] if content[frame + 9] > 1 else b"\x11"
        self.unit = 8 * max(byte & 15 for byte in samplings), 8 * max(byte >> 4 for byte in samplings)

    @classmethod
    def from_bytes(cls, content: bytes) -> "_Header | None":
        """Return the header of a file whose segments are in order, or None for any other file."""
        at, frame, restart = 2, 0, 0
        while at + 4 <= len(content) and content[at] == 0xFF:
            marker, length = content[at + 1], int.from_bytes(content[at + 2 : at + 4], "big")
            if marker == FILL or marker in BARE:
                at += 1 if marker == FILL else 2
                continue
            if marker in FRAMES:
                frame = at
            elif marker == RESTART_INTERVAL:
                restart = int.from_bytes(content[at + 4 : at + 6], "big")
            at += 2 + length
            if marker == SCAN:
                return cls(content, at, frame, restart) if frame else None
        return None

    def interval_sizes(self) -> Iterator[tuple[int, int]]:
        """Yield, for each restart interval, the height and width of a picture with as many coding units, px."""
        rows, columns = (-(-side // unit) for side, unit in zip(self.size, self.unit, strict=True))
        for first in range(0, rows * columns, self.restart):
            units = min(self.restart, rows * columns - first)
            lines, wide = (units // columns, columns) if units % columns == 0 else (1, min(units, LONGEST_SIDE // self.unit[1]))
            yield lines * self.unit[0], wide * self.unit[1]

    def of_size(self, content: bytes, size: tuple[int, int]) -> bytes:
        """Return the header with the height and width of the picture replaced."""
        sides = b"".join(side.to_bytes(2, "big") for side in size)
        return content[: self.size_at] + sides + content[self.size_at + 4 : self.length]
