"""Recording of a stream: captured images, results in the format of `torchmembrane reconstruct`, and times."""

import csv
from collections.abc import Iterator
from pathlib import Path
from types import TracebackType

import numpy as np

from ..errors import MembraneError
from ..files.atomic import make_subfolder, writing
from ..files.folder_lock import WHOLE
from ..files.images import write_as_taken
from ..files.provenance import SourceFile
from ..files.safe_read import in_one_line, read_text
from ..files.system_files import is_of_system
from ..jobs.frame_reconstructor import Outcome
from ..jobs.inputs import Inputs
from ..jobs.result_folder import ResultFolder
from ..results.npz import Stored
from ..results.store import Mesh
from ..user_warnings import warn_user
from .loop import LiveFrame

IMAGES, TIMES = "images", "times.csv"
COLUMNS = ("name", "time", "latency")
MOST_TIMES_BYTES = 2**28


class Recording:
    """A new folder with the results of a stream: `with Recording(folder, mesh) as recording`, `recording.keep(seen)`.

    The folder holds `images/NAME.png` (`.tiff` if 16 bits do not hold the values exactly; `images/NAME_VIEW.png` for views with
    images of their own), NAME.npz, mesh.npz and summary.csv as `torchmembrane reconstruct` writes them, and times.csv with the
    columns `name`, `time` (of the capture, seconds since 1970) and `latency` (seconds). NAME is the number of the capture.

    Args:
        folder: new or empty folder.
        mesh: data that all frames share.
        bits: bit depth of the camera, if 16-bit values use fewer bits; for views with images of their own, one for each, or
            one for all.

    Raises:
        MembraneError: the folder is not empty; from `keep` and at the end of the block: the folder cannot be written to. If the
            block ends with another error, this is a warning instead.
    """

    def __init__(self, folder: Path, mesh: Mesh, *bits: int | None):
        if folder.exists() and (not folder.is_dir() or not all(map(is_of_system, folder.iterdir()))):
            raise MembraneError(f"--record {folder}: is not empty; expected a new folder for each recording")
        self.folder, self.views = folder, mesh.view_names.split()
        self.bits = bits if len(bits) > 1 else (bits or (None,)) * max(1, len(self.views))
        self._results = ResultFolder(folder, mesh, Inputs([], []), WHOLE, False, print)

    def __enter__(self) -> "Recording":
        self._results.__enter__()
        make_subfolder(self.folder / IMAGES)
        self._times = open(self.folder / TIMES, "w", newline="", encoding="utf-8", buffering=1)
        csv.writer(self._times).writerow(COLUMNS)
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None) -> None:
        try:
            try:
                self._times.close()
            finally:
                self._results.__exit__(kind, error, traceback)
        except OSError as failure:
            said = f"--record {self.folder}: {failure.strerror or failure}"
            if error is None:
                raise MembraneError(
                    f"{said}; the recording cannot be finished. What was written is kept: free some space, and run "
                    f"`torchmembrane reconstruct` on {self.folder / IMAGES}"
                ) from failure
            warn_user(f"{said}; the recording cannot be finished")

    def keep(self, seen: LiveFrame) -> None:
        """Write a frame."""
        paths = list(self._images(seen))
        stored = Stored(seen.frame, SourceFile.from_files(*paths)._replace(time=seen.time), seen.latency)
        self._results.keep(Outcome(seen.name, paths[0], stored))
        with writing(self.folder / TIMES):
            csv.writer(self._times).writerow((seen.name, f"{seen.time:.6f}", f"{seen.latency:.6f}"))

    def _images(self, seen: LiveFrame) -> Iterator[Path]:
        """Write the frame's image files and yield their paths."""
        path = self.folder / IMAGES
        if isinstance(seen.image, np.ndarray):
            yield write_as_taken(path / seen.name, seen.image, self.bits[0])
            return
        for view, image, bits in zip(self.views, seen.image, self.bits, strict=True):
            if image is not None:
                yield write_as_taken(path / f"{seen.name}_{view}", image, bits)


def times_of(folder: Path) -> dict[str, float]:
    """Return the capture times of a recording's frames by name, seconds since 1970; empty for other folders.

    Raises:
        MembraneError: the file of times cannot be read.
    """
    path = folder / TIMES
    if not path.exists():
        return {}
    expected = f"CSV with the header {','.join(COLUMNS)}"
    text = read_text(path, MOST_TIMES_BYTES, expected)
    try:
        rows = list(csv.reader(text.splitlines()))[1:]
        return {row[0]: float(row[1]) for row in rows if len(row) == len(COLUMNS)}
    except (csv.Error, ValueError) as error:
        raise MembraneError(f"{path}: not readable ({in_one_line(error)}); expected {expected}: delete it") from error
