"""Images on disk to results on disk: in batches, restartable, one bad file never stops the rest."""

import sys
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import torch
from torch import Tensor

from ..errors import MembraneError
from ..io.frames import Frame, open_folder
from ..io.optional import load_pyav
from ..io.results import Reconstruction
from ..io.status import Status
from ..io.store import FINISHED, Mesh, Settings
from ..io.summary import UNREADABLE, Summary
from .decode import DecodedFrame, read_ahead, sources, video_length
from .inputs import Inputs

if TYPE_CHECKING:
    from ..reconstruct import Reconstructor


class FrameCounts(NamedTuple):
    """How many frames of a call were reconstructed (some of them not to be relied on, by status), failed, and were skipped as
    finished."""

    reconstructed: int
    not_converged: int
    unexplained: int
    hidden: int
    failed: int
    skipped: int


def reconstruct_files(
    reconstructor: "Reconstructor",
    inputs: Inputs,
    out: str | Path,
    settings: Settings,
    *,
    batch: int = 16,
    figures: bool = False,
    rest_pixels: Tensor | None = None,
    pressure: Mapping[str, float] | None = None,
    report: Callable[[str], None] | None = None,
) -> FrameCounts:
    """Reconstruct all frames of `inputs` that have no finished result in the folder `out` yet.

    A file that cannot be read stands in summary.csv with status -1 and has no result. Interrupted at any point, `out`
    holds what is done so far and the same call continues from there.

    Args:
        reconstructor: a `Reconstructor`.
        inputs: what `find_inputs` gives.
        out: folder of the results: new, or of the same sensor and settings.
        settings: what the reconstructor was made with, and the format of the results.
        batch: frames computed at once; at most three batches of images are in memory.
        figures: also NAME.png for every frame; a finished frame that lacks its figure is done again.
        rest_pixels: `[D, 2]`, the markers of this recording at rest; default: of the sensor's rest image.
        pressure: that a gauge reads, by the names of the frames, as `Reconstructor` takes it.
        report: called with one line per failed frame (default: the line is written to stderr, above the progress bar).

    Returns:
        The numbers of frames.

    Raises:
        MembraneError: `out` is refused, or a package for videos or Parquet is missing.

    Example:
        >>> import tempfile
        >>> from dataclasses import replace
        >>> from torchmembrane import Reconstructor, Sensor
        >>> from torchmembrane.jobs.inputs import find_inputs
        >>> sensor = Sensor.from_file("examples/sensor.toml")
        >>> sensor = replace(sensor, markers=replace(sensor.markers, rest_image=None))  # quicker, less accurate
        >>> reconstructor, images = Reconstructor(sensor), find_inputs(["examples/rest.png"])
        >>> reconstruct_files(reconstructor, images, tempfile.mkdtemp(), Settings.of(reconstructor, "npz"))
        FrameCounts(reconstructed=1, not_converged=0, unexplained=0, hidden=0, failed=0, skipped=0)
    """
    out, report = Path(out), report or _write_line
    mesh = Mesh.of(reconstructor, settings)
    if figures and (shadowed := [path for path in inputs.images if path.parent.resolve() == out.resolve()]):
        raise MembraneError(f"--out {out}: figures would overwrite images there ({shadowed[0]}); choose another")
    if inputs.videos:
        load_pyav()
    folder = _ResultFolder(out, mesh, inputs, figures)
    waiting = (source for source in sources(inputs, reconstructor) if source.name not in folder.finished)
    done: Counter[int] = Counter()
    try:
        with torch.no_grad(), _progress(inputs, folder.finished) as progress:
            for group in read_ahead(waiting, batch):
                for frame, result, seconds in _reconstructed(reconstructor, group, rest_pixels, pressure):
                    status = folder.keep(frame, result, seconds)
                    done[status] += 1
                    if status not in FINISHED:
                        of_video = "" if frame.name == frame.file.stem else f", {frame.name}"
                        report(f"{frame.file}{of_video}: {frame.reason or Status(status).text}")
                progress.update(len(group))
    finally:
        folder.close()
    good = sum(done[status] for status in FINISHED)
    doubts = done[Status.NOT_CONVERGED], done[Status.UNEXPLAINED], done[Status.HIDDEN]
    return FrameCounts(good, *doubts, done.total() - good, progress.initial)


class _ResultFolder:
    """The folder of a call's results: frames, figures and summary.csv, kept in step.

    Args:
        path: the folder.
        mesh: what its frames share.
        inputs: the files of this call, to name them in summary.csv.
        figures: whether to draw every frame.

    Attributes:
        finished: the frames that need not be done again.
    """

    def __init__(self, path: Path, mesh: Mesh, inputs: Inputs, figures: bool):
        self.path, self.mesh, self.figures = path, mesh, figures
        self.frames = open_folder(path, mesh)
        stored, files = self.frames.statuses(), {image.stem: image for image in inputs.images}
        self.summary = Summary(path, self.frames, stored, mesh, lambda name: files.get(name) or inputs.video_of(name))
        good = {name for name, status in stored.items() if status in FINISHED}
        self.finished = {name for name in good if not figures or (path / f"{name}.png").exists()}

    def keep(self, frame: DecodedFrame, result: Frame | None, seconds: float) -> int:
        """Store a frame's result, or that it has none; returns its status."""
        if frame.image is None or result is None:
            self.frames.forget(frame.name)
            self.summary.add_unreadable(frame.name, frame.file, frame.reason)
            return UNREADABLE
        if self.figures:
            from ..plot.drawing import save
            from ..plot.frames import figure

            save(figure(result, self.mesh, frame.image[0, 0].cpu().numpy(), frame.name), self.path / f"{frame.name}.png")
        self.frames.write(frame.name, result)
        self.summary.add(frame.name, frame.file, result, seconds)
        return int(result["status"])

    def close(self) -> None:
        """Write what is held back."""
        self.frames.flush()
        self.summary.write()


def _reconstructed(
    reconstructor: "Reconstructor",
    group: list[DecodedFrame],
    rest_pixels: Tensor | None,
    pressure: Mapping[str, float] | None,
) -> Iterator[tuple[DecodedFrame, Frame | None, float]]:
    """Every frame of a batch with its result, None for an unreadable one, and the seconds that it took."""
    start = time.perf_counter()
    readable = [(frame.name, frame.image) for frame in group if frame.image is not None]
    names, images = [name for name, _ in readable], [image for _, image in readable]
    results: Iterator[Frame] = iter(())
    if images:
        options = {} if rest_pixels is None else {"rest_pixels": rest_pixels}
        if pressure is not None:
            options["pressure"] = torch.tensor([pressure.get(name, torch.nan) for name in names], dtype=torch.float64)
        computed = Reconstruction(*(field.cpu() for field in reconstructor(torch.cat(images), **options)))
        results = iter([computed.frame(i) for i in range(len(images))])
    seconds = (time.perf_counter() - start) / max(len(images), 1)
    for frame in group:
        yield frame, None if frame.image is None else next(results), seconds


def _progress(inputs: Inputs, finished: set[str]) -> Any:
    """A bar with rate over all frames of the call, as far as the videos say how many they hold."""
    from tqdm import tqdm

    mine = sum(path.stem in finished for path in inputs.images)
    mine += sum(inputs.video_of(name) is not None for name in finished) if inputs.videos else 0
    lengths = [video_length(path) for path in inputs.videos]
    known = [length for length in lengths if length is not None]
    total = len(inputs.images) + sum(known) if len(known) == len(lengths) else None
    return tqdm(total=total, initial=mine, unit="frame", desc="reconstruct")


def _write_line(line: str) -> None:
    from tqdm import tqdm

    tqdm.write(line, file=sys.stderr)
