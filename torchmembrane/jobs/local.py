"""Images on disk to results on disk: in batches, restartable, one bad file never stops the rest."""

import glob
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from itertools import islice
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor
from tqdm import tqdm

from ..errors import MembraneError
from ..io.images import to_grey
from ..io.results import NOT_CONVERGED, STATUS_TEXTS, Reconstruction
from ..io.store import FINISHED, MESH, Mesh, Settings, open_folder
from ..io.summary import UNREADABLE, Summary

IMAGES = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".webp")
VIDEOS = (".mp4", ".m4v", ".mov", ".avi", ".mkv", ".webm")
DECODERS = 4


class Inputs(NamedTuple):
    """Image and video files in the order of the call."""

    images: list[Path]
    videos: list[Path]

    def video_of(self, name: str) -> Path | None:
        """The video whose frame would have this name, STEM_NUMBER."""
        stem, _, number = name.rpartition("_")
        return next((path for path in self.videos if path.stem == stem and number.isdigit()), None)


class Frame(NamedTuple):
    """A frame to reconstruct: `image [1, 1, height, width]`, or the reason why there is none."""

    name: str
    file: Path
    image: Tensor | None
    reason: str = ""


class Outcome(NamedTuple):
    """How many frames of a call were reconstructed (some without convergence), failed, and were skipped as finished."""

    reconstructed: int
    not_converged: int
    failed: int
    skipped: int


def find_inputs(arguments, video: bool = False) -> Inputs:
    """Files, globs and folders (their images in name order) to files; `video` takes every file for a video.

    Raises `MembraneError` where something names no file, or where two frames would have one name.
    """
    paths = [path for argument in arguments for path in _expanded(str(argument), VIDEOS if video else IMAGES)]
    is_video = [video or path.suffix.lower() in VIDEOS for path in paths]
    inputs = Inputs(*([p for p, v in zip(paths, is_video, strict=True) if v is kind] for kind in (False, True)))
    for name, count in Counter(p.stem for p in paths).items():
        if count > 1:
            twins = ", ".join(str(p) for p in paths if p.stem == name)
            raise MembraneError(f"two inputs of the name {name!r} ({twins}); results bear it: rename, or use two calls")
    for image in inputs.images:
        if inputs.video_of(image.stem):
            raise MembraneError(f"{image}: a frame of {inputs.video_of(image.stem)} has the same name; use two calls")
        if f"{image.stem}.npz" == MESH:
            raise MembraneError(f"{image}: its result would be {MESH}, which holds the mesh; rename the image")
    return inputs


def _expanded(argument: str, suffixes) -> list[Path]:
    path = Path(argument)
    if path.is_dir():
        found = sorted(p for p in path.iterdir() if p.suffix.lower() in suffixes and p.is_file())
        if not found:
            raise MembraneError(f"{path}: the folder holds no files {' '.join(suffixes)}")
        return found
    if path.exists():
        return [path]
    found = [Path(match) for match in sorted(glob.glob(argument, recursive=True))]
    if not any(p.is_file() for p in found):
        raise MembraneError(f"{argument}: no such file, no pattern that matches one; expected images, globs, folders")
    return [p for p in found if p.is_file()]


def reconstruct_files(
    reconstructor, inputs: Inputs, out: str | Path, settings: Settings, *, batch: int = 16, figures: bool = False,
    report: Callable[[str], None] = lambda line: tqdm.write(line, file=sys.stderr),
) -> Outcome:  # fmt: skip
    """Reconstruct all frames of `inputs` that have no finished result in the folder `out` yet.

    Arguments
        reconstructor   a `Reconstructor`
        settings        what it was made with, and the format of the results
        batch           frames a call; at most three batches of images are in memory
        figures         also NAME.png for every frame; a finished frame that lacks its figure is done again
        report          is told what failed, a line for each frame

    A file that cannot be read stands in summary.csv with status -1 and has no result. Interrupted at any point, `out`
    holds what is done so far and the same call goes on from there. Raises `MembraneError` where `out` is refused.
    """
    out, mesh = Path(out), Mesh.of(reconstructor, settings)
    if figures and (shadowed := [p for p in inputs.images if p.parent.resolve() == out.resolve()]):
        raise MembraneError(f"--out {out}: figures would overwrite images there ({shadowed[0]}); choose another")
    if inputs.videos:
        load_pyav()
    frames = open_folder(out, mesh)
    stored, files = frames.statuses(), {path.stem: path for path in inputs.images}
    summary = Summary(out, frames, stored, mesh, lambda name: files.get(name) or inputs.video_of(name))
    drawn = lambda name: not figures or (out / f"{name}.png").exists()  # noqa: E731
    finished = {name for name, status in stored.items() if status in FINISHED and drawn(name)}
    sources = (source for source in _sources(inputs, reconstructor) if source.name not in finished)
    done = Counter()
    try:
        with torch.no_grad(), _progress(inputs, finished) as progress:
            for group in _read_ahead(sources, batch):
                for frame, result, seconds in _reconstruct(reconstructor, group):
                    if result is None:
                        frames.forget(frame.name)
                        summary.add_unreadable(frame.name, frame.file, frame.reason)
                    else:
                        if figures:
                            _draw(out / f"{frame.name}.png", frame, result, mesh)
                        frames.write(frame.name, result)
                        summary.add(frame.name, frame.file, result, seconds)
                    status = UNREADABLE if result is None else int(result["status"])
                    done[status] += 1
                    if status not in FINISHED:
                        of_video = "" if frame.name == frame.file.stem else f", {frame.name}"
                        report(f"{frame.file}{of_video}: {frame.reason or STATUS_TEXTS[status]}")
                progress.update(len(group))
    finally:
        frames.flush()
        summary.write()
    good = sum(done[status] for status in FINISHED)
    return Outcome(good, done[NOT_CONVERGED], done.total() - good, progress.initial)


class Source(NamedTuple):
    """A frame still to be decoded: `load()` gives its image `[1, 1, height, width]` or raises `MembraneError`."""

    name: str
    file: Path
    load: Callable[[], Tensor]


def _sources(inputs: Inputs, reconstructor) -> Iterator[Source]:
    for path in inputs.images:
        yield Source(path.stem, path, partial(reconstructor.read, path))
    for path in inputs.videos:
        yield from _video_frames(path, reconstructor)


def _video_frames(path: Path, reconstructor) -> Iterator[Source]:
    """The frames of a video one after another; one that cannot be decoded ends it."""
    av, number = load_pyav(), -1
    width, height = reconstructor.sensor.camera.image_size
    try:
        with av.open(str(path)) as container:
            for number, picture in enumerate(container.decode(video=0)):
                if (picture.width, picture.height) != (width, height):
                    raise MembraneError(
                        f"the video is {picture.width} x {picture.height} px, the sensor's images {width} x {height}"
                    )
                yield Source(f"{path.stem}_{number:06d}", path, partial(_video_image, picture, reconstructor))
        if number < 0:
            raise MembraneError("holds no picture")
    except (av.FFmpegError, IndexError, MembraneError) as error:
        yield Source(f"{path.stem}_{number + 1:06d}", path, partial(_refuse, f"video: {error}"))


def _video_image(picture, reconstructor) -> Tensor:
    grey = to_grey(picture.to_ndarray(format="rgb24"))
    return torch.from_numpy(grey)[None, None].to(reconstructor.rest_pixels)


def _refuse(reason: str):
    raise MembraneError(reason)


def _read_ahead(sources: Iterator[Source], batch: int) -> Iterator[list[Frame]]:
    """Batches of decoded frames; while one is used, the next is decoded."""
    with ThreadPoolExecutor(1) as reader, ThreadPoolExecutor(DECODERS) as decoders:
        read = lambda: list(decoders.map(_decoded, islice(sources, batch)))  # noqa: E731
        following = reader.submit(read)
        while group := following.result():
            following = reader.submit(read)
            yield group


def _decoded(source: Source) -> Frame:
    try:
        return Frame(source.name, source.file, source.load())
    except MembraneError as error:
        return Frame(source.name, source.file, None, str(error).removeprefix(f"{source.file}: "))


def _reconstruct(reconstructor, group: list[Frame]) -> Iterator[tuple[Frame, dict[str, np.ndarray] | None, float]]:
    """Every frame of a batch with its result, None for an unreadable one, and the seconds that it took."""
    start = time.perf_counter()
    images = [frame.image for frame in group if frame.image is not None]
    results = iter(())
    if images:
        computed = Reconstruction(*(field.cpu() for field in reconstructor(torch.cat(images))))
        results = iter([computed.frame(i) for i in range(len(images))])
    seconds = (time.perf_counter() - start) / max(len(images), 1)
    for frame in group:
        yield frame, None if frame.image is None else next(results), seconds


def _draw(path: Path, frame: Frame, result: dict[str, np.ndarray], mesh: Mesh) -> None:
    from ..plot.drawing import save
    from ..plot.frames import figure

    save(figure(result, mesh, frame.image[0, 0].cpu().numpy(), frame.name), path)


def _progress(inputs: Inputs, finished: set[str]) -> tqdm:
    """A bar with rate over all frames of the call, as far as the videos say how many they hold."""
    mine = sum(path.stem in finished for path in inputs.images)
    mine += sum(inputs.video_of(name) is not None for name in finished) if inputs.videos else 0
    lengths = [_video_length(path) for path in inputs.videos]
    total = None if None in lengths else len(inputs.images) + sum(lengths)
    return tqdm(total=total, initial=mine, unit="frame", desc="reconstruct")


def _video_length(path: Path) -> int | None:
    av = load_pyav()
    try:
        with av.open(str(path)) as container:
            return container.streams.video[0].frames or None
    except (av.FFmpegError, IndexError):
        return None


def load_pyav():
    try:
        import av
    except ImportError as error:
        raise MembraneError('videos need PyAV, which is not installed: pip install "torchmembrane[video]"') from error
    return av
