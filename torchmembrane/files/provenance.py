"""The source file of a frame and its time, so that a new image under an old name is noticed."""

import hashlib
from functools import partial
from pathlib import Path
from typing import NamedTuple

from .timestamps import time_in

DIGEST = partial(hashlib.blake2b, digest_size=16)


class SourceFile(NamedTuple):
    """The file of a frame as it was when the frame was reconstructed, and what was measured beside it.

    Of views that have images of their own, a frame has a file for each.

    Attributes:
        path: as given, of the first view.
        file_size: bytes, of all files; -1 where it is not known.
        file_modified: nanoseconds since 1970, of the file that was modified last; -1 where it is not known.
        content_hash: BLAKE2b hash of the content of all files, 16 bytes as hexadecimal; "" if it is not known.
        time: when the frame was taken, seconds, as its name, video, bag or camera says; NaN where it is not known.
        gauge: pressure across the membrane that a gauge read then, force unit / length unit^2; NaN where none did.
    """

    path: str = ""
    file_size: int = -1
    file_modified: int = -1
    content_hash: str = ""
    time: float = float("nan")
    gauge: float = float("nan")

    @classmethod
    def from_files(cls, file: Path, *further: Path) -> "SourceFile":
        """The origin of a file as it is now; `further`: of the other views, in their order.

        Raises:
            OSError: one cannot be read.

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
        """The origin of a file of which only the content is known."""
        return cls(printable(str(file)), len(content), content_hash=DIGEST(content).hexdigest(), time=time_in(file.stem))

    def is_of(self, *files: Path) -> bool:
        """Whether a file, or those of all views, have not changed: size and time are compared, and if these differ the hash.
        True if the hash is not known or a file cannot be read."""
        try:
            stats = [file.stat() for file in files]
            size, modified = sum(stat.st_size for stat in stats), max(stat.st_mtime_ns for stat in stats)
            if not self.content_hash or (size, modified) == (self.file_size, self.file_modified):
                return True
            return size == self.file_size and SourceFile.from_files(*files).content_hash == self.content_hash
        except OSError:
            return True


def printable(text: str) -> str:
    r"""A path's text in UTF-8; bytes that are not valid UTF-8 are escaped.

    Example:
        >>> printable("caf\udce9.png")
        'caf\\xe9.png'
    """
    return text.encode("utf-8", "surrogateescape").decode("utf-8", "backslashreplace")
