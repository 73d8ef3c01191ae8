"""Files that operating systems and programs leave in folders; they are not among the images of a folder or a pattern."""

import re
from pathlib import Path

OF_SYSTEM = re.compile(r"\._.*|\.DS_Store|(eh)?thumbs\.db|desktop\.ini|icon\r", re.IGNORECASE)
"""Files that macOS leaves on other systems' disks with a file's attributes (`._NAME`), and views of folders (the others)."""


def is_of_system(path: Path) -> bool:
    """Whether macOS or Windows leaves a file of this name in a folder.

    Example:
        >>> [is_of_system(Path("frames") / name) for name in ("._f_1.png", "Thumbs.db", "f_1.png", ".f_1.png")]
        [True, True, False, False]
    """
    return OF_SYSTEM.fullmatch(path.name) is not None


def is_hidden(path: Path) -> bool:
    """Whether a file is one of a system, or hidden, as programs name files that they are still writing: `.f_1.png.x7Q2`.

    Example:
        >>> [is_hidden(Path("frames") / name) for name in ("._f_1.png", "desktop.ini", "f_1.png", ".f_1.png")]
        [True, True, False, True]
    """
    return path.name.startswith(".") or is_of_system(path)
