"""JPEG files as cameras write them: whole ones, those with padding, and those that are damaged."""

import re
from collections.abc import Iterator
from itertools import pairwise

END = b"\xff\xd9"
FRAMES = (0xC0, 0xC1, 0xC2)
"""Markers that begin the header of a frame coded by Huffman's method."""
SCAN, RESTART_INTERVAL = 0xDA, 0xDD
FILL, BARE = 0xFF, (0x01, *range(0xD0, 0xD9))
"""The byte that may fill the space before a marker, and the markers without a segment."""
RESTART = re.compile(rb"\xff[\xd0-\xd7]")
SEGMENT = re.compile(rb"\xff[^\x00\xd0-\xd7\xff]")
"""Markers within the data of a scan, and behind them."""
FEWEST_ALIKE = 4
"""Bytes at the end of data that are taken for padding because they are alike."""
MOST_DATA_ALIKE = 2
"""Bytes of the data that may be like the padding behind them; where more are, a camera has filled up what it lost."""
MOST_ODD = 16
"""Bytes of padding that are not alike."""
LONGEST_SIDE = 65535


def is_whole(content: bytes) -> bool:
    """Whether a JPEG file's picture is complete: the decoder gives no warning, or only one about padding.

    Some cameras put bytes between the data of a picture, or of a restart interval, and the marker behind it: any number of them
    that are alike, or up to `MOST_ODD`. Such padding is no damage. What ends early, or is not decodable, is damaged.

    Args:
        content: content of the file, grey or of three colours.

    Limitations:
        A decoder that loses its place in damaged data and ends up to `MOST_ODD` bytes early is not noticed, nor is damage for
        which the decoder gives no warning.

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
    """Whether libjpeg decodes a file without a warning."""
    from kornia_rs.io import ImageDecoder

    try:
        ImageDecoder().decode_gray8(content)
    except Exception:  # it raises nothing narrower
        return False
    return True


def _without_padding(content: bytes) -> Iterator[Iterator[bytes]]:
    """For each restart interval, files of it alone that end where its data may end; the whole picture is one interval where
    there are no restart markers, or several scans."""
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
    """Data without what may be padding at their end."""
    other = len(data.rstrip(data[-1:]))
    if len(data) - other >= FEWEST_ALIKE:
        yield from (data[: other + kept] for kept in range(MOST_DATA_ALIKE + 1))
    else:
        yield from (data[:-odd] for odd in range(1, min(MOST_ODD, len(data)) + 1))


class _Header:
    """The part of a file before the data of its first scan.

    Attributes:
        length: bytes.
        size_at: where the picture's size stands.
        size: height and width of the picture, px.
        unit: height and width of the units that it is coded in, px.
        restart: units of a restart interval; 0 where there are none.
    """

    def __init__(self, content: bytes, length: int, frame: int, restart: int):
        self.length, self.size_at, self.restart = length, frame + 5, restart
        self.size = int.from_bytes(content[frame + 5 : frame + 7], "big"), int.from_bytes(content[frame + 7 : frame + 9], "big")
        samplings = content[frame + 11 : frame + 11 + 3 * content[frame + 9] : 3] if content[frame + 9] > 1 else b"\x11"
        self.unit = 8 * max(byte & 15 for byte in samplings), 8 * max(byte >> 4 for byte in samplings)

    @classmethod
    def from_bytes(cls, content: bytes) -> "_Header | None":
        """The header of a file whose segments are in order; None for another file."""
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
        """Height and width of pictures of as many units as each restart interval has, px."""
        rows, columns = (-(-side // unit) for side, unit in zip(self.size, self.unit, strict=True))
        for first in range(0, rows * columns, self.restart):
            units = min(self.restart, rows * columns - first)
            lines, wide = (units // columns, columns) if units % columns == 0 else (1, min(units, LONGEST_SIDE // self.unit[1]))
            yield lines * self.unit[0], wide * self.unit[1]

    def of_size(self, content: bytes, size: tuple[int, int]) -> bytes:
        """The header with another height and width of the picture."""
        sides = b"".join(side.to_bytes(2, "big") for side in size)
        return content[: self.size_at] + sides + content[self.size_at + 4 : self.length]
