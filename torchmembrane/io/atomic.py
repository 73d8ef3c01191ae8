"""Files that are there whole or not at all."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


@contextmanager
def whole_file(path: str | Path) -> Iterator[Path]:
    """A path beside `path` to write to; what is written there replaces `path` when the block ends well.

    An interrupted or failing block leaves `path` as it was. The path to write to is hidden (`.NAME.partial`), so that readers
    of a folder pass over it.

    Args:
        path: the file to write, in a folder that exists.

    Yields:
        The path to write to.

    Limitations:
        Two processes that write one file at the same time disturb each other. After a loss of power, as opposed to a killed
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
    partial = path.with_name(f".{path.name}.partial")
    try:
        yield partial
        partial.replace(path)
    finally:
        partial.unlink(missing_ok=True)
