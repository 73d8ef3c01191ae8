"""The frames of a folder of results, stored as one NAME.npz each or as rows of one Parquet dataset, with one interface."""

import os
from collections.abc import Callable, Iterable, Iterator
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path
from typing import Any, TypeAlias

from ..errors import MembraneError
from ..files.atomic import make_folder
from ..files.safe_read import DAMAGE, LackingArray, read_arrays
from ..files.system_files import is_of_system
from .frame_table import FrameTable
from .npz import Stored, load_frame, load_stored, save_frame
from .reconstruction import Frame
from .store import MESH, Mesh, check_folder

Frames: TypeAlias = "FrameFiles | FrameTable"


def open_folder(folder: str | Path, mesh: Mesh, write_lock: AbstractContextManager[Any]) -> Frames:
    """Open the frames of a folder for writing; the folder is created if it does not exist.

    Args:
        folder: folder of the results.
        mesh: the data that the frames share.
        write_lock: lock that is held while files are changed that other processes change as well.

    Raises:
        MembraneError: `check_folder` refuses the folder.
    """
    folder = Path(folder)
    with write_lock:
        check_folder(folder, mesh.sensor, mesh.settings)
        if not (folder / MESH).exists():
            mesh.save(make_folder(folder) / MESH)
    return frames_of(folder, mesh, write_lock)


def frames_of(folder: Path, mesh: Mesh, write_lock: AbstractContextManager[Any] | None = None) -> Frames:
    """Return the frames of the folder to which this mesh belongs."""
    if mesh.format == "parquet":
        return FrameTable(folder / "frames", mesh, write_lock or nullcontext())
    return FrameFiles(folder, mesh)


class FrameFiles:
    """Frames stored as one NAME.npz each, with the fields of `Reconstruction` and of `Stored`.

    Args:
        folder: folder of the files.
        mesh: the data that the frames share.

    Attributes:
        damaged: files that the latest call of `names` or `stored` could not read.
    """

    def __init__(self, folder: Path, mesh: Mesh):
        self.folder, self.mesh = folder, mesh
        self.damaged: list[Path] = []

    def names(self) -> set[str]:
        """Return the names of all stored frames, including damaged ones; files with other arrays are ignored."""
        self.damaged = []
        return {path.stem for path in self._files() if self._is_result(path)}

    def stored(self, wanted: Callable[[str], bool]) -> Iterator[tuple[str, Stored]]:
        """Yield all frames whose names are wanted; afterwards `damaged` lists those that could not be read."""
        self.damaged = []
        for path in self._files():
            if wanted(path.stem):
                try:
                    stored = load_stored(path)
                    self.mesh.check(stored.frame, path)
                except MembraneError:
                    self.damaged.append(path)
                    continue
                yield path.stem, stored

    def read(self, names: Iterable[str]) -> list[Frame]:
        """Return the frames with these names, in the same order."""
        return [load_frame(self._path(name)) for name in names]

    def write(self, name: str, stored: Stored) -> None:
        """Store a frame, replacing one of the same name; a file of that name that is not a frame is renamed."""
        path = self._path(name)
        if path in self.damaged:
            path.replace(path.with_suffix(".damaged"))
            self.damaged.remove(path)
        save_frame(path, stored.arrays())

    def forget(self, name: str) -> None:
        """Remove a frame, if it exists."""
        if os.path.exists(self._path(name)):
            self._path(name).unlink()

    def save(self) -> None:
        """Do nothing: frames are not buffered."""

    def close(self) -> None:
        """Do nothing: frames are not buffered."""

    def _files(self) -> list[Path]:
        return sorted(path for path in self.folder.glob("*.npz") if path.name != MESH and not is_of_system(path))

    def _is_result(self, path: Path) -> bool:
        try:
            return int(read_arrays(path, ["status"])["status"]) >= 0
        except LackingArray:
            return False
        except DAMAGE:
            if not path.is_file():  # a device, or a pipe
                return False
            self.damaged.append(path)
            return True

    def _path(self, name: str) -> Path:
        return self.folder / f"{name}.npz"
