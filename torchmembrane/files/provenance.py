"""The source file of a frame and its time; they reveal when a file name holds a new image."""

import hashlib
from functools import partial
from pathlib import Path
from typing import NamedTuple

from .timestamps import time_in

DIGEST = partial(hashlib.blake2b, digest_size=16)


class SourceFile(NamedTuple):
    """The file of a frame at the time of its reconstruction, and what was measured along with it.

    If views have images of their own, a frame has one file per view.

    Attributes:
        path: path as given; for several files, that of the first view.
        file_size: total size of all files in bytes; -1 if unknown.
        file_modified: latest modification time of the files, nanoseconds since 1970; -1 if unknown.
        content_hash: BLAKE2b hash of the content of all files, 16 bytes in hexadecimal; "" if unknown.
        time: capture time of the frame in seconds, as its name, video, bag or camera states it; NaN if unknown.
        gauge: pressure across the membrane measured by a gauge at that time, force unit / length unit^2; NaN if there is none.
    """

    path: str = ""
    file_size: int = -1
    file_modified: int = -1
    content_hash: str = ""
    time: float = float("nan")
    gauge: float = float("nan")

    @classmethod
    def from_files(cls, file: Path, *further: Path) -> "SourceFile":
        """Return the provenance of a file in its current state; `further`: the files of the other views, in order.

        Raises:
            OSError: a file cannot be read.

        Example:
            >>> rest, press = (SourceFile.from_files(Path("examples") / name) for name in ("rest.png", "flat_plate.png"))
            >>> rest.content_hash == press.content_hash
            False
        """
        digest, size, modified = DIGEST(), 0, 0
        for each in (file, *further):
            stat = each.stat()
            size, modified = size + stat.st_size, max(modified, stat.st_mtime_ns)
            with open(each, "rb") as content:
                hashlib.file_digest(content, lambda: digest)
        return cls(printable(str(file)), size, modified, digest.hexdigest(), time_in(file.stem))

    @classmethod
    def of_bytes(cls, file: Path, content: bytes) -> "SourceFile":
        """Return the provenance of a file of which only the content is known."""
        return cls(printable(str(file)), len(content), content_hash=DIGEST(content).hexdigest(), time=time_in(file.stem))

    def is_of(self, *files: Path) -> bool:
        """Return whether a file, or the files of all views, are unchanged: size and time are compared first, and the hash if
        these differ. Return True if the hash is unknown or a file cannot be read."""
        try:
            stats = [file.stat() for file in files]
            size, modified = sum(stat.st_size for stat in stats), max(stat.st_mtime_ns for stat in stats)
            if not self.content_hash or (size, modified) == (self.file_size, self.file_modified):
                return True
            return size == self.file_size and SourceFile.from_files(*files).content_hash == self.content_hash
        except OSError:
            return True


def printable(text: str) -> str:
    r"""Return a path's text in UTF-8; bytes that are not valid UTF-8 are escaped.

    Example:
        >>> printable("caf\udce9.png")
        'caf\\xe9.png'
    """
    return text.encode("utf-8", "surrogateescape").decode("utf-8", "backslashreplace")
