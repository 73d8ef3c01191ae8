"""summary.csv: one row for each frame of a folder of results, with a description of its columns in a second file."""

import csv
from collections.abc import Callable, Iterable, Mapping
from contextlib import AbstractContextManager
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import MembraneError
from ..files.atomic import whole_file
from ..files.order import in_order
from ..files.provenance import printable
from ..files.safe_read import regular_size
from .npz import Stored
from .store import Mesh
from .summary_row import NAMES, TEXT, Column, cell, completed, escaped, in_units, numbers, unescaped
from .view_status import status_in_words

SUMMARY, DICTIONARY = "summary.csv", "summary_columns.csv"
EXPECTED = "a table of results: delete it, it is made from the frames"
MOST_BYTES = 2**30
LONGEST_LINE = 2**16
UNREADABLE = -1
"""Status of a file from which no image could be read, so that it has no result."""


class Summary:
    """The table summary.csv, built from the frames; only unreadable files and other shards' frames are taken from the file
    itself.

    A file beside it, summary_columns.csv, gives the meaning and unit of each column.

    Args:
        folder: the folder of results.
        mesh: the data that the frames share.
        write_lock: lock that is held while the files are changed.
    """

    def __init__(self, folder: Path, mesh: Mesh, write_lock: AbstractContextManager[Any]):
        self.path, self.mesh, self.write_lock = folder / SUMMARY, mesh, write_lock
        self.rows: dict[str, dict[str, str]] = {}
        self.removed: set[str] = set()

    def add(self, name: str, stored: Stored) -> None:
        """Add the row of a stored frame."""
        frame, origin, seconds = stored
        mesh, status = self.mesh, int(frame["status"])
        found = numbers(frame | {"gauge": np.asarray(origin.gauge)}, mesh.rest_normals, mesh.length_unit, mesh.force_unit)
        found |= {"time": origin.time, "seconds": seconds}
        words = status_in_words(frame, mesh.view_names.split())
        texts = {"file": origin.path, "status_text": words, "content_hash": origin.content_hash}
        self._set(name, status, texts | {key: cell(key, value) for key, value in found.items()})

    def add_unreadable(self, name: str, file: Path, reason: str) -> None:
        """Add a row for a file from which no image could be read."""
        self._set(name, UNREADABLE, {"file": printable(str(file)), "status_text": f"unreadable: {reason}"})

    def remove(self, name: str) -> None:
        """Remove the row of a frame whose result has been removed."""
        self.rows.pop(name, None)
        self.removed.add(name)

    def write(self, kept: Callable[[dict[str, str]], bool] = lambda row: True) -> None:
        """Write the new rows, together with those of the existing file that `kept` selects, in name order."""
        with self.write_lock:
            earlier = {row["name"]: row for row in _rows(self.path) if kept(row) and row["name"] not in self.removed}
            rows = earlier | self.rows
            lines = ({key: escaped(key, rows[name][key]) for key in NAMES} for name in sorted(rows, key=in_order))
            _write_table(self.path, NAMES, lines)
            columns = in_units(self.mesh.length_unit, self.mesh.force_unit)
            _write_table(self.path.with_name(DICTIONARY), Column._fields, (column._asdict() for column in columns))
        self.rows, self.removed = {}, set()

    def _set(self, name: str, status: int, cells: Mapping[str, str]) -> None:
        known = {"name": name, "status": str(status), "length_unit": self.mesh.length_unit, "force_unit": self.mesh.force_unit}
        self.rows[name] = {**dict.fromkeys(NAMES, ""), **known, **cells}


def read_summary(folder: Path) -> list[dict[str, str]]:
    """Return the rows of a folder's table, each as a dict of cells by column name.

    Raises:
        MembraneError: the table is missing, or has other columns.
    """
    rows = _rows(folder / SUMMARY)
    if not rows:
        raise MembraneError(
            f"{folder / SUMMARY}: no rows with this version's columns; expected a folder of results: the same reconstruct "
            "command again writes its table anew"
        )
    return rows


def _write_table(path: Path, header: Iterable[str], rows: Iterable[dict[str, str]]) -> None:
    with whole_file(path) as unfinished, open(unfinished, "w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, list(header))
        writer.writeheader()
        writer.writerows(rows)


def _rows(path: Path) -> list[dict[str, str]]:
    """Return the complete rows of summary.csv, without damaged rows and rows with other columns; none if the file is missing
    or cannot be parsed as CSV."""
    try:
        regular_size(path, MOST_BYTES, EXPECTED)
        with open(path, newline="", encoding="utf-8", errors="replace") as file:
            lines = (line.replace("\0", "") for line in iter(partial(file.readline, LONGEST_LINE), ""))
            found = [row for each in csv.DictReader(lines) if _is_whole(each) and (row := completed(each))]
    except (FileNotFoundError, csv.Error):
        return []
    return [{key: unescaped(key, text) for key, text in row.items()} for row in found]


def _is_whole(row: dict[str, Any]) -> bool:
    """Return whether a row has all its cells and no more, with numbers where they are required."""
    if None in row or None in row.values():  # more cells than the header, or fewer
        return False
    try:
        return all(key in TEXT or not text or float(text) is not None for key, text in row.items())
    except ValueError:
        return False
