"""summary.csv: one row for every frame of a folder of results."""

import csv
from collections.abc import Callable
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np

from .atomic import whole_file
from .frames import PART_ROWS, Frame, FrameFiles, FrameTable
from .status import Status
from .store import Mesh

SUMMARY = "summary.csv"
UNREADABLE = -1
"""Status of a file that gave no image, hence no result."""
OF_FILE = ("name", "file", "status", "status_text")
OF_FRAME = (
    *("markers_found", "markers_total", "residual_px", "pressure", "pressure_change", "force"),
    *("deepest", "deepest_x", "deepest_y", "deepest_z", "volume_error", "seconds"),
)
UNITS = ("length_unit", "force_unit")
COLUMNS = (*OF_FILE, *OF_FRAME, *UNITS)


class Summary:
    """summary.csv: a row for every frame of the folder, finished in this call, before it, or unreadable.

    Rows of an earlier summary.csv are kept where they are up to date, the others are made from the frames.

    Args:
        folder: the folder of results.
        frames: the frames in it.
        stored: their status by name.
        mesh: what they share.
        file_of: from a frame's name to the file that it came from, None where that is not known.
    """

    def __init__(
        self,
        folder: Path,
        frames: FrameFiles | FrameTable,
        stored: dict[str, int],
        mesh: Mesh,
        file_of: Callable[[str], Path | None],
    ):
        self.path, self.mesh = folder / SUMMARY, mesh
        rows = [row for row in _rows(self.path) if row["status"] == str(stored.get(row["name"], UNREADABLE))]
        self.rows = {row["name"]: row for row in rows}
        missing = iter(sorted(stored.keys() - self.rows.keys()))
        while names := list(islice(missing, PART_ROWS)):
            for name, frame in zip(names, frames.read(names), strict=True):
                self.add(name, file_of(name) or "", frame, np.nan)

    def add(self, name: str, file: Path | str, frame: Frame, seconds: float) -> None:
        """A row from a frame's arrays; `seconds` is the time that it took, NaN where it is not known."""
        depth, lowest = self.mesh.normal_displacement(frame), [np.nan] * 4
        if np.isfinite(depth).all():
            lowest = [depth.min(), *frame["vertices"][depth.argmin()]]
        status, found = int(frame["status"]), frame["confidence"] > 0
        pressures = frame["residual"], frame["pressure"], frame["pressure_change"]
        numbers: list[Any] = [*pressures, np.linalg.norm(frame["force"]), *lowest, frame["volume_error"], seconds]
        cells = [_number(number) for number in numbers]
        self._set(name, file, status, Status(status).text, found.sum(), found.size, *cells)

    def add_unreadable(self, name: str, file: Path, reason: str) -> None:
        """A row for a file that gave no image."""
        self._set(name, file, UNREADABLE, f"unreadable: {reason}", *[""] * len(OF_FRAME))

    def _set(self, *values: object) -> None:
        cells = [str(value) for value in (*values, self.mesh.length_unit, self.mesh.force_unit)]
        row = dict(zip(COLUMNS, cells, strict=True))
        self.rows[row["name"]] = row

    def write(self) -> None:
        """Write the file, rows in name order."""
        with whole_file(self.path) as partial, open(partial, "w", newline="", encoding="utf-8") as file:
            writer = csv.DictWriter(file, COLUMNS)
            writer.writeheader()
            writer.writerows(self.rows[name] for name in sorted(self.rows))


def _rows(path: Path) -> list[dict[str, str]]:
    """The rows of an earlier summary.csv; none where it has other columns or is no table."""
    if not path.exists():
        return []
    with open(path, newline="", encoding="utf-8") as file:
        reader = csv.DictReader(file)
        return list(reader) if tuple(reader.fieldnames or ()) == COLUMNS else []


def _number(value: np.ndarray | float) -> str:
    return f"{value:.6g}" if np.isfinite(value) else ""
