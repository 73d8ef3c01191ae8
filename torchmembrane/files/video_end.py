"""Check whether a video file is as long as it declares: Matroska, WebM, AVI, MP4, MOV and GIF."""

from pathlib import Path
from typing import BinaryIO

EBML, SEGMENT = b"\x1a\x45\xdf\xa3", b"\x18\x53\x80\x67"
"""Identifiers of a Matroska file's header, and of the segment after it, which is the rest of the file."""
BOXES = (b"ftyp", b"moov", b"moof", b"mdat", b"wide", b"free", b"skip")
"""Types of the boxes with which an MP4 or MOV file may begin."""
FRAGMENT = b"moof"
INDEX = (b"moov", FRAGMENT)
MOST_BOXES = 2**16
"""Largest number of boxes that are read."""
LONGEST_TAIL = 1024
"""Largest number of bytes, usually zeros, that programs append after the end of a GIF."""


def missing_end(path: Path) -> str:
    """Return in words what is missing at the end of a video file; "" if nothing is missing or this cannot be determined.

    Args:
        path: path of a regular file.

    Example:
        >>> from tempfile import TemporaryDirectory
        >>> with TemporaryDirectory() as folder:
        ...     path = Path(folder) / "cut.avi"
        ...     _ = path.write_bytes(b"RIFF" + (1000).to_bytes(4, "little") + b"AVI " + bytes(88))
        ...     missing_end(path)
        '100 of at least 1008 bytes'
    """
    held = path.stat().st_size
    with open(path, "rb") as file:
        begin = file.read(8)
        if begin.startswith(b"GIF8"):
            file.seek(max(0, held - LONGEST_TAIL))
            return "" if file.read().rstrip(b"\0").endswith(b";") else "no mark of its end"
        if begin.startswith(EBML):
            declared = _end_of_matroska(file)
        elif begin.startswith(b"RIFF"):
            declared = _end_of_riff(file, held)
        elif begin[4:] in BOXES:
            declared, kinds = _end_of_boxes(file, held)
            if declared <= held and not kinds.intersection(INDEX):
                return "no index (moov), as where a recording was not closed"
            if declared > held and FRAGMENT in kinds:
                return "cut off in one of its fragments"
        else:
            return ""
    return f"{held} of at least {declared} bytes" if declared > held else ""


def _end_of_matroska(file: BinaryIO) -> int:
    file.seek(len(EBML))
    length = _variable(file)
    file.seek(length or 0, 1)
    if length is None or file.read(len(SEGMENT)) != SEGMENT:
        return 0
    length = _variable(file)
    return 0 if length is None else file.tell() + length


def _variable(file: BinaryIO) -> int | None:
    """Read a Matroska variable-length number, whose first byte gives the length; None: unknown, as in a live recording."""
    first = file.read(1)
    count = 9 - first[0].bit_length() if first and first[0] else 0
    rest = file.read(count - 1) if count else b""
    if not count or len(rest) != count - 1:
        return None
    value = int.from_bytes(bytes([first[0] & (2 ** (8 - count) - 1)]) + rest, "big")
    return None if value == 2 ** (7 * count) - 1 else value


def _end_of_riff(file: BinaryIO, held: int) -> int:
    at = 0
    for _ in range(MOST_BOXES):
        file.seek(at)
        head = file.read(8)
        if len(head) < 8 or head[:4] != b"RIFF":
            break
        size = int.from_bytes(head[4:], "little")
        if size == 0:  # not closed
            break
        at += 8 + size
        if at >= held:
            break
        at += size % 2
    return at


def _end_of_boxes(file: BinaryIO, held: int) -> tuple[int, set[bytes]]:
    """Return the offset at which the boxes of an MP4 or MOV file end, and the types of the boxes."""
    at, kinds = 0, set[bytes]()
    for _ in range(MOST_BOXES):
        file.seek(at)
        head = file.read(16)
        size, kind = int.from_bytes(head[:4], "big"), head[4:8]
        if len(head) < 8 or not kind.isascii() or size == 0:  # 0: up to the end
            break
        if size == 1:
            size = int.from_bytes(head[8:], "big")
        if size < 8:
            break
        kinds.add(kind)
        at += size
        if at >= held:
            break
    return at, kinds
