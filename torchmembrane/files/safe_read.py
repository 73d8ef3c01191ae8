"""Bounded reading of untrusted files: kind, size and nesting of a file are checked before memory is allocated.

Any fault raises a `MembraneError` with a one-line message that names the file. A file may refer to other files only in its own
folder or below.
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
"""Largest size in bytes of a file of arrays, and of all arrays read from it together."""
MOST_ARRAYS = 64
"""Largest number of arrays in a file."""
NUMBERS, TEXT = "biuf", "U"
"""Kind codes of numpy dtypes."""
NPY_MAGIC = b"\x93NUMPY"
PLAIN_METHODS = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)
ENTRY_MARK = b"PK\x01\x02"  # begins every entry of a zip file's directory
DAMAGE = (
    *(OSError, ValueError, TypeError, ArithmeticError, LookupError, AttributeError, EOFError, RuntimeError, SyntaxError),
    *(MemoryError, struct.error, tokenize.TokenError, zipfile.BadZipFile, zlib.error),
)
"""Exceptions that zipfile, zlib, numpy and Pillow raise for damaged files."""


class LackingArray(MembraneError):
    """Error for an intact file of arrays that lacks a requested array."""


def read_bytes(path: Path, most: int, expected: str) -> bytes:
    """Return the content of a file.

    Args:
        path: path of a regular file; devices and pipes are not opened.
        most: largest allowed size in bytes.
        expected: what the file should be, for messages.

    Raises:
        MembraneError: the file is missing, is not a regular file, is too large, or cannot be read.

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
    """Return the size of a regular file in bytes, without opening it.

    Args:
        path: as for `read_bytes`.
        most: largest allowed size in bytes.
        expected: what the file should be, for messages.

    Raises:
        FileNotFoundError: the file does not exist.
        MembraneError: the path is not a regular file, or the file is too large.
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
    """Return the text of a UTF-8 file, with or without a byte order mark.

    Args:
        path: as for `read_bytes`.
        most: largest allowed size in bytes.
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
    """Read arrays from an `.npz` file, by name. Sizes are checked before anything is unpacked; nothing is unpickled.

    Args:
        path: path of the file.
        names: names of the arrays to read; other arrays in the file are ignored; None: all.
        expected: what the file should be, for messages.
        kinds: allowed kinds of dtypes, `NUMBERS` or `NUMBERS + TEXT`.

    Raises:
        MembraneError: the file is missing, damaged or too large, or lacks an array.

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
    """Read the array of numbers in an `.npy` file, with the checks of `read_arrays`.

    Args:
        path: path of the file.

    Raises:
        MembraneError: the file is missing, damaged or too large.
    """
    expected = "an array as numpy.save writes it"
    try:
        return _array(read_bytes(path, MOST_ARRAY_BYTES, expected), f"{path}: the array", NUMBERS)
    except MembraneError:
        raise
    except DAMAGE as error:
        raise MembraneError(f"{path}: not readable ({in_one_line(error)}); expected {expected}") from error


def lies_within(name: str) -> bool:
    """Return whether a file name found in another file leads into that file's folder or below, on every operating system.

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
    """Return a message or content from elsewhere as one line of at most 200 characters.

    Example:
        >>> in_one_line("unexpected\\n  end\\a")
        'unexpected end?'
    """
    return shortened(printable(re.sub(r"\s+", " ", str(text))) or type(text).__name__, 200)


def printable(text: object) -> str:
    """Return the text with `?` in place of characters that cannot be printed within a line.

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
    """Return the content of an archive member, which must have the size and checksum declared in the archive's directory."""
    if member.compress_type not in PLAIN_METHODS:
        raise ValueError(f"{member.filename} is compressed by method {member.compress_type}, not deflated")
    with file.open(member) as stream:
        content = stream.read(member.file_size + 1)
    if len(content) != member.file_size:
        raise ValueError(f"{member.filename} holds {len(content)} bytes, but the archive declares {member.file_size}")
    return content


def _array(content: bytes, name: str, kinds: str) -> np.ndarray:
    """Return the array in the content of an `.npy` file, which must have exactly the size that its header declares."""
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
    """Return the shape, whether the order is Fortran's, and the dtype from the header of an `.npy` file."""
    version = np.lib.format.read_magic(stream)
    if version == (1, 0):
        return np.lib.format.read_array_header_1_0(stream)
    if version == (2, 0):
        return np.lib.format.read_array_header_2_0(stream)
    raise ValueError(f"its format is {version}, not (1, 0) or (2, 0)")
