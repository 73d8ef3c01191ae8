"""Atomic writing of files, and the errors for files that cannot be written."""

import errno
import os
import stat
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from hashlib import blake2b
from pathlib import Path

from ..errors import MembraneError
from ..interruption import unfinished

PARTIAL = ".[0-9a-f]*-[0-9]*.partial"
"""Name pattern of the temporary files that killed processes leave behind."""
ROOM = "room on the disk: free some, or choose another place"
LIMITS = "a file system, and a limit of files' size (ulimit -f), that take so large a file"
WRITABLE = "a place where this user may write"
FOLDER = "a folder that exists"
REMEDIES = {
    **dict.fromkeys((errno.ENOSPC, errno.EDQUOT), ROOM),
    errno.EFBIG: LIMITS,
    **dict.fromkeys((errno.EACCES, errno.EPERM, errno.EROFS), WRITABLE),
    **dict.fromkeys((errno.ENOENT, errno.ENOTDIR), FOLDER),
    errno.ENAMETOOLONG: "a shorter name",
}
"""The text after "expected" in an error message, by the error number."""


@contextmanager
def whole_file(path: str | Path) -> Iterator[Path]:
    """Give a temporary path beside `path` to write to; its file replaces `path` when the block ends without an error.

    An interrupted or failing block leaves `path` as it was. The path to write to is hidden (`.*.partial`), so that readers of a
    folder pass over it, and short, so that it is valid wherever `path` is; each process has its own. A symbolic link at `path`
    is replaced, not followed.

    Args:
        path: the file to write, in a folder that exists.

    Yields:
        The path to write to.

    Raises:
        MembraneError: the file cannot be written: no room, no permission, no such folder, too long a name, or a folder or a
            device at `path`.

    Limitations:
        Of two processes that write one file at the same time, the last one wins. After a loss of power, as opposed to a killed
        process, the file may be empty: nothing is forced to the disk.

    Example:
        >>> import tempfile
        >>> folder = Path(tempfile.mkdtemp())
        >>> with whole_file(folder / "numbers.txt") as partial:
        ...     _ = partial.write_text("1 2 3")
        >>> [found.name for found in folder.iterdir()]
        ['numbers.txt']
    """
    path = Path(path)
    partial = path.with_name(f".{blake2b(os.fsencode(path.name), digest_size=8).hexdigest()}-{os.getpid()}.partial")
    with writing(path, partial), unfinished(partial):
        refuse_other_kind(path)
        partial.unlink(missing_ok=True)
        os.close(os.open(partial, os.O_CREAT | os.O_EXCL | os.O_WRONLY, 0o666))
        yield partial
        partial.replace(path)


def remove_partials(folder: Path, processes: Iterable[int | None]) -> None:
    """Remove the unfinished files of processes that were killed while they wrote to a folder.

    Args:
        folder: where the files are.
        processes: numbers of these processes.
    """
    for left in [path for process in processes for path in folder.glob(f".*-{process}.partial")]:
        left.unlink(missing_ok=True)


def write_bytes(path: str | Path, content: bytes | memoryview) -> None:
    """Write a file atomically: completely or not at all.

    Args:
        path: the file, in a folder that exists.
        content: its bytes.

    Raises:
        MembraneError: as for `whole_file`.
    """
    with whole_file(path) as partial:
        partial.write_bytes(content)


def write_text(path: str | Path, text: str) -> None:
    """Write text encoded as UTF-8, atomically as `write_bytes` does."""
    write_bytes(path, text.encode("utf-8"))


@contextmanager
def writing(path: Path, *others: Path) -> Iterator[None]:
    """Turn operating system errors raised in the block into errors that name the file.

    Args:
        path: the file that is written.
        *others: temporary names under which the file is written.

    Raises:
        MembraneError: replaces an `OSError` that names no file, or one of these files.

    Example:
        >>> with writing(Path("press.npz")):
        ...     raise OSError(errno.ENOSPC, "No space left on device")
        Traceback (most recent call last):
        ...
        torchmembrane.errors.MembraneError: press.npz: not written (No space left on device); expected room on the disk: free \
some, or choose another place
    """
    try:
        yield
    except OSError as error:
        named = None if error.filename is None else os.fsdecode(error.filename).removeprefix("file:")  # FFmpeg's
        ours = named is None or os.path.abspath(named) in map(os.path.abspath, (path, *others))
        if not ours or error.errno is None:
            raise
        expected = REMEDIES.get(error.errno, WRITABLE)
        raise MembraneError(f"{path}: not written ({os.strerror(error.errno)}); expected {expected}") from error


def make_folder(path: str | Path) -> Path:
    """Create a folder and its missing parents.

    Args:
        path: the folder.

    Returns:
        The path.

    Raises:
        MembraneError: the folder cannot be created, or a file of this name exists.
    """
    path = Path(path)
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        if error.errno == errno.EEXIST:
            raise MembraneError(f"{path}: is a file; expected a folder, or none yet") from error
        expected = REMEDIES.get(error.errno or 0, WRITABLE)
        raise MembraneError(f"{path}: folder not made ({error.strerror}); expected {expected}") from error
    return path


def make_subfolder(path: Path) -> Path:
    """Create a folder inside a folder of results; refuse a symbolic link in its place.

    Raises:
        MembraneError: as for `make_folder`; or the path is a symbolic link.
    """
    if path.is_symlink():
        raise MembraneError(f"{path}: is a symbolic link to {os.readlink(path)}; expected a folder of its own: remove the link")
    return make_folder(path)


def refuse_other_kind(path: Path) -> None:
    """Refuse to replace a folder or a device with a file.

    Raises:
        MembraneError: the path is a folder or a device.
        OSError: the path cannot be examined because its name is too long.
    """
    try:
        mode = path.lstat().st_mode
    except FileNotFoundError:
        return
    if not (stat.S_ISREG(mode) or stat.S_ISLNK(mode)):
        raise MembraneError(f"{path}: is a {kind_of(mode)}; expected the name of a file")


def kind_of(mode: int) -> str:
    """Return a word for the kind of a file that is not a regular file, from its `os.stat` mode."""
    kinds = {stat.S_IFDIR: "folder", stat.S_IFIFO: "pipe", stat.S_IFSOCK: "socket"}
    return kinds.get(stat.S_IFMT(mode), "device")
