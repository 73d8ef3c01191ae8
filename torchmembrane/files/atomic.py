"""Files that are there whole or not at all."""

import os
from collections.abc import Iterator
from contextlib import contextmanager
from hashlib import blake2b
from pathlib import Path

PARTIAL = ".*.partial"
"""Pattern of what killed processes leave behind."""


@contextmanager
def whole_file(path: str | Path) -> Iterator[Path]:
    """A path beside `path` to write to; what is written there replaces `path` when the block ends well.

    An interrupted or failing block leaves `path` as it was. The path to write to is hidden (`.*.partial`), so that readers of a
    folder pass over it, and short, so that it exists wherever `path` can; each process has its own.

    Args:
        path: the file to write, in a folder that exists.

    Yields:
        The path to write to.

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
    try:
        yield partial
        partial.replace(path)
    finally:
        partial.unlink(missing_ok=True)
