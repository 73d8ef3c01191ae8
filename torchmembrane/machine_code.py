"""Compilation of functions of arrays to machine code by numba at their first call, for loops over one frame at a time.

Compilation takes about `SECONDS`, once for each precision; the machine code is cached on disk. To avoid that wait,
`using(False)` switches to tensor operations, which give the same numbers up to rounding.
"""

import hashlib
import logging
import platform
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import AbstractContextManager, contextmanager, nullcontext
from contextvars import ContextVar
from pathlib import Path
from threading import Lock
from typing import Any

import numba
import numpy as np
import torch
from llvmlite.binding import get_host_cpu_name
from torch import Tensor

from .interruption import unstoppable

SECONDS = 60
"""Approximate time to compile the steps for one precision: with the contacts, 70 s on a virtual core of an Intel Xeon with
AVX-512, in `python tests/compile.py float32` with an empty `NUMBA_CACHE_DIR`."""

_used = ContextVar("machine code is used", default=True)


@contextmanager
def using(wanted: bool) -> Iterator[None]:
    """Choose for the block whether machine code or tensor operations are used.

    Example:
        >>> with using(False):
        ...     is_used()
        False
    """
    token = _used.set(wanted)
    try:
        yield
    finally:
        _used.reset(token)


def is_used() -> bool:
    """Return whether machine code may be used here."""
    return _used.get()


def takes(*values: Any) -> bool:
    """Return whether machine code can compute with these tensors: on a CPU, without gradients or `torch.func` transforms."""
    tensors = [value for value in values if value is not None]
    return (
        not torch.compiler.is_compiling()
        and is_used()
        and all(type(value) is Tensor and value.is_cpu for value in tensors)
        and not (torch.is_grad_enabled() and any(value.requires_grad for value in tensors))
        and all(torch.func.debug_unwrap(value, recurse=False) is value for value in tensors)
    )


def in_threads(take: Callable[..., Any], *values: np.ndarray) -> None:
    """Call `take` on parts of the arrays `values [B, ...]`, with as many threads as torch uses, but at most one for a frame."""
    threads = min(torch.get_num_threads(), len(values[0]))
    if threads <= 1:
        take(*values)
    else:
        with ThreadPoolExecutor(threads) as pool:
            list(pool.map(take, *(np.array_split(each, threads) for each in values)))


OPTIONS: dict[str, Any] = dict(nogil=True, error_model="numpy", fastmath={"contract", "reassoc", "nsz"})
"""Options of fast arithmetic: NaN and infinity keep their meaning, and sums may be reordered."""

INNER: dict[str, Any] = dict(no_cpython_wrapper=True, no_cfunc_wrapper=True)

compiled = numba.njit(**OPTIONS, **INNER)
"""Decorate a function that only compiled code calls, not Python: unpacking its arguments would take as long to compile as the
function itself.

To keep compilation fast, pass constant arguments as `np.intp(4)` or `np.bool_(True)`, because a function is compiled again for
each literal, and let loops that need not be unrolled take their length from an array.
"""

inlined = numba.njit(forceinline=True, **OPTIONS, **INNER)
"""The same for a short function of loops over vectors, whose call would take as long as its loop."""


def kept(function: Callable[..., Any]) -> Any:
    """Decorate a function so that it is compiled and cached on disk, beside its file or in the user's cache, until that file
    changes. If neither place can be written, the code is cached in this process only.

    A function is compiled again for each precision and each memory layout of an argument: pass contiguous arrays in row-major
    order.

    Example:
        >>> kept(lambda x: 2 * x)(3)
        6
    """
    try:
        return numba.njit(cache=True, **OPTIONS)(function)
    except RuntimeError:  # numba's, of a place to write
        return numba.njit(**OPTIONS)(function)


class Kept:
    """The compilation state of a `kept` function: the precisions compiled so far, in this process or on disk.

    Args:
        function: the compiled function that `kept` returns.
        sources: `fingerprint` of its source files.
        seconds: approximate time of its compilation, s.
    """

    def __init__(self, function: Any, sources: str, seconds: int = SECONDS):
        self.seconds = seconds
        folder, version = getattr(function.stats, "cache_path", None), f"{platform.python_version()} {numba.__version__}"
        self.folder = Path(folder) if folder else None
        self.key = hashlib.sha256(f"{function.__name__} {sources} {version} {get_host_cpu_name()}".encode()).hexdigest()[:16]
        self.known: set[str] = set()
        self.announced: set[str] = set()
        self.called: set[np.dtype[Any]] = set()
        self.lock = Lock()

    def is_compiled(self, dtype: np.dtype[Any]) -> bool:
        """Return whether machine code for arrays of this precision exists."""
        if dtype.name not in self.known and self.folder and self._mark(dtype).exists():
            self.known.add(dtype.name)
        return dtype.name in self.known

    def compiling(self, dtype: np.dtype[Any]) -> AbstractContextManager[None]:
        """Enclose a call; if the call compiles, log this first and record it afterwards."""
        return nullcontext() if dtype in self.called else self._compiling(dtype)

    @contextmanager
    def _compiling(self, dtype: np.dtype[Any]) -> Iterator[None]:
        with self.lock:  # threads begin their first calls at the same time
            is_new = not self.is_compiled(dtype) and dtype.name not in self.announced
            self.announced.add(dtype.name)
        if is_new:
            logging.getLogger("torchmembrane").warning(
                "torchmembrane: compiling machine code for %s, about %d s, once", dtype.name, self.seconds
            )
        with unstoppable() if is_new else nullcontext():
            yield
        if dtype.name not in self.known:
            self.known.add(dtype.name)
            if self.folder and self.folder.exists():
                self._mark(dtype).touch()
        self.called.add(dtype)

    def _mark(self, dtype: np.dtype[Any]) -> Path:
        assert self.folder is not None
        return self.folder / f"torchmembrane-{self.key}-{dtype.name}.compiled"


def fingerprint(*files: str | None) -> str:
    """Return a hash of source files: a `kept` function with it in its closure is compiled again when one of them changes."""
    return hashlib.sha256(b"".join(Path(file).read_bytes() for file in files if file)).hexdigest()


def aligned(size: int, dtype: np.dtype) -> np.ndarray:
    """Return an array of zeros whose address is a multiple of 64 bytes.

    Example:
        >>> aligned(3, np.dtype("float32")).ctypes.data % 64
        0
    """
    whole = np.zeros(size + 64, dtype)
    first = -whole.ctypes.data % 64 // whole.itemsize
    return whole[first : first + size]
