"""The rule by which commands protect the user's files: an existing file is overwritten only with `--force`."""

import os
from collections.abc import Callable, Iterable
from pathlib import Path

from ..errors import MembraneError
from .atomic import refuse_other_kind, writing


def refuse_overwriting(
    command: str,
    targets: Iterable[str | Path],
    read: Iterable[str | Path] = (),
    force: bool = False,
    is_own: Callable[[Path], bool] = lambda path: False,
) -> None:
    """Refuse to overwrite existing files.

    A file that the command reads is never overwritten. A file that, according to `is_own`, an earlier run of the same command
    created is overwritten; any other file only with `force`. A symbolic link is treated as its target if the target is read,
    otherwise as a separate file.

    Args:
        command: name of the command, with which messages begin.
        targets: files that the command is going to write.
        read: files that the command reads.
        force: whether the user allows other files to be overwritten.
        is_own: function that returns whether this command may overwrite an existing file without `force`.

    Raises:
        MembraneError: a file would be lost, or cannot be written at all; the message names the first such file and the remedy.

    Example:
        >>> refuse_overwriting("export", ["examples/sensor.toml"], read=["examples/sensor.toml"], force=True)
        Traceback (most recent call last):
        ...
        torchmembrane.errors.MembraneError: export: would write over examples/sensor.toml, which it reads; choose another name
    """
    there = [path for path in map(Path, targets) if _is_there(path)]
    known = {_identity(Path(path)) for path in read} if there else set()
    for path in there:
        refuse_other_kind(path)
        if _identity(path) in known:
            raise MembraneError(f"{command}: would write over {path}, which it reads; choose another name")
        if not force and not is_own(path):
            raise MembraneError(f"{command}: {path} is there already; choose another name, or pass --force to write over it")


def _is_there(path: Path) -> bool:
    with writing(path):
        try:
            path.lstat()
        except FileNotFoundError:
            return False
    return True


def _identity(path: Path) -> object:
    """Return a key that is equal for all names of one file."""
    try:
        found = os.stat(path)
    except OSError:
        return os.path.realpath(path)
    return found.st_dev, found.st_ino
