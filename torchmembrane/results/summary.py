"""summary.csv: one row for every frame of a folder of results."""

import csv
from collections.abc import Callable
from contextlib import AbstractContextManager
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from ..files.atomic import whole_file
from ..files.order import in_order
from ..files.provenance import printable
from ..files.safe_read import regular_size
from .npz import Stored
from .status import Status
from .store import Mesh

SUMMARY = "summary.csv"
EXPECTED = "a table of results: delete it, it is made from the frames"
MOST_BYTES = 2**30
LONGEST_LINE = 2**16
UNREADABLE = -1
"""Status of a file that gave no image, hence no result."""
OF_FILE = ("name", "file", "status", "status_text")
OF_FRAME = (
    *("markers_found", "markers_total", "residual_px", "pressure", "pressure_change"),
    *("force", "force_x", "force_y", "force_z", "contacts", "contact_x", "contact_y", "contact_z", "contact_force"),
    *("deepest", "deepest_x", "deepest_y", "deepest_z", "volume_error", "seconds", "content_hash"),
)
UNITS = ("length_unit", "force_unit")
COLUMNS = (*OF_FILE, *OF_FRAME, *UNITS)
TEXT = ("name", "file", "status_text", "content_hash", *UNITS)
"""Columns of text, which the names of files, damaged images, results and `mesh.npz` give."""
FORMULA = ("=", "+", "-", "@", "\t", "\r", "\n", "＝", "＋", "－", "＠")
"""What a spreadsheet takes for a formula when a cell begins with it, spaces aside: such a text gets a ' before it."""


class Summary:
    """summary.csv, made from the frames; the file itself tells only of unreadable ones, and of other shards' frames.

    Args:
        folder: the folder of results.
        mesh: what its frames share.
        gate: held while the file is changed.
    """

    def __init__(self, folder: Path, mesh: Mesh, gate: AbstractContextManager[Any]):
        self.path, self.mesh, self.gate = folder / SUMMARY, mesh, gate
        self.rows: dict[str, dict[str, str]] = {}

    def add(self, name: str, stored: Stored) -> None:
        """A row from a stored frame."""
        frame, origin, seconds = stored
        depth, lowest, patches = self.mesh.normal_displacement(frame), [np.nan] * 4, np.isfinite(frame["contact_points"]).all(1)
        if np.isfinite(depth).all():
            lowest = [depth.min(), *frame["vertices"][depth.argmin()]]
        strongest = [*frame["contact_points"][0], np.linalg.norm(frame["contact_force"][0])] if patches.size else [np.nan] * 4
        status, found = int(frame["status"]), frame["confidence"] > 0
        before = [*(frame[key] for key in ("residual", "pressure", "pressure_change")), np.linalg.norm(frame["force"])]
        cells = [
            *map(_number, [*before, *frame["force"]]),
            patches.sum(),
            *map(_number, [*strongest, *lowest, frame["volume_error"], seconds]),
        ]
        self._set(name, origin.path, status, Status(status).text, found.sum(), found.size, *cells, origin.content_hash)

    def add_unreadable(self, name: str, file: Path, reason: str) -> None:
        """A row for a file that gave no image."""
        self._set(name, printable(str(file)), UNREADABLE, f"unreadable: {reason}", *[""] * len(OF_FRAME))

    def write(self, kept: Callable[[dict[str, str]], bool] = lambda row: True) -> None:
        """Write the rows added since the last time beside those of the file that are kept, in name order."""
        with self.gate:
            rows = {row["name"]: row for row in _rows(self.path) if kept(row)} | self.rows
            with whole_file(self.path) as unfinished, open(unfinished, "w", newline="", encoding="utf-8") as file:
                writer = csv.DictWriter(file, COLUMNS)
                writer.writeheader()
                for name in sorted(rows, key=in_order):
                    writer.writerow({key: _escaped(key, rows[name][key]) for key in COLUMNS})
        self.rows = {}

    def _set(self, *values: object) -> None:
        cells = [str(value) for value in (*values, self.mesh.length_unit, self.mesh.force_unit)]
        row = dict(zip(COLUMNS, cells, strict=True))
        self.rows[row["name"]] = row


def _rows(path: Path) -> list[dict[str, str]]:
    """The whole rows of an earlier summary.csv; those of other columns, or damaged, are left out."""
    try:
        regular_size(path, MOST_BYTES, EXPECTED)
        with open(path, newline="", encoding="utf-8", errors="replace") as file:
            lines = (line.replace("\0", "") for line in iter(partial(file.readline, LONGEST_LINE), ""))
            found = [row for row in csv.DictReader(lines) if tuple(row) == COLUMNS and _is_whole(row)]
    except (FileNotFoundError, csv.Error):
        return []
    return [{key: _unescaped(key, cell) for key, cell in row.items()} for row in found]


def _is_whole(row: dict[str, Any]) -> bool:
    """Whether a row has all its cells, and numbers where they belong."""
    try:
        return None not in row.values() and all(key in TEXT or not cell or float(cell) is not None for key, cell in row.items())
    except ValueError:
        return False


def _escaped(key: str, cell: str) -> str:
    return f"'{cell}" if key in TEXT and _is_formula(cell) else cell


def _unescaped(key: str, cell: str) -> str:
    return cell[1:] if key in TEXT and cell.startswith("'") and _is_formula(cell) else cell


def _is_formula(cell: str) -> bool:
    return cell.lstrip("' ").startswith(FORMULA)


def _number(value: np.ndarray | float) -> str:
    return f"{value:.6g}" if np.isfinite(value) else ""
