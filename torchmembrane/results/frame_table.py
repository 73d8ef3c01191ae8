"""Storage of the frames of a folder of results as rows of one Parquet dataset: small parts are written during the job and
merged into large ones."""

import json
import re
import time
from collections.abc import Callable, Collection, Iterable, Iterator
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

import numpy as np

from ..files.atomic import make_subfolder, whole_file
from ..files.optional import load_pyarrow
from ..files.order import in_order
from ..files.parquet import nested, read_table, refusal
from ..files.provenance import SourceFile
from ..files.safe_read import DAMAGE
from .npz import Stored
from .reconstruction import Frame, Reconstruction
from .status import Status
from .store import Mesh

PART_ROWS = 256
"""Number of frames from which a part is complete."""
PART_BYTES = 2**27
"""Approximate size of the arrays of a complete part; with large surfaces a part contains fewer frames."""
SAVE_SECONDS = 5.0
"""Longest time for which frames are buffered, s."""
PART = re.compile(r"part-\d+")
A_PART = "a part of torchmembrane's results"
AS_WRITTEN = "the file as it was written: the same reconstruct command again sets it aside and does its frames again"
COLUMNS = ("name", "status_text", *SourceFile._fields, "seconds", *Reconstruction._fields)


class FrameTable:
    """Frames as rows of `part-*.parquet`: name, status text, source file, and the fields of `Reconstruction`, whose arrays are
    nested lists of fixed sizes.

    The schema's metadata contain the shapes (`shapes`, a JSON object), the units and the sensor's fingerprint. Rows are
    buffered for `SAVE_SECONDS`, or until `PART_ROWS` of them fill a part.

    Args:
        folder: folder of the parts.
        mesh: the data that the frames share.
        write_lock: lock that is held while parts are changed.

    Attributes:
        damaged: unreadable parts that `stored` has encountered so far; they were renamed.
    """

    def __init__(self, folder: Path, mesh: Mesh, write_lock: AbstractContextManager[Any]):
        self.arrow, self.parquet = load_pyarrow()
        self.folder, self.mesh, self.write_lock = folder, mesh, write_lock
        self.metadata = {key: getattr(mesh, key) for key in ("length_unit", "force_unit", "name", "sensor", "record")}
        self.damaged: list[Path] = []
        self.part_rows = max(1, min(PART_ROWS, PART_BYTES // (60 * len(mesh.rest_vertices) + 30 * len(mesh.rest_pixels) + 300)))
        self._waiting: dict[str, Stored] = {}
        self._held: dict[Path, tuple[tuple[int, int], frozenset[str]]] = {}
        self._saved = time.monotonic()

    def names(self) -> set[str]:
        """Return the names of all frames, stored or buffered."""
        return set().union(self._waiting, *self._index().values())

    def stored(self, wanted: Callable[[str], bool]) -> Iterator[tuple[str, Stored]]:
        """Yield all frames whose names are wanted.

        Parts are repaired in passing: unreadable ones are renamed to `*.damaged`, duplicate rows left by an interrupted merge
        are removed, and parts of earlier versions are rewritten.
        """
        with self.write_lock:
            seen: set[str] = set()
            for part in self._parts():
                try:
                    table = _table(part)
                    rows = _stored_rows(table, part)
                    for stored in rows.values():
                        self.mesh.check(stored.frame, part)
                except DAMAGE:
                    self.damaged.append(part)
                    part.replace(part.with_suffix(".damaged"))
                    continue
                once = {name: stored for name, stored in rows.items() if name not in seen}
                if not once:
                    part.unlink()
                elif len(once) < len(table):
                    self._put(self._table_of(once), part)
                elif tuple(table.column_names) != COLUMNS:
                    self._put(self._table_of(rows), part)
                seen |= once.keys()
                yield from ((name, stored) for name, stored in once.items() if wanted(name))

    def read(self, names: Iterable[str]) -> list[Frame]:
        """Return the frames with these names, in the same order; each part that contains one is read once."""
        names, found = list(names), {name: stored.frame for name, stored in self._waiting.items()}
        for part, held in self._index().items():
            if not held.isdisjoint(names):
                try:
                    found |= read_part(part)
                except FileNotFoundError:  # merged into another one meanwhile
                    return self.read(names)
        return [found[name] for name in names]

    def write(self, name: str, stored: Stored) -> None:
        """Buffer a frame until there are `PART_ROWS` of them, or until `save` writes them."""
        self._waiting[name] = stored
        if len(self._waiting) >= self.part_rows:
            self._flush()

    def forget(self, name: str) -> None:
        """Remove a frame, if it exists."""
        self._waiting.pop(name, None)
        with self.write_lock:
            self._drop([name])

    def save(self) -> None:
        """Write the buffered frames if the last write was at least `SAVE_SECONDS` ago."""
        if time.monotonic() - self._saved >= SAVE_SECONDS:
            self._flush()

    def close(self) -> None:
        """Write the buffered frames, and merge small parts."""
        self._flush()
        with self.write_lock:
            self._merge(least=2)

    def _flush(self) -> None:
        self._saved = time.monotonic()
        if not self._waiting:
            return
        with self.write_lock:
            make_subfolder(self.folder)
            self._drop(self._waiting)
            last = max((int(part.stem.rpartition("-")[2]) for part in self._parts()), default=-1)
            self._put(self._table_of(self._waiting), self.folder / f"part-{last + 1:05d}.parquet")
            self._waiting = {}
            self._merge(least=self.part_rows)

    def _merge(self, least: int) -> None:
        """Merge small parts into one if they have at least `least` rows together. The first of them is replaced and the others
        are deleted; if this is interrupted, some rows exist twice until the folder is opened again."""
        group: dict[Path, int] = {}
        for part, held in self._index().items():
            if len(held) < self.part_rows:
                group[part] = len(held)
            if sum(group.values()) >= self.part_rows:
                self._join(list(group))
                group = {}
        if sum(group.values()) >= least:
            self._join(list(group))

    def _join(self, parts: list[Path]) -> None:
        if len(parts) > 1:
            self._put(self.arrow.concat_tables([_table(part) for part in parts]), parts[0])
            for part in parts[1:]:
                part.unlink()

    def _drop(self, names: Collection[str]) -> None:
        """Remove rows from the parts that contain them."""
        for part, held in self._index().items():
            if held.isdisjoint(names):
                continue
            if held <= set(names):
                part.unlink()
                continue
            table = _table(part)
            self._put(table.filter(self.arrow.array([name not in names for name in _names(table, part)])), part)

    def _parts(self) -> list[Path]:
        return sorted((path for path in self.folder.glob("part-*.parquet") if PART.fullmatch(path.stem)), key=in_order)

    def _index(self) -> dict[Path, frozenset[str]]:
        """Return the names in each part; parts that have not changed are not read again."""
        try:
            versions = {part: _version(part) for part in self._parts()}
            for part, version in versions.items():
                if self._held.get(part, ((), ()))[0] != version:
                    self._held[part] = version, frozenset(_names(_table(part, ["name"]), part))
        except FileNotFoundError:  # merged into another one meanwhile
            return self._index()
        return {part: self._held[part][1] for part in versions}

    def _put(self, table: Any, part: Path) -> None:
        with whole_file(part) as partial:
            self.parquet.write_table(table, partial, use_dictionary=False, compression="zstd", write_page_checksum=True)

    def _table_of(self, rows: dict[str, Stored]) -> Any:
        arrays = [stored.arrays() for stored in rows.values()]
        values = {
            key: np.stack([row[key] for row in arrays]) for key in (*SourceFile._fields, "seconds", *Reconstruction._fields)
        }
        shapes = {key: list(values[key].shape[1:]) for key in Reconstruction._fields}
        columns = {key: nested(value) for key, value in values.items()}
        words = [Status(status).text for status in values["status"]]
        columns |= {"name": self.arrow.array(list(rows)), "status_text": self.arrow.array(words)}
        table = self.arrow.table({key: columns[key] for key in COLUMNS})
        return table.replace_schema_metadata(self.metadata | {"shapes": json.dumps(shapes)})


def read_part(part: Path) -> dict[str, Frame]:
    """Return the frames of one part by name.

    Raises:
        MembraneError: the file is not a part, or damaged.
    """
    table = _table(part)
    try:
        return {name: stored.frame for name, stored in _stored_rows(table, part).items()}
    except DAMAGE as error:
        raise refusal(part, A_PART, AS_WRITTEN, error) from error


def _table(part: Path, columns: list[str] | None = None) -> Any:
    return read_table(part, A_PART, AS_WRITTEN, columns)


def _version(part: Path) -> tuple[int, int]:
    """Return a value that changes when a part is replaced.

    Raises:
        FileNotFoundError: the part does not exist any more.
    """
    try:
        stat = part.stat()
    except OSError as error:
        if isinstance(error, FileNotFoundError) and not part.is_symlink():
            raise
        raise refusal(part, A_PART, AS_WRITTEN, error) from error
    return stat.st_ino, stat.st_mtime_ns


def _names(table: Any, part: Path) -> list[str]:
    names: list[str] = table["name"].to_pylist()
    if not all(isinstance(name, str) for name in names):
        raise refusal(part, A_PART, AS_WRITTEN, "not all its names are text")
    return names


def _stored_rows(table: Any, part: Path) -> dict[str, Stored]:
    columns = {}
    for key, shape in json.loads(table.schema.metadata[b"shapes"]).items():
        values = table[key].combine_chunks()
        while hasattr(values, "flatten") and hasattr(values.type, "list_size"):
            values = values.flatten()
        columns[key] = values.to_numpy(zero_copy_only=False).reshape(len(table), *shape)
    known = {key: table[key].to_pylist() for key in (*SourceFile._fields, "seconds") if key in table.column_names}
    names = _names(table, part)
    values = columns | known
    return {name: Stored.from_arrays({key: column[i] for key, column in values.items()}) for i, name in enumerate(names)}
