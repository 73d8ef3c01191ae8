"""The source file of a frame and its time, so that a new image under an old name is noticed."""

import hashlib
from functools import partial
from pathlib import Path
from typing import NamedTuple

from .timestamps import time_in

DIGEST = partial(hashlib.blake2b, digest_size=16)


class Origin(NamedTuple):
    """The file of a frame as it was when the frame was reconstructed, and what was measured beside it.

    Attributes:
        path: as given.
        file_size: bytes; -1 where it is not known.
        file_modified: nanoseconds since 1970; -1 where it is not known.
        content_hash: BLAKE2b hash of its content, 16 bytes as hexadecimal; "" if it is not known.
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
    def of(cls, file: Path) -> "Origin":
        """The origin of a file as it is now.

        Raises:
            OSError: it cannot be read.

        Example:
            >>> Origin.of(Path("examples/rest.png")).content_hash == Origin.of(Path("examples/flat_plate.png")).content_hash
            False
        """
        stat = file.stat()
        with open(file, "rb") as content:
            digest = hashlib.file_digest(content, DIGEST).hexdigest()
        return cls(printable(str(file)), stat.st_size, stat.st_mtime_ns, digest, time_in(file.stem))

    @classmethod
    def of_bytes(cls, file: Path, content: bytes) -> "Origin":
        """The origin of a file of which only the content is known."""
        return cls(printable(str(file)), len(content), content_hash=DIGEST(content).hexdigest(), time=time_in(file.stem))

    def is_of(self, file: Path) -> bool:
        """Whether a file has not changed: its size and time are compared, and if these differ its hash. True if the hash is not
        known or the file cannot be read."""
        try:
            stat = file.stat()
            if not self.content_hash or (stat.st_size, stat.st_mtime_ns) == (self.file_size, self.file_modified):
                return True
            return stat.st_size == self.file_size and Origin.of(file).content_hash == self.content_hash
        except OSError:
            return True


def printable(text: str) -> str:
    r"""A path's text in UTF-8; bytes that are not valid UTF-8 are escaped.

    Example:
        >>> printable("caf\udce9.png")
        'caf\\xe9.png'
    """
    return text.encode("utf-8", "surrogateescape").decode("utf-8", "backslashreplace")
