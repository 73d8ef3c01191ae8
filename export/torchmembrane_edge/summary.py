"""The table summary.csv of a results folder, with a row for every frame, in the format of `torchmembrane reconstruct`."""

import csv
import io
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from .errors import printable
from .images import numbered
from .results import write
from .session import Session
from .summary_row import NAMES, Column, cell, completed, escaped, in_units, numbers

SUMMARY, DICTIONARY = "summary.csv", "summary_columns.csv"
UNREADABLE = -1
"""Status of a frame without a readable image."""


class Summary:
    """The table of a folder: rows of this call, and rows of earlier calls for other frames.

    Arguments: `folder`, the folder of the results; `session`, the session that computed them.
    """

    def __init__(self, folder: Path, session: Session):
        self.path, self.session = folder / SUMMARY, session
        self.rows = {row["name"]: row for row in _rows(self.path)}

    def add(self, name: str, file: Path, text: str, frame: Mapping[str, np.ndarray] | None, origin: Mapping[str, Any]) -> None:
        """Add a row for a frame; `frame`: its arrays, None if the file gave no image; `origin`: `time`, `seconds` and
        `content_hash`, as far as they are known."""
        session, found = self.session, {}
        if frame is not None:
            mesh = session.mesh
            found = numbers(frame, mesh["rest_normals"], session.length_unit, session.force_unit)
            found |= {key: origin[key] for key in ("time", "seconds")}
        cells = {key: cell(key, value) for key, value in found.items()}
        cells |= {"name": name, "file": printable(file), "status_text": text, "content_hash": origin.get("content_hash", "")}
        cells |= {"status": str(UNREADABLE if frame is None else int(frame["status"]))}
        cells |= {"length_unit": session.length_unit, "force_unit": session.force_unit}
        row = dict.fromkeys(NAMES, "") | cells
        written = {key: escaped(key, text) for key, text in row.items()}
        self.rows[written["name"]] = written

    def remove(self, name: str) -> None:
        """Remove the row of a frame whose result has been removed."""
        self.rows.pop(escaped("name", name), None)

    def write(self) -> None:
        """Write the table in the order of the frames' names, and the file that explains its columns."""
        write(self.path, _table(NAMES, (self.rows[name] for name in sorted(self.rows, key=numbered))))
        columns = in_units(self.session.length_unit, self.session.force_unit)
        write(self.path.with_name(DICTIONARY), _table(Column._fields, (column._asdict() for column in columns)))


def _table(header: Iterable[str], rows: Iterable[Mapping[str, str]]) -> bytes:
    text = io.StringIO(newline="")
    writer = csv.DictWriter(text, list(header))
    writer.writeheader()
    writer.writerows(rows)
    return text.getvalue().encode()


def _rows(path: Path) -> list[dict[str, str]]:
    """Return the rows of an earlier table as written; an empty list if its columns differ or it cannot be read."""
    try:
        text = path.read_text(encoding="utf-8", errors="replace").replace("\0", "")
        rows = csv.DictReader(io.StringIO(text, newline=""))
        return [row for each in rows if None not in each.values() and (row := completed(each))]
    except (OSError, csv.Error):
        return []
