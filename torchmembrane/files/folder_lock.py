"""Folder locks: only one job, or the shards of one job, may write into a folder at a time."""

import zlib
from contextlib import suppress
from pathlib import Path
from types import TracebackType
from typing import NamedTuple

from filelock import BaseFileLock, FileLock, Timeout

from ..errors import MembraneError
from .atomic import make_folder, writing

WRITE_LOCK = ".gate.lock"  # the name that earlier versions lock, too
PATIENCE = 600.0
"""Seconds to wait for the write lock while another shard opens the folder or writes its buffered frames."""


class Shard(NamedTuple):
    """One of `total` disjoint parts of a job. The shard of a frame depends only on the frame's name, so all machines agree on
    it.

    Attributes:
        number: number of this shard, from 1 to `total`.
        total: total number of shards.

    Example:
        >>> shards = [Shard(1, 2), Shard(2, 2)]
        >>> [[shard.holds(name) for shard in shards] for name in ("press", "rest")]
        [[False, True], [True, False]]
    """

    number: int = 1
    total: int = 1

    def holds(self, name: str) -> bool:
        """Return whether a frame of this name belongs to this shard."""
        return zlib.crc32(name.encode()) % self.total == self.number - 1


WHOLE = Shard()
"""The only shard of a job that is not divided."""


class FolderLock:
    """A folder locked for writing: `with FolderLock(folder, shard) as lock`, and `with lock.write_lock` to change its files.

    The locks belong to the operating system, which releases them when the process ends, in whatever way.

    Args:
        folder: folder to lock; it is created if it does not exist.
        shard: the part of a job that is written here; shards of the same division may write at the same time.

    Attributes:
        write_lock: a lock that only one shard can hold at a time.
        alone: whether no other shard was writing when the folder was locked.

    Raises:
        MembraneError: on entering, if another job, the same shard, or a shard of another division is writing to the folder.
    """

    def __init__(self, folder: Path, shard: Shard):
        self.folder, self.shard = folder, shard
        make_folder(folder)
        self.write_lock = FileLock(folder / WRITE_LOCK, timeout=PATIENCE)
        self.alone = True
        self._own = FileLock(folder / _lock_name(shard), timeout=0)

    def __enter__(self) -> "FolderLock":
        with writing(self.folder, self.folder / WRITE_LOCK, self.folder / _lock_name(self.shard)), self.write_lock:
            held = [path.name for path in self.folder.glob(".shard-*.lock") if _is_held(path)]
            self.alone = not held
            division = f"-of-{self.shard.total}.lock"
            if _lock_name(self.shard) in held or not all(name.endswith(division) for name in held):
                raise MembraneError(
                    f"--out {self.folder}: another job is writing there ({_said(held[0])}); wait until it ends, choose another "
                    "folder, or divide the frames between jobs by --shard I/N"
                )
            self._own.acquire()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None) -> None:
        with self.write_lock:
            _remove(self._own)
            self._own.release()
            if not any(self.folder.glob(".shard-*.lock")):
                _remove(self.write_lock)


def _lock_name(shard: Shard) -> str:
    return f".shard-{shard.number}-of-{shard.total}.lock"


def _said(lock: str) -> str:
    number, _, count = lock.removeprefix(".shard-").removesuffix(".lock").partition("-of-")
    return "all frames" if count == "1" else f"shard {number}/{count}"


def _remove(lock: BaseFileLock) -> None:
    """Delete the file of a held lock; a process that waits for the lock notices this and creates a new file."""
    with suppress(OSError):  # Windows keeps open files
        Path(lock.lock_file).unlink()


def _is_held(path: Path) -> bool:
    try:
        with FileLock(path, timeout=0):
            return False
    except Timeout:
        return True
