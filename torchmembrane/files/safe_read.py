"""Bounded reading of untrusted files: kind, size and nesting of a file are checked before memory is allocated.

Any fault is a `MembraneError` of one line that names the file. A file may name others only in its own folder or below.
"""

import io
import math
import os
import re
import stat
import struct
import tokenize
import zipfile
import zlib
from collections.abc import Sequence
from pathlib import Path, PurePosixPath, PureWindowsPath
from typing import IO, Any

import numpy as np

from ..errors import MembraneError
from .atomic import kind_of

MOST_ARRAY_BYTES = 2**26
"""Largest size of a file of arrays, and of all arrays that are read from it."""
MOST_ARRAYS = 64
"""In a file."""
NUMBERS, TEXT = "biuf", "U"
"""Kinds of numpy's types."""
NPY_MAGIC = b"\x93NUMPY"
PLAIN_METHODS = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)
ENTRY_MARK = b"PK\x01\x02"  # begins every entry of a zip file's directory
DAMAGE = (
    *(OSError, ValueError, TypeError, ArithmeticError, LookupError, AttributeError, EOFError, RuntimeError, SyntaxError),
    *(MemoryError, struct.error, tokenize.TokenError, zipfile.BadZipFile, zlib.error),
)
"""Exceptions that zipfile, zlib, numpy and Pillow raise for damaged files."""


class LackingArray(MembraneError):
    """An intact file of arrays lacks one that was asked for."""


def read_bytes(path: Path, most: int, expected: str) -> bytes:
    """A file's content.

    Args:
        path: a regular file; devices and pipes are not opened.
        most: bytes that it may hold.
        expected: what is read, for messages.

    Raises:
        MembraneError: no such file, no regular one, a larger one, or one that cannot be read.

    Example:
        >>> read_bytes(Path("examples/dots.csv"), 10, "dots")
        Traceback (most recent call last):
        ...
        torchmembrane.errors.MembraneError: examples/dots.csv: holds 3893 bytes; expected dots, at most 10 bytes
    """
    try:
        size = regular_size(path, most, expected)
        with open(path, "rb") as file:
            content = file.read(size + 1)
    except FileNotFoundError:
        raise MembraneError(f"{path}: no such file; expected {expected}, check the path") from None
    except (OSError, MemoryError) as error:
        raise MembraneError(f"{path}: not readable ({_cause(error)}); expected {expected}") from error
    if len(content) > most:
        raise MembraneError(f"{path}: holds more than {size} bytes; expected {expected}, at most {most} bytes")
    return content


def regular_size(path: Path, most: int, expected: str) -> int:
    """The size of a regular file in bytes; it is not opened.

    Args:
        path: as for `read_bytes`.
        most: bytes that it may hold.
        expected: what is to be read, for messages.

    Raises:
        FileNotFoundError: no such file.
        MembraneError: no regular one, or a larger one.
    """
    try:
        found = os.stat(path)
    except FileNotFoundError:
        raise
    except (OSError, ValueError) as error:  # ValueError: a NUL in the path
        raise MembraneError(f"{path}: not readable ({_cause(error)}); expected {expected}") from error
    if not stat.S_ISREG(found.st_mode):
        raise MembraneError(f"{path}: not readable (it is a {kind_of(found.st_mode)}); expected {expected}, a regular file")
    if found.st_size > most:
        raise MembraneError(f"{path}: holds {found.st_size} bytes; expected {expected}, at most {most} bytes")
    return found.st_size


def read_text(path: Path, most: int, expected: str) -> str:
    """A file's text: UTF-8, with or without a byte order mark.

    Args:
        path: as for `read_bytes`.
        most: largest number of bytes that it may hold.
        expected: what the file should be, for messages.

    Raises:
        MembraneError: as for `read_bytes`; or the file is not UTF-8, or contains NUL.
    """
    try:
        text = read_bytes(path, most, expected).decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise MembraneError(f"{path}: not UTF-8 text ({error}); expected {expected}, saved as UTF-8") from error
    if "\0" in text:
        raise MembraneError(f"{path}: contains NUL, so it is not text; expected {expected}, saved as UTF-8")
    return text


def read_arrays(
    path: Path, names: Sequence[str] | None = None, expected: str = "an .npz as numpy.savez writes it", kinds: str = NUMBERS
) -> dict[str, np.ndarray]:
    """Arrays from an `.npz`, by name. Sizes are checked before anything is unpacked; nothing is unpickled.

    Args:
        path: path of the file.
        names: names of the arrays, others that the file may hold are not read; None: all.
        expected: what is read, for messages.
        kinds: kinds of types that they may have, `NUMBERS` or `NUMBERS + TEXT`.

    Raises:
        MembraneError: no such file, a damaged or too large one, or one that lacks an array.

    Example:
        >>> read_arrays(Path("examples/rest_grid.npz"), ["vertices"])["vertices"].shape
        (33, 33, 3)
    """
    content = read_bytes(path, MOST_ARRAY_BYTES, expected)
    try:
        if content.count(ENTRY_MARK) > MOST_ARRAYS:
            raise ValueError(f"it holds more than {MOST_ARRAYS} arrays")
        with zipfile.ZipFile(io.BytesIO(content)) as file:
            members = {member.filename.removesuffix(".npy"): member for member in file.infolist()}
            if missing := [name for name in names or () if name not in members]:
                said = f"{missing[0]} is missing, the file holds {in_one_line(', '.join(members)) if members else 'nothing'}"
                raise LackingArray(f"{path}: {said}; expected {', '.join(names or ())}: add it")
            wanted = members if names is None else {name: members[name] for name in names}
            _refuse_large(sum(member.file_size for member in wanted.values()))
            return {
                name: _array(_unpacked(file, member), f"{path}: {in_one_line(name)}", kinds) for name, member in wanted.items()
            }
    except MembraneError:
        raise
    except DAMAGE as error:
        raise MembraneError(f"{path}: not readable ({in_one_line(error)}); expected {expected}") from error


def read_array(path: Path) -> np.ndarray:
    """The array of numbers of an `.npy`, checked as `read_arrays` does.

    Args:
        path: path of the file.

    Raises:
        MembraneError: no such file, or a damaged or too large one.
    """
    expected = "an array as numpy.save writes it"
    try:
        return _array(read_bytes(path, MOST_ARRAY_BYTES, expected), f"{path}: the array", NUMBERS)
    except MembraneError:
        raise
    except DAMAGE as error:
        raise MembraneError(f"{path}: not readable ({in_one_line(error)}); expected {expected}") from error


def lies_within(name: str) -> bool:
    """Whether a file name that is written in another file leads into that file's folder or below, on every system.

    Example:
        >>> [lies_within(name) for name in ("dots.csv", "rest/a.png", "../dots.csv", "/etc/passwd", "C:\\\\dots.csv")]
        [True, True, False, False, False]
    """
    for path in (PurePosixPath(name), PureWindowsPath(name)):
        if path.is_absolute() or path.drive or path.root or ".." in path.parts:
            return False
    return "\0" not in name


def shortened(text: str, most: int = 80) -> str:
    """Text shortened to at most `most` characters by leaving out its middle.

    Example:
        >>> shortened("1234567890", 7)
        '12...90'
    """
    half = (most - 3) // 2
    return text if len(text) <= most else f"{text[:half]}...{text[-half:]}"


def in_one_line(text: object) -> str:
    """A foreign message or content as one line of at most 200 characters.

    Example:
        >>> in_one_line("unexpected\\n  end\\a")
        'unexpected end?'
    """
    return shortened(printable(re.sub(r"\s+", " ", str(text))) or type(text).__name__, 200)


def printable(text: object) -> str:
    """Text with `?` in place of characters that cannot be printed in a line.

    Example:
        >>> printable("rest\\n.png")
        'rest?.png'
    """
    return "".join(c if c.isprintable() else "?" for c in str(text))


def _cause(error: BaseException) -> str:
    return getattr(error, "strerror", None) or in_one_line(error)


def _refuse_large(size: int) -> None:
    if size > MOST_ARRAY_BYTES:
        raise ValueError(f"its arrays take {size} bytes, more than {MOST_ARRAY_BYTES}")


def _unpacked(file: zipfile.ZipFile, member: zipfile.ZipInfo) -> bytes:
    """A member's content, which must have the size and the checksum that the directory declares."""
    if member.compress_type not in PLAIN_METHODS:
        raise ValueError(f"{member.filename} is compressed by method {member.compress_type}, not deflated")
    with file.open(member) as stream:
        content = stream.read(member.file_size + 1)
    if len(content) != member.file_size:
        raise ValueError(f"{member.filename} holds {len(content)} bytes, its directory declares {member.file_size}")
    return content


def _array(content: bytes, name: str, kinds: str) -> np.ndarray:
    """The array of an `.npy` file's content, which must hold as many bytes as its header declares."""
    if not content.startswith(NPY_MAGIC):
        raise ValueError("it does not begin as an .npy does")
    stream = io.BytesIO(content)
    shape, by_columns, dtype = _header(stream)
    if dtype.kind not in kinds:
        raise MembraneError(f"{name} is of type {in_one_line(dtype)}; expected numbers{' or text' if TEXT in kinds else ''}")
    held, declared = len(content) - stream.tell(), math.prod(shape) * dtype.itemsize
    if min(shape, default=1) < 0 or held != declared:
        raise ValueError(f"it holds {held} bytes, its header declares {shortened(str(shape))} of {dtype}")
    array = np.frombuffer(content, dtype, math.prod(shape), stream.tell())
    return array.reshape(shape, order="F" if by_columns else "C")


def _header(stream: IO[bytes]) -> tuple[tuple[int, ...], bool, np.dtype[Any]]:
    """Shape, whether the order is Fortran's, and type."""
    version = np.lib.format.read_magic(stream)
    if version == (1, 0):
        return np.lib.format.read_array_header_1_0(stream)
    if version == (2, 0):
        return np.lib.format.read_array_header_2_0(stream)
    raise ValueError(f"its format is {version}, not (1, 0) or (2, 0)")
