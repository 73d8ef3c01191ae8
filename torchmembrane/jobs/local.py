"""The job on one machine: it reconstructs files in batches, can be resumed, and never stops because of a bad file."""

import sys
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple, TypeAlias

from torch import Tensor

from ..files.folder_lock import WHOLE, Shard
from ..files.optional import load_pyav
from ..files.provenance import printable
from ..files.targets import refuse_overwriting
from ..machine_code import SECONDS
from ..results.status import Status
from ..results.store import FINISHED, Mesh, Settings
from ..results.view_status import moved_views
from .decode import Source, length_of, sources
from .frame_reconstructor import FrameReconstructor, Gauge, Outcome
from .inputs import Inputs, frame_name
from .result_folder import ResultFolder, files_at_risk
from .workers import Work, batch_for, outcomes_by, outcomes_here, workers_for

if TYPE_CHECKING:
    from ..reconstruct import Reconstructor

Engine: TypeAlias = Callable[[Work, Iterator[Source], int | None], Iterator[list[Outcome]]]
"""Function that computes the outcomes of all frames from the work, the sources and the batch size; None: the engine's
default."""

FEW_FRAMES = 50
"""Smallest number of frames for which a job waits until machine code is compiled."""


class FrameCounts(NamedTuple):
    """Numbers of frames in a call: reconstructed (some with a status other than ok), failed, and already finished."""

    reconstructed: int
    not_converged: int
    unexplained: int
    hidden: int
    out_of_range: int
    failed: int
    skipped: int


def reconstruct_files(
    reconstructor: "Reconstructor",
    inputs: Inputs,
    out: str | Path,
    settings: Settings,
    *,
    batch: int | None = None,
    workers: int | None = 1,
    shard: Shard = WHOLE,
    engine: Engine | None = None,
    figures: bool = False,
    rest_pixels: Tensor | None = None,
    pressure: Gauge | None = None,
    report: Callable[[str], None] | None = None,
) -> FrameCounts:
    """Reconstruct all frames of `inputs` that have no finished result in the folder `out` yet.

    A file that cannot be read is listed in summary.csv with status -1 and has no result. If the job is interrupted at any
    point, `out` holds what was computed so far, and the same call resumes from there: at most `SAVE_SECONDS` and one batch are
    lost. A frame whose image has changed is reconstructed again.

    Args:
        reconstructor: reconstructor of the sensor.
        inputs: inputs as returned by `find_inputs`.
        out: folder of the results: new, or one with results of the same sensor and settings.
        settings: settings of the reconstructor, and the format of the results.
        batch: number of frames computed at once; default: chosen by the available memory.
        workers: number of worker processes, each with one thread; 1: this process with all of torch's threads; None: one per
            core if there are enough frames. A script that uses more than one needs `if __name__ == "__main__":`.
        shard: part of the frames to reconstruct; several shards may run at the same time.
        engine: function that computes all outcomes from work, sources and batch, in place of the processes of this machine.
        figures: whether to write NAME.png for every frame; a finished frame without its figure is reconstructed again.
        rest_pixels: markers at rest in this recording, `[D, 2]` px, for W views `[W, D, 2]`; default: those of the rest image.
        pressure: gauge readings by frame name, or by name and time, in the units of `Reconstructor`.
        report: function called with each message: on a frame that failed, lacks a view or is done again, and on views that were
            left out or have moved (default: write it to stderr, above the progress bar).

    Returns:
        Numbers of reconstructed, failed and skipped frames.

    Raises:
        MembraneError: `out` holds other files or results of another sensor or other settings, another job is writing there, or
            a package for videos or Parquet is missing.

    Example:
        >>> import tempfile
        >>> from dataclasses import replace
        >>> from torchmembrane import Reconstructor, Sensor
        >>> from torchmembrane.jobs.inputs import find_inputs
        >>> sensor = Sensor.from_file("examples/sensor.toml")
        >>> sensor = replace(sensor, markers=replace(sensor.markers, rest_image=None))  # quicker, less accurate
        >>> reconstructor, images = Reconstructor(sensor), find_inputs(["examples/rest.png"])
        >>> settings = Settings.from_reconstructor(reconstructor, "npz")
        >>> counts = reconstruct_files(reconstructor, images, tempfile.mkdtemp(), settings)
        >>> counts.reconstructed, counts.failed, counts.skipped
        (1, 0, 0)
    """
    out, report = Path(out), report or _write_line
    mesh = Mesh.from_reconstructor(reconstructor, settings)
    refuse_overwriting(f"--out {out}", files_at_risk(out, inputs, figures), [*inputs.images, *inputs.videos], force=True)
    if inputs.need_pyav:
        load_pyav()
    done, moved = Counter[int](), Counter[str]()
    computed = FrameReconstructor(reconstructor, rest_pixels, pressure, settings.fields.split())
    work = Work(computed, (out, mesh) if figures else None)
    with ResultFolder(out, mesh, inputs, shard, figures, report, computed.reading) as folder:
        mine = (source for source in sources(inputs, reconstructor) if shard.holds(source.name))
        waiting = (source for source in mine if source.name not in folder.finished)
        with _progress(inputs, shard, folder.finished) as progress:
            work = work._replace(machine_code=engine is not None or _by_machine_code(reconstructor, progress.all_left))
            for group in (engine or _local(reconstructor, workers, progress.left))(work, waiting, batch):
                for outcome in group:
                    done[_kept(folder, outcome, report)] += 1
                    moved.update(moved_views(outcome.stored.frame, mesh.view_names.split()) if outcome.stored else ())
                folder.save()
                progress.update(len(group), done)
        folder.remove_outdated()
    if alone := done[Status.VIEW_LEFT_OUT]:
        report(f"a view was left out in {alone} frames; their results are those of the other views")
    for view, frames in moved.items():
        moved_since = f"view {view}: its camera has moved since the rest image, in {frames} frames"
        report(f"{moved_since}; run `calibrate rest` with new rest images")
    good = sum(done[status] for status in FINISHED)
    doubts = done[Status.NOT_CONVERGED], done[Status.UNEXPLAINED], done[Status.HIDDEN], done[Status.OUT_OF_RANGE]
    return FrameCounts(good, *doubts, done.total() - good, progress.initial)


def _by_machine_code(reconstructor: "Reconstructor", left: int | None) -> bool:
    """Return whether a job is solved with machine code; print a message if it has too few frames to compile the code.

    A few frames take less time by tensor operations than the compilation takes.

    Args:
        reconstructor: reconstructor of the job.
        left: number of frames in the job; None if unknown.
    """
    if not reconstructor.estimator.must_compile or left == 0:
        return True
    if few := left is not None and left < FEW_FRAMES:
        _write_line(
            f"torchmembrane: {left} frames are solved by tensor operations; the first job of {FEW_FRAMES} frames or more "
            f"compiles machine code, which takes about {SECONDS} s, once"
        )
    return not few


def _kept(folder: ResultFolder, outcome: Outcome, report: Callable[[str], None]) -> int:
    """Store an outcome, report its reason if there is no result or a view was left out, and return its status."""
    status = folder.keep(outcome)
    if status not in FINISHED or status == Status.VIEW_LEFT_OUT:
        of_video = "" if outcome.name == frame_name(outcome.file) else f", {outcome.name}"
        report(f"{outcome.file}{of_video}: {outcome.status_text}")
    return status


def _local(reconstructor: "Reconstructor", workers: int | None, left: int) -> Engine:
    """Return the engine of this machine: this process, or worker processes."""
    device = reconstructor.rest_pixels.device.type
    count = workers_for(left, device) if workers is None else workers
    compute = outcomes_here if count == 1 else partial(outcomes_by, count)

    def engine(work: Work, waiting: Iterator[Source], batch: int | None) -> Iterator[list[Outcome]]:
        return compute(
            work, waiting, batch or batch_for(reconstructor.image_size, len(reconstructor.vertex_pixels), count, device)
        )

    return engine


class _Progress:
    """A progress bar with rate and counts for all frames of the call, as far as the videos declare their numbers of frames."""

    def __init__(self, inputs: Inputs, shard: Shard, finished: set[str]):
        from tqdm import tqdm

        mine = [name for name in map(frame_name, inputs.images) if shard.holds(name)]
        self.initial = sum(name in finished for name in mine)
        self.initial += sum(inputs.video_of(name) is not None for name in finished) if inputs.videos else 0
        lengths = [(length or 0) // shard.total for length in (length_of(path, inputs) for path in inputs.videos)]
        total = len(mine) + sum(lengths)
        self.left = total - self.initial
        self.all_left = self.left if all(lengths) else None
        self.bar = tqdm(total=total if all(lengths) else None, initial=self.initial, unit="frame", desc="reconstruct")

    def update(self, frames: int, done: Counter[int]) -> None:
        """Advance the bar by some frames; `done`: all frames of this call so far, by status."""
        failed = sum(count for status, count in done.items() if status not in FINISHED)
        self.bar.set_postfix({"failed": failed, "not converged": done[Status.NOT_CONVERGED]}, refresh=False)
        self.bar.update(frames)


@contextmanager
def _progress(inputs: Inputs, shard: Shard, finished: set[str]) -> Iterator[_Progress]:
    progress = _Progress(inputs, shard, finished)
    with progress.bar:
        yield progress


def _write_line(line: str) -> None:
    from tqdm import tqdm

    tqdm.write(printable(line), file=sys.stderr)
