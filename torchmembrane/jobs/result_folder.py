"""The folder of a job's results: it keeps track of finished frames, and writes frames, figures and summary.csv."""

from collections.abc import Callable, Sequence
from functools import cache
from math import nan
from pathlib import Path
from types import TracebackType

from numpy import isclose

from ..files.atomic import PARTIAL
from ..files.folder_lock import FolderLock, Shard
from ..files.optional import load_pyarrow
from ..files.order import in_order
from ..files.provenance import SourceFile, printable
from ..results.frames import open_folder
from ..results.store import FINISHED, MESH, Mesh, check_folder
from ..results.summary import SUMMARY, UNREADABLE, Summary
from .decode import files_of
from .frame_reconstructor import Outcome
from .inputs import Inputs, frame_name


def files_at_risk(folder: Path, inputs: Inputs, figures: bool) -> list[Path]:
    """Return the files in a folder that a job would overwrite and that are not results of the same job.

    Args:
        folder: folder of the results.
        inputs: inputs of the job.
        figures: whether every frame has a figure.
    """
    found = [folder / SUMMARY] if (folder / SUMMARY).exists() and not (folder / MESH).exists() else []
    if figures:
        names = set(map(frame_name, inputs.images))
        found += [path for path in folder.glob("*.png") if path.stem in names or inputs.video_of(path.stem)]
    return found


class ResultFolder:
    """A folder of results, locked for writing: `with ResultFolder(...) as folder`.

    Frames are written to disk at most `SAVE_SECONDS` after `keep`, summary.csv at the end; after a crash it is rebuilt from the
    frames.

    Args:
        path: folder of the results.
        mesh: data that all frames share.
        inputs: the files of this call.
        shard: part of the frames to reconstruct here.
        figures: whether every frame has a figure.
        report: function called with each message.
        reading: function of a frame's name and time that returns its gauge reading, NaN without one.

    Attributes:
        finished: names of the frames that need not be reconstructed again.

    Raises:
        MembraneError: on entering, if the folder belongs to another sensor or other settings, or another job is writing there.
    """

    def __init__(
        self,
        path: Path,
        mesh: Mesh,
        inputs: Inputs,
        shard: Shard,
        figures: bool,
        report: Callable[[str], None],
        reading: Callable[[str, float], float] = lambda name, time: nan,
    ):
        check_folder(path, mesh.sensor, mesh.settings)
        if mesh.format == "parquet":
            load_pyarrow()
        self.path, self.mesh, self.figures, self.report = path, mesh, figures, report
        self._files = {frame_name(image): image for image in inputs.images}
        self._inputs, self._shard, self._reading = inputs, shard, reading
        self.finished: set[str] = set()
        self._awaited: dict[str, Path] = {}  # frames of changed files that have not come again yet
        self._unreadable: set[Path] = set()

    def __enter__(self) -> "ResultFolder":
        self._lock = FolderLock(self.path, self._shard)
        self._lock.__enter__()
        try:
            self._open()
        except BaseException:
            self._lock.__exit__(None, None, None)
            raise
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None) -> None:
        """Write all buffered frames."""
        try:
            self.frames.close()
            self.summary.write()
        finally:
            self._lock.__exit__(kind, error, traceback)

    def keep(self, outcome: Outcome) -> int:
        """Store a frame's result, or record that it has none; return its status."""
        self._awaited.pop(outcome.name, None)
        if outcome.stored is None:
            self._unreadable.add(outcome.file)
            self.frames.forget(outcome.name)
            self.summary.add_unreadable(outcome.name, outcome.file, outcome.reason)
        else:
            self.frames.write(outcome.name, outcome.stored)
            self.summary.add(outcome.name, outcome.stored)
        return outcome.status

    def remove_outdated(self) -> None:
        """Remove the results of frames that a changed file no longer contains; call this after the last frame.

        They are kept if the file, or a picture in it, cannot be read.
        """
        gone = sorted((name for name, file in self._awaited.items() if file not in self._unreadable), key=in_order)
        for name in gone:
            self.frames.forget(name)
            self.summary.remove(name)
            if self.figures:
                (self.path / f"{name}.png").unlink(missing_ok=True)
        if gone:
            self.report(f"{gone[0]}{_and_more(gone)}: removed, as the changed file does not contain this frame any more")

    def save(self) -> None:
        """Write the frames that have been buffered long enough."""
        self.frames.save()

    def _open(self) -> None:
        """Read the folder: restore the rows of summary.csv from the frames, and find out which frames are finished."""
        if self._lock.alone:
            for left in [*self.path.glob(PARTIAL), *self.path.glob(f"frames/{PARTIAL}")]:
                left.unlink(missing_ok=True)
        self.frames = open_folder(self.path, self.mesh, self._lock.write_lock)
        self.summary = Summary(self.path, self.mesh, self._lock.write_lock)
        origins: dict[str, SourceFile] = {}
        for name, stored in self.frames.stored(self._shard.holds):
            if not stored.origin.path and (file := self._file_of(name)):
                stored = stored._replace(origin=stored.origin._replace(path=printable(str(file))))
            self.summary.add(name, stored)
            status = int(stored.frame["status"])
            origins[name] = stored.origin
            if status in FINISHED and (not self.figures or (self.path / f"{name}.png").exists()):
                self.finished.add(name)
        unreadable, holds = str(UNREADABLE), self._shard.holds
        self.summary.write(lambda row: not holds(row["name"]) or (row["status"] == unreadable and row["name"] not in origins))
        self._judge(origins)

    def _judge(self, origins: dict[str, SourceFile]) -> None:
        """Remove frames whose images or gauge readings have changed from the finished frames, and report them."""

        @cache
        def is_of(origin: SourceFile, file: Path) -> bool:
            return origin.is_of(*files_of(file, self._inputs))

        def is_changed(name: str, file: Path) -> bool:
            return not is_of(origins[name]._replace(time=0.0, gauge=0.0), file)

        def is_corrected(name: str) -> bool:
            origin = origins[name]
            return not isclose(self._reading(name, origin.time), origin.gauge, equal_nan=True)

        given = {_named(path): path for path in (*self._inputs.images, *self._inputs.videos)}
        sources = {name: file for name, origin in origins.items() if (file := given.get(_named(Path(origin.path))))}
        self._awaited = {name: file for name, file in sources.items() if is_changed(name, file)}
        files = {name: file for name in sorted(self.finished, key=in_order) if (file := self._file_of(name))}
        changed = [name for name, file in files.items() if is_changed(name, file)]
        self.finished.difference_update(changed)
        corrected = [name for name in files if name in self.finished and is_corrected(name)]
        self.finished.difference_update(corrected)
        damaged = [path for path in self.frames.damaged if path.parent != self.path or self._file_of(path.stem)]
        unknown = [name for name in files if not origins[name].content_hash]
        if changed:
            self.report(f"{_listed([files[name] for name in changed])}: changed, done again")
        if corrected:
            self.report(f"{corrected[0]}{_and_more(corrected)}: the gauge reading has changed, done again")
        if damaged:
            self.report(f"{_listed(damaged)}: damaged, done again")
        if unknown:
            self.report(
                f"{self.path}: {len(unknown)} results do not say which images they are of (earlier version); they are kept, "
                "even if these have changed"
            )

    def _file_of(self, name: str) -> Path | None:
        return self._files.get(name) or self._inputs.video_of(name)


def _named(path: Path) -> tuple[str, str]:
    """Return what identifies the source of a frame among the inputs: the name of its frames, and that of the file."""
    return frame_name(path), printable(path.name)


def _listed(paths: list[Path]) -> str:
    return f"{paths[0]}{_and_more(paths)}"


def _and_more(things: Sequence[object]) -> str:
    return f" and {len(things) - 1} more" if things[1:] else ""
