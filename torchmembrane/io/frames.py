"""The frames of a folder of results, each as its own NAME.npz or as a row of one Parquet dataset: both speak alike."""

import json
import zipfile
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import MembraneError
from .atomic import whole_file
from .optional import load_pyarrow
from .results import Reconstruction, completed, load_frame, save_frame
from .store import MESH, Mesh, check_folder

PART_ROWS = 256
"""Frames of one Parquet file; what a killed run can lose at most."""

Frame = dict[str, np.ndarray]
"""One frame's arrays, as `Reconstruction.frame` gives them."""


def open_folder(folder: str | Path, mesh: Mesh) -> "FrameFiles | FrameTable":
    """The frames of a folder that is made if need be.

    Raises:
        MembraneError: what `check_folder` refuses.
    """
    folder = Path(folder)
    check_folder(folder, mesh.sensor, mesh.settings)
    frames = frames_of(folder, mesh)
    if not (folder / MESH).exists():
        folder.mkdir(parents=True, exist_ok=True)
        mesh.save(folder / MESH)
    return frames


def frames_of(folder: Path, mesh: Mesh) -> "FrameFiles | FrameTable":
    """The frames of a folder whose mesh this is."""
    return FrameTable(folder / "frames", mesh) if mesh.format == "parquet" else FrameFiles(folder)


class FrameFiles:
    """Frames as one NAME.npz each."""

    def __init__(self, folder: Path):
        self.folder = folder

    def statuses(self) -> dict[str, int]:
        """Name and status of every frame stored; files that hold no result are left out."""
        found = {p.stem: _stored_status(p) for p in self.folder.glob("*.npz") if p.name != MESH}
        return {name: status for name, status in found.items() if status is not None}

    def read(self, names: Iterable[str]) -> list[Frame]:
        """The frames of these names, in their order."""
        return [load_frame(self.folder / f"{name}.npz") for name in names]

    def write(self, name: str, frame: Frame) -> None:
        """Store a frame, in place of an earlier one of its name."""
        save_frame(self.folder / f"{name}.npz", frame)

    def forget(self, name: str) -> None:
        """Take a frame away, if it is there."""
        (self.folder / f"{name}.npz").unlink(missing_ok=True)

    def flush(self) -> None:
        """Nothing is held back."""


def _stored_status(path: Path) -> int | None:
    try:
        with np.load(path) as data:
            return int(data["status"])
    except (KeyError, OSError, ValueError, EOFError, TypeError, zipfile.BadZipFile):
        return None


class FrameTable:
    """Frames as rows of `part-*.parquet`: a column `name`, and the keys of `Reconstruction`, arrays as flat lists.

    The schema's metadata hold the shapes (`shapes`, JSON: key to shape), units and the sensor's fingerprint. No name is
    in two rows at any time. Rows are held back until `PART_ROWS` of them make a file; `flush` writes the rest.
    """

    def __init__(self, folder: Path, mesh: Mesh):
        self.arrow, self.parquet = load_pyarrow()
        self.folder = folder
        self.waiting: dict[str, Frame] = {}
        self.metadata = {key: getattr(mesh, key) for key in ("length_unit", "force_unit", "name", "sensor")}
        self.part_of = {name: part for part in self._parts() for name in self._column(part, "name")}

    def statuses(self) -> dict[str, int]:
        """Name and status of every frame, stored or held back."""
        pairs = (zip(self._column(p, "name"), self._column(p, "status"), strict=True) for p in self._parts())
        return dict(pair for part in pairs for pair in part) | {n: int(f["status"]) for n, f in self.waiting.items()}

    def read(self, names: Iterable[str]) -> list[Frame]:
        """The frames of these names, in their order; each part that holds one is read once."""
        names, found = list(names), dict(self.waiting)
        for part in {self.part_of[name] for name in names if name in self.part_of}:
            found |= self._frames_of(self.parquet.read_table(part))
        return [found[name] for name in names]

    def write(self, name: str, frame: Frame) -> None:
        """Hold a frame back until `PART_ROWS` of them make a file."""
        self.waiting[name] = frame
        if len(self.waiting) >= PART_ROWS:
            self.flush()

    def forget(self, name: str) -> None:
        """Take a frame away, if it is there."""
        self.waiting.pop(name, None)
        self._drop([name])

    def flush(self) -> None:
        """Write the frames that are held back."""
        if not self.waiting:
            return
        self.folder.mkdir(exist_ok=True)
        self._drop(self.waiting)
        last = max((int(p.stem.rpartition("-")[2]) for p in self._parts()), default=-1)
        part = self.folder / f"part-{last + 1:05d}.parquet"
        self._save(self._table(self.waiting), part)
        self.part_of |= dict.fromkeys(self.waiting, part)
        self.waiting = {}

    def _parts(self) -> list[Path]:
        return sorted(self.folder.glob("part-*.parquet"))

    def _column(self, part: Path, key: str) -> list[Any]:
        try:
            return list(self.parquet.read_table(part, columns=[key])[key].to_pylist())
        except (OSError, ValueError, KeyError) as error:
            raise MembraneError(f"{part}: not a part of torchmembrane's results ({error}); move it away") from error

    def _drop(self, names: Iterable[str]) -> None:
        """Take rows out of the parts that hold them."""
        stale = [name for name in names if name in self.part_of]
        for part in {self.part_of.pop(name) for name in stale}:
            table = self.parquet.read_table(part)
            keep = self.arrow.array([name not in stale for name in table["name"].to_pylist()])
            rest = table.filter(keep)
            if len(rest):
                self._save(rest, part)
            else:
                part.unlink()

    def _table(self, frames: dict[str, Frame]) -> Any:
        columns, shapes = {"name": self.arrow.array(list(frames))}, {}
        for key in Reconstruction._fields:
            values = np.stack([frame[key] for frame in frames.values()])
            shapes[key], flat = list(values.shape[1:]), self.arrow.array(values.ravel())
            size = int(np.prod(shapes[key]))
            columns[key] = self.arrow.FixedSizeListArray.from_arrays(flat, size) if shapes[key] else flat
        return self.arrow.table(columns).replace_schema_metadata(self.metadata | {"shapes": json.dumps(shapes)})

    def _frames_of(self, table: Any) -> dict[str, Frame]:
        shapes = json.loads(table.schema.metadata[b"shapes"])
        columns = {}
        for key, shape in shapes.items():
            column = table[key].combine_chunks()
            values = (column.flatten() if shape else column).to_numpy(zero_copy_only=False)
            columns[key] = values.reshape(len(table), *shape)
        return {name: completed({k: v[i] for k, v in columns.items()}) for i, name in enumerate(table["name"].to_pylist())}

    def _save(self, table: Any, part: Path) -> None:
        with whole_file(part) as partial:
            self.parquet.write_table(table, partial)
