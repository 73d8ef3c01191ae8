"""Results on disk: `mesh.npz` once, and every frame either as its own NAME.npz or as a row of one Parquet dataset."""

import json
import zipfile
from pathlib import Path
from typing import NamedTuple

import numpy as np

from ..errors import MembraneError
from .atomic import whole_file
from .optional import load_pyarrow
from .results import NOT_CONVERGED, OK, Reconstruction, load_frame, save_frame, stack_frames

FINISHED = (OK, NOT_CONVERGED)
"""Status of frames that are not tried again."""
FORMATS = ("npz", "parquet")
MESH = "mesh.npz"
PART_ROWS = 256
"""Frames of one Parquet file; what a killed run can lose at most."""


class Settings(NamedTuple):
    """The choices that shape a result, besides the sensor: all frames of a folder share them."""

    estimator: str
    energy: str
    element: str
    format: str


class Mesh(NamedTuple):
    """What all frames of a folder share, as stored in `mesh.npz`.

    rest_vertices   [V, 3]  the rest surface, camera frame
    rest_normals    [V, 3]  unit, outward
    triangles       [T, 3]  int64, outward
    fixed           [V]     bool, the rim
    grid            [2]     int64, `V = grid[0] * grid[1]`, row-major
    vertex_pixels   [V, 2]  where the rest vertices are seen
    rest_pixels     [D, 2]  where the markers are seen at rest
    image_size      [2]     int64, width and height, px
    length_unit, force_unit, name    of the sensor
    sensor          fingerprint of its file
    estimator, energy, element, format    the `Settings`
    """

    rest_vertices: np.ndarray
    rest_normals: np.ndarray
    triangles: np.ndarray
    fixed: np.ndarray
    grid: np.ndarray
    vertex_pixels: np.ndarray
    rest_pixels: np.ndarray
    image_size: np.ndarray
    length_unit: str
    force_unit: str
    name: str
    sensor: str
    estimator: str
    energy: str
    element: str
    format: str

    @classmethod
    def of(cls, reconstructor, settings: Settings) -> "Mesh":
        """What the frames of a `Reconstructor` share."""
        sensor, membrane = reconstructor.sensor, reconstructor.estimator.membrane
        single = lambda a: a.detach().cpu().numpy().astype(np.float32)  # noqa: E731
        return cls(
            single(membrane.rest), single(membrane.rest_normals),
            membrane.triangles.cpu().numpy().astype(np.int64), membrane.fixed.cpu().numpy(), np.array(membrane.grid),
            single(reconstructor.vertex_pixels), single(reconstructor.rest_pixels), np.array(sensor.camera.image_size),
            sensor.length_unit, sensor.force_unit, sensor.name, sensor.fingerprint, *settings,
        )  # fmt: skip

    @classmethod
    def load(cls, path: str | Path) -> "Mesh":
        """Read `mesh.npz`; raises `MembraneError` if it is not one."""
        try:
            with np.load(path) as data:
                arrays = [data[key] for key in cls._fields]
        except FileNotFoundError as error:
            raise MembraneError(f"{path}: no such file; expected the {MESH} that is written beside results") from error
        except (KeyError, OSError, ValueError, EOFError, TypeError, zipfile.BadZipFile) as error:
            raise MembraneError(f"{path}: not a {MESH} of torchmembrane ({error})") from error
        return cls(*(array.item() if array.ndim == 0 else array for array in arrays))

    def save(self, path: str | Path) -> None:
        """Write `mesh.npz`, whole or not at all."""
        save_frame(path, self._asdict())

    @property
    def settings(self) -> Settings:
        return Settings(self.estimator, self.energy, self.element, self.format)

    def normal_displacement(self, frame: dict[str, np.ndarray]) -> np.ndarray:
        """Displacement along the rest normals, `[V]`, length unit: negative where the membrane is pressed in."""
        return (frame["displacement"] * self.rest_normals).sum(-1)


def check_folder(folder: str | Path, sensor: str, settings: Settings) -> None:
    """Refuse a folder whose results are of another sensor (fingerprint) or of other settings, or no results at all."""
    folder = Path(folder)
    if folder.exists() and not folder.is_dir():
        raise MembraneError(f"--out {folder}: is a file; expected a folder, new or of earlier results of this sensor")
    if not (folder / MESH).exists():
        if any(folder.glob("*.npz")) or (folder / "frames").exists():
            raise MembraneError(f"--out {folder}: holds .npz files or frames/ but no {MESH}; choose another folder")
        return
    mesh = Mesh.load(folder / MESH)
    if mesh.sensor != sensor:
        raise MembraneError(
            f"--out {folder}: holds results of another sensor, {mesh.name!r} ({mesh.sensor[:12]}, here {sensor[:12]}); "
            "choose another folder"
        )
    for option, before, now in zip(Settings._fields, mesh.settings, settings, strict=True):
        if before != now:
            raise MembraneError(
                f"--out {folder}: was made with {option} {before}, this call asks for {now}; "
                f"choose another folder, or pass --{option} {before}"
            )


def open_folder(folder: str | Path, mesh: Mesh) -> "FrameFiles | FrameTable":
    """The frames of a folder that is made if need be; refuses what `check_folder` refuses."""
    folder = Path(folder)
    check_folder(folder, mesh.sensor, mesh.settings)
    frames = _frames(folder, mesh)
    if not (folder / MESH).exists():
        folder.mkdir(parents=True, exist_ok=True)
        mesh.save(folder / MESH)
    return frames


def read_results(folder: str | Path) -> tuple[list[str], Reconstruction]:
    """All frames of a folder of either format, in name order: names, and a batch (failed ones NaN, with their status).

    Raises `MembraneError` where there are none.
    """
    folder = Path(folder)
    frames = _frames(folder, Mesh.load(folder / MESH))
    names = sorted(frames.statuses())
    if not names:
        raise MembraneError(f"{folder}: no frames; expected results of `torchmembrane reconstruct`")
    return names, stack_frames(frames.read(names))


def _frames(folder: Path, mesh: Mesh):
    return FrameTable(folder / "frames", mesh) if mesh.format == "parquet" else FrameFiles(folder)


class FrameFiles:
    """Frames as one NAME.npz each."""

    def __init__(self, folder: Path):
        self.folder = folder

    def statuses(self) -> dict[str, int]:
        """Name and status of every frame stored; files that hold no result are left out."""
        found = {p.stem: _stored_status(p) for p in self.folder.glob("*.npz") if p.name != MESH}
        return {name: status for name, status in found.items() if status is not None}

    def read(self, names) -> list[dict[str, np.ndarray]]:
        return [load_frame(self.folder / f"{name}.npz") for name in names]

    def write(self, name: str, frame: dict[str, np.ndarray]) -> None:
        save_frame(self.folder / f"{name}.npz", frame)

    def forget(self, name: str) -> None:
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
        self.folder, self.waiting = folder, {}
        self.metadata = {key: getattr(mesh, key) for key in ("length_unit", "force_unit", "name", "sensor")}
        self.part_of = {name: part for part in self._parts() for name in self._column(part, "name")}

    def statuses(self) -> dict[str, int]:
        pairs = (zip(self._column(p, "name"), self._column(p, "status"), strict=True) for p in self._parts())
        return dict(pair for part in pairs for pair in part) | {n: int(f["status"]) for n, f in self.waiting.items()}

    def read(self, names) -> list[dict[str, np.ndarray]]:
        names, found = list(names), dict(self.waiting)
        for part in {self.part_of[name] for name in names if name in self.part_of}:
            found |= self._frames_of(self.parquet.read_table(part))
        return [found[name] for name in names]

    def write(self, name: str, frame: dict[str, np.ndarray]) -> None:
        self.waiting[name] = frame
        if len(self.waiting) >= PART_ROWS:
            self.flush()

    def forget(self, name: str) -> None:
        self.waiting.pop(name, None)
        self._drop([name])

    def flush(self) -> None:
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

    def _column(self, part: Path, key: str) -> list:
        try:
            return self.parquet.read_table(part, columns=[key])[key].to_pylist()
        except (OSError, ValueError, KeyError) as error:
            raise MembraneError(f"{part}: not a part of torchmembrane's results ({error}); move it away") from error

    def _drop(self, names) -> None:
        """Take rows out of the parts that hold them."""
        stale = [name for name in names if name in self.part_of]
        for part in {self.part_of.pop(name) for name in stale}:
            table = self.parquet.read_table(part)
            keep = self.arrow.array([name not in stale for name in table["name"].to_pylist()])
            rest = table.filter(keep)
            self._save(rest, part) if len(rest) else part.unlink()

    def _table(self, frames: dict[str, dict[str, np.ndarray]]):
        columns, shapes = {"name": self.arrow.array(list(frames))}, {}
        for key in Reconstruction._fields:
            values = np.stack([frame[key] for frame in frames.values()])
            shapes[key], flat = list(values.shape[1:]), self.arrow.array(values.ravel())
            size = int(np.prod(shapes[key]))
            columns[key] = self.arrow.FixedSizeListArray.from_arrays(flat, size) if shapes[key] else flat
        return self.arrow.table(columns).replace_schema_metadata(self.metadata | {"shapes": json.dumps(shapes)})

    def _frames_of(self, table) -> dict[str, dict[str, np.ndarray]]:
        shapes = json.loads(table.schema.metadata[b"shapes"])
        columns = {}
        for key, shape in shapes.items():
            column = table[key].combine_chunks()
            values = (column.flatten() if shape else column).to_numpy(zero_copy_only=False)
            columns[key] = values.reshape(len(table), *shape)
        return {name: {k: v[i] for k, v in columns.items()} for i, name in enumerate(table["name"].to_pylist())}

    def _save(self, table, part: Path) -> None:
        with whole_file(part) as partial:
            self.parquet.write_table(table, partial)
