"""Bounded reading of Parquet files: the sizes that a file declares are checked before memory is allocated."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import MembraneError
from .optional import load_pyarrow
from .safe_read import DAMAGE, in_one_line, regular_size

MOST_BYTES = 2**30
"""Largest size in bytes of a file, and of the columns read from it in memory."""
VALUE_BYTES = 8
"""Largest size of one value in bytes."""


def read_table(path: Path, what: str, expected: str, columns: Sequence[str] | None = None) -> Any:
    """Read a Parquet file as a `pyarrow.Table`; checksums are verified if the file has them.

    Args:
        path: path of the file.
        what: what is read, for messages.
        expected: what is expected, for messages.
        columns: names of the columns to read; None: all.

    Raises:
        FileNotFoundError: the file does not exist.
        MembraneError: PyArrow is not installed; the file is damaged, too large, or lacks a column.
    """
    arrow, parquet = load_pyarrow()
    try:
        regular_size(path, MOST_BYTES, what)
        with parquet.ParquetFile(path, page_checksum_verification=True) as file:
            if missing := set(columns or ()) - set(file.schema_arrow.names):
                raise ValueError(f"it has no column {min(missing)}")
            if (size := _declared_bytes(file.metadata)) > MOST_BYTES:
                raise ValueError(f"its columns take {size} bytes, more than {MOST_BYTES}")
            table = file.read(columns)
        table.validate(full=True)
        return table
    except FileNotFoundError:
        raise
    except (*DAMAGE, arrow.ArrowException) as error:
        raise refusal(path, what, expected, error) from error


def nested(values: np.ndarray) -> Any:
    """Convert an array `[rows, ...]` to a column of nested lists of fixed sizes.

    Raises:
        MembraneError: PyArrow is not installed.

    Example:
        >>> str(nested(np.zeros((2, 3, 4), np.float32)).type)
        'fixed_size_list<item: fixed_size_list<item: float>[4]>[3]'
    """
    arrow, _ = load_pyarrow()
    column = arrow.array(values.ravel())
    for size in reversed(values.shape[1:]):
        column = arrow.FixedSizeListArray.from_arrays(column, size)
    return column


def refusal(path: Path, what: str, expected: str, error: object) -> MembraneError:
    """Return the error for a file that is not what it should be."""
    cause = in_one_line(str(error).removeprefix(f"{path}: "))
    return MembraneError(f"{path}: not usable as {what} ({cause}); expected {expected}")


def _declared_bytes(metadata: Any) -> int:
    """Return the memory of all columns as declared in the file's footer; reading the metadata of a single column of a damaged
    file may crash the process."""
    groups = [metadata.row_group(i) for i in range(metadata.num_row_groups)]
    return sum(max(group.total_byte_size, group.num_rows * group.num_columns * VALUE_BYTES) for group in groups)
