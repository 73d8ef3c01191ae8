"""Functions of arrays as machine code, made by numba at their first call: loops without Python, for one frame at a time."""

import hashlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numba
import numpy as np

OPTIONS: dict[str, Any] = dict(nogil=True, error_model="numpy", fastmath={"contract", "reassoc", "nsz"})
"""NaN and infinity are what they are, sums come in any order."""

INNER: dict[str, Any] = dict(no_cpython_wrapper=True, no_cfunc_wrapper=True)

compiled = numba.njit(**OPTIONS, **INNER)
"""Of a function that others call, not Python: its arguments would take as long to unpack as it takes to compile."""


def kept(function: Callable[..., Any]) -> Any:
    """A function that Python calls, compiled and kept on disk, beside its file or in the user's cache, until that file changes;
    in this process alone where neither can be written.

    Example:
        >>> kept(lambda x: 2 * x)(3)
        6
    """
    try:
        return numba.njit(cache=True, **OPTIONS)(function)
    except RuntimeError:  # numba's, of a place to write
        return numba.njit(**OPTIONS)(function)


def fingerprint(*files: str | None) -> str:
    """Of the contents of source files: a `kept` function in whose closure it is, is made anew where one of them has changed."""
    return hashlib.sha256(b"".join(Path(file).read_bytes() for file in files if file)).hexdigest()


def aligned(size: int, dtype: np.dtype) -> np.ndarray:
    """Zeros that begin at a multiple of 64 bytes.

    Example:
        >>> aligned(3, np.dtype("float32")).ctypes.data % 64
        0
    """
    whole = np.zeros(size + 64, dtype)
    first = -whole.ctypes.data % 64 // whole.itemsize
    return whole[first : first + size]
