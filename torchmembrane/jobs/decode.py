"""Decoding of frames in the background, one batch ahead of the computation: images, and the pictures of videos, bags and image
stacks."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from itertools import islice
from math import isnan, nan
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, NoReturn, TypeAlias

import numpy as np
import torch
from torch import Tensor

from ..errors import MembraneError
from ..files.images import picture_count, stack_images, to_grey
from ..files.provenance import SourceFile
from ..files.timestamps import time_in
from ..files.video import picture_total, picture_values, video_pictures
from ..integrations.messages import grey_of
from ..integrations.rosbag import image_topic, is_bag, messages
from ..sensor.view_images import grey_views, read_views, view_files
from ..sensor.views import View
from .inputs import Inputs, frame_name, picture_name
from .moments import TimedPicture, moments

if TYPE_CHECKING:
    from ..reconstruct import Reconstructor

DECODERS = 4
CUT = 1.0
"""Time of the first picture of a video, s, above which it has been cut from a longer one."""
LONGEST_NAME = 251
"""Largest length of a frame name in bytes, such that a file NAME.npz can exist."""


class Loaded(NamedTuple):
    """A frame's image `[1, 1, height, width]`, or its images of all views `[1, W, ...]`, and the reason for each missing view,
    by name."""

    image: Tensor
    lacking: Mapping[str, str] = {}


Load: TypeAlias = Callable[["Reconstructor"], Loaded]
"""Function that returns a frame's image or raises `MembraneError`."""


class Picture(NamedTuple):
    """A picture in a file of several: the function that loads its image, and its time in seconds, NaN if unknown."""

    load: Load
    time: float = float("nan")


class Source(NamedTuple):
    """A frame to be decoded: `load(reconstructor)` returns its image or raises `MembraneError`.

    A source that is an image file can be sent to another process.
    """

    name: str
    file: Path
    load: Load
    origin: SourceFile | None = None


class DecodedFrame(NamedTuple):
    """A frame to reconstruct: its image, as in `Loaded`, or the reason why there is none."""

    name: str
    file: Path
    image: Tensor | None
    reason: str = ""
    origin: SourceFile = SourceFile()
    lacking: Mapping[str, str] = {}

    def but(self, error: Exception) -> "DecodedFrame":
        """Return the same frame without an image, with an error as the reason."""
        return self._replace(image=None, reason=str(error).removeprefix(f"{self.file}: "))


def sources(inputs: Inputs, reconstructor: "Reconstructor") -> Iterator[Source]:
    """Yield all frames of the inputs: first the images, then the pictures of videos, bags and stacks, named STEM_NUMBER."""
    yield from map(source_of, inputs.images)
    sensor = reconstructor.sensor
    for path in inputs.videos:
        if sensor.views_apart:
            yield from _frames(path, _pictures_of_views(path, inputs, sensor.views), files_of(path, inputs))
        else:
            yield from _frames(path, _pictures(path, inputs.topic, sensor.image_size, sensor.camera.bits), [path])


def source_of(path: Path) -> Source:
    """Return the frame of an image file."""
    return Source(frame_name(path), path, partial(_read, path))


def decoded(source: Source, reconstructor: "Reconstructor") -> DecodedFrame:
    """Decode a frame: return its image, or the reason why there is none."""
    frame = DecodedFrame(source.name, source.file, None)
    try:
        if len(source.name.encode()) > LONGEST_NAME:
            raise MembraneError(f"its name has {len(source.name.encode())} bytes; expected {LONGEST_NAME} at most: rename it")
        origin = source.origin or source_file_of(*existing_files(source.file, reconstructor.sensor.views_apart))
        image, lacking = source.load(reconstructor)
        return frame._replace(image=image, origin=origin, lacking=lacking)
    except MembraneError as error:
        return frame.but(error)


def source_file_of(*paths: Path) -> SourceFile:
    """Return the provenance of a frame from its file, or from the files of all views.

    Raises:
        MembraneError: a path is not a regular file (reading a pipe would block), or cannot be read.
    """
    try:
        for path in paths:
            if not path.is_file():
                raise MembraneError(f"{path}: not a regular file; expected an image or a video")
        return SourceFile.from_files(*paths)
    except OSError as error:
        raise MembraneError(f"{error.filename or paths[0]}: not readable ({error})") from error


def read_ahead(sources: Iterator[Source], reconstructor: "Reconstructor", batch: int) -> Iterator[list[DecodedFrame]]:
    """Yield batches of decoded frames, and decode the next batch while the current one is used.

    Args:
        sources: frames to decode, in order.
        reconstructor: reconstructor of the sensor.
        batch: number of frames in a batch.

    Yields:
        Lists of `batch` frames; the last list may be shorter.
    """
    with ThreadPoolExecutor(1) as reader, ThreadPoolExecutor(DECODERS) as decoders:

        def read() -> list[DecodedFrame]:
            return list(decoders.map(lambda source: decoded(source, reconstructor), islice(sources, batch)))

        following = reader.submit(read)
        while group := following.result():
            following = reader.submit(read)
            yield group


def length_of(path: Path, inputs: Inputs) -> int | None:
    """Return the number of frames that a video, bag or stack declares, for several views the largest; None if it declares none
    or is not such a file."""
    if is_bag(path):
        return max(image_topic(path, topic)[1] for topic in inputs.image_topics)
    return max((picture_count(file) or picture_total(file) or 0 for file in files_of(path, inputs)), default=0) or None


def files_of(path: Path, inputs: Inputs) -> list[Path]:
    """Return the files that hold the pictures of an input: one video per view, or the bag itself."""
    return [path] if is_bag(path) else view_files(path, inputs.views)


def existing_files(path: Path, views: Sequence[str]) -> list[Path]:
    """Return those image files of a frame that exist: of several views, one for each."""
    return [file for file in view_files(path, views) if file.is_file()] or [path]


def _read(path: Path, reconstructor: "Reconstructor") -> Loaded:
    if reconstructor.sensor.views_apart:
        return Loaded(*read_views(path, reconstructor.sensor.views, reconstructor.rest_pixels))
    return Loaded(reconstructor.read(path))


def _frames(path: Path, pictures: Iterator[Picture], files: Sequence[Path]) -> Iterator[Source]:
    """Yield the frames of a file of several pictures; if the file breaks off, the last frame carries the error."""
    number = -1
    try:
        origin = source_file_of(*files)
        for number, picture in enumerate(pictures):
            yield Source(picture_name(path, number), path, picture.load, origin._replace(time=picture.time))
        if number < 0:
            raise MembraneError("holds no picture")
    except MembraneError as error:
        refusal = partial(_refuse, str(error).removeprefix(f"{path}: "))
        yield Source(picture_name(path, number + 1), path, refusal, SourceFile())


def _pictures(
    path: Path, topic: str | None, size: tuple[int, int], bits: int | None, keeps_clock: bool = False
) -> Iterator[Picture]:
    """Yield the pictures of a file of several.

    In a bag, the time is that of the header, or else of the reception; in a video, it counts from the beginning, whose absolute
    time the file name may give. A video cut from a longer one, whose pictures keep their times, begins with the first picture.
    `keeps_clock`: unless the name gives a time, keep the times of the file, which the videos of several views may share.
    """
    if is_bag(path):
        for each in messages(path, image_topic(path, topic)[0]):
            yield Picture(partial(_bag_image, each.message, size, bits), each.time)
        return
    of_stack, begun = picture_count(path, 1) > 0, time_in(path.stem)
    first = 0.0 if keeps_clock and isnan(begun) else None
    begun = 0.0 if isnan(begun) else begun
    for picture in stack_images(path, size, bits) if of_stack else video_pictures(path, size):
        if isinstance(picture, MembraneError):
            yield Picture(partial(_refuse, str(picture)))
        else:
            time = getattr(picture, "time", None)  # an array has none
            if time is not None and first is None:
                first = time if time > CUT else 0.0
            yield Picture(partial(_image, picture, bits), nan if time is None else begun + time - (first or 0.0))


def _pictures_of_views(path: Path, inputs: Inputs, views: Sequence[View]) -> Iterator[Picture]:
    """Yield the pictures of a bag or of the views' videos, grouped by time; `path`: path of the bag, or of the first view's
    video."""
    files = [path] * len(views) if is_bag(path) else view_files(path, inputs.views)
    topics = inputs.topics if is_bag(path) else [None] * len(views)
    each = zip(files, topics, views, strict=True)
    streams = [_timed(_pictures(file, topic, view.camera.image_size, view.camera.bits, True)) for file, topic, view in each]
    for moment in moments(streams):
        loads = [None if picture is None else picture.picture.load for picture in moment]
        yield Picture(partial(_moment, loads), min(picture.time for picture in moment if picture is not None))


def _timed(pictures: Iterator[Picture]) -> Iterator[TimedPicture[Picture]]:
    """Add times to pictures: a picture without a time is placed one latest interval after its predecessor; an error is the last
    picture."""
    time, interval = -1.0, 1.0
    try:
        for picture in pictures:
            now = time + interval if isnan(picture.time) else picture.time
            interval, time = (now - time if time >= 0 else interval), now
            yield TimedPicture(time, picture)
    except MembraneError as error:
        yield TimedPicture(time + interval, Picture(partial(_refuse, str(error))))


def _moment(loads: Sequence[Load | None], reconstructor: "Reconstructor") -> Loaded:
    """Load the images that belong to one moment, for the views that have one."""
    views, lacking = reconstructor.sensor.views, {}
    images: list[Tensor | None] = []
    for load, view in zip(loads, views, strict=True):
        try:
            images.append(_absent() if load is None else load(reconstructor).image)
        except MembraneError as error:
            images.append(None)
            lacking[view.name] = str(error)
    if len(lacking) == len(views):
        raise MembraneError("; ".join(f"view {name}: {said}" for name, said in lacking.items()))
    return Loaded(grey_views(images, views, "rgb", reconstructor.rest_pixels), lacking)


def _absent() -> NoReturn:
    raise MembraneError("no picture at this moment")


def _bag_image(message: Any, size: tuple[int, int], bits: int | None, reconstructor: "Reconstructor") -> Loaded:
    return Loaded(torch.from_numpy(grey_of(message, size, bits))[None, None].to(reconstructor.rest_pixels))


def _image(picture: Any, bits: int | None, reconstructor: "Reconstructor") -> Loaded:
    """Load the image of a picture, which is an array of grey values or a PyAV frame."""
    of_stack = isinstance(picture, np.ndarray)
    grey = picture if of_stack else to_grey(picture_values(picture, bits))
    return Loaded(torch.from_numpy(grey)[None, None].to(reconstructor.rest_pixels))


def _refuse(reason: str, reconstructor: "Reconstructor") -> NoReturn:
    raise MembraneError(reason)
