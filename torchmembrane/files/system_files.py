"""Files that operating systems and programs leave in folders; they do not count as images of a folder or a glob pattern."""

import re
from pathlib import Path

OF_SYSTEM = re.compile(r"\._.*|\.DS_Store|(eh)?thumbs\.db|desktop\.ini|icon\r", re.IGNORECASE)
"""Names of macOS's attribute files on foreign disks (`._NAME`), and of files that store how a folder is displayed (the
others)."""


def is_of_system(path: Path) -> bool:
    """Return whether macOS or Windows creates files of this name in folders.

    Example:
        >>> [is_of_system(Path("frames") / name) for name in ("._f_1.png", "Thumbs.db", "f_1.png", ".f_1.png")]
        [True, True, False, False]
    """
    return OF_SYSTEM.fullmatch(path.name) is not None


def is_hidden(path: Path) -> bool:
    """Return whether a file is a system file or hidden; programs hide files that they are still writing: `.f_1.png.x7Q2`.

    Example:
        >>> [is_hidden(Path("frames") / name) for name in ("._f_1.png", "desktop.ini", "f_1.png", ".f_1.png")]
        [True, True, False, True]
    """
    return path.name.startswith(".") or is_of_system(path)
