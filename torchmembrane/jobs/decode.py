"""Frames decoded in the background: images, and the pictures of videos, bags and stacks of images, a batch ahead of the one
that is computed."""

from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from itertools import islice
from math import isnan, nan
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, NoReturn, TypeAlias

import numpy as np
import torch
from torch import Tensor

from ..camera.model import Camera
from ..errors import MembraneError
from ..files.images import picture_count, stack_images, to_grey
from ..files.provenance import SourceFile
from ..files.timestamps import time_in
from ..files.video import picture_total, picture_values, video_pictures
from ..integrations.messages import grey_of
from ..integrations.rosbag import image_topic, is_bag, messages
from ..sensor.view_images import view_files
from .inputs import Inputs, frame_name, picture_name

if TYPE_CHECKING:
    from ..reconstruct import Reconstructor

DECODERS = 4
LONGEST_NAME = 251
"""Bytes of a frame's name, so that there can be a file NAME.npz."""


Load: TypeAlias = Callable[["Reconstructor"], Tensor]
"""Gives a frame's image `[1, 1, height, width]` or raises `MembraneError`."""


class Picture(NamedTuple):
    """A picture of a file with several: the function that loads its image, and its time in seconds, NaN if it is not known."""

    load: Load
    time: float = float("nan")


class Source(NamedTuple):
    """A frame still to be decoded: `load(reconstructor)` gives its image `[1, 1, height, width]` or raises `MembraneError`.

    Those of image files can be sent to another process.
    """

    name: str
    file: Path
    load: Load
    origin: SourceFile | None = None


class DecodedFrame(NamedTuple):
    """A frame to reconstruct: `image [1, 1, height, width]`, or the reason why there is none."""

    name: str
    file: Path
    image: Tensor | None
    reason: str = ""
    origin: SourceFile = SourceFile()

    def but(self, error: Exception) -> "DecodedFrame":
        """The same frame without an image, because of an error."""
        return self._replace(image=None, reason=str(error).removeprefix(f"{self.file}: "))


def sources(inputs: Inputs, reconstructor: "Reconstructor") -> Iterator[Source]:
    """All frames of the inputs: the images, then the pictures of videos, bags and stacks, which are called STEM_NUMBER."""
    yield from map(source_of, inputs.images)
    for path in inputs.videos:
        yield from _frames(path, _pictures(path, inputs.topic, reconstructor))


def source_of(path: Path) -> Source:
    """The frame of an image file."""
    return Source(frame_name(path), path, partial(_read, path))


def decoded(source: Source, reconstructor: "Reconstructor") -> DecodedFrame:
    """A frame's image, or the reason why there is none."""
    frame = DecodedFrame(source.name, source.file, None)
    try:
        if len(source.name.encode()) > LONGEST_NAME:
            raise MembraneError(f"its name has {len(source.name.encode())} bytes; expected {LONGEST_NAME} at most: rename it")
        origin = source.origin or source_file_of(*view_files(source.file, reconstructor.sensor.views_apart))
        return frame._replace(image=source.load(reconstructor), origin=origin)
    except MembraneError as error:
        return frame.but(error)


def source_file_of(*paths: Path) -> SourceFile:
    """The origin of a frame in this file, or in those of all views.

    Raises:
        MembraneError: one is not a regular file (a pipe would be waited for), or cannot be read.
    """
    try:
        for path in paths:
            if not path.is_file():
                raise MembraneError(f"{path}: not a regular file; expected an image or a video")
        return SourceFile.from_files(*paths)
    except OSError as error:
        raise MembraneError(f"{error.filename or paths[0]}: not readable ({error})") from error


def read_ahead(sources: Iterator[Source], reconstructor: "Reconstructor", batch: int) -> Iterator[list[DecodedFrame]]:
    """Yield batches of decoded frames, and decode the next one while one is used.

    Args:
        sources: frames to decode, in order.
        reconstructor: reconstructor of the sensor.
        batch: the number of frames in a batch.

    Yields:
        Lists of `batch` frames, the last one shorter.
    """
    with ThreadPoolExecutor(1) as reader, ThreadPoolExecutor(DECODERS) as decoders:

        def read() -> list[DecodedFrame]:
            return list(decoders.map(lambda source: decoded(source, reconstructor), islice(sources, batch)))

        following = reader.submit(read)
        while group := following.result():
            following = reader.submit(read)
            yield group


def length_of(path: Path, topic: str | None) -> int | None:
    """The number of frames that a video, bag or stack declares; None if it declares none or is none of these."""
    return image_topic(path, topic)[1] if is_bag(path) else picture_count(path) or picture_total(path)


def _read(path: Path, reconstructor: "Reconstructor") -> Tensor:
    return reconstructor.read(path)


def _frames(path: Path, pictures: Iterator[Picture]) -> Iterator[Source]:
    """The frames of a file with several, one after another; if the file breaks off, its error is the last frame."""
    number = -1
    try:
        origin = source_file_of(path)
        for number, picture in enumerate(pictures):
            yield Source(picture_name(path, number), path, picture.load, origin._replace(time=picture.time))
        if number < 0:
            raise MembraneError("holds no picture")
    except MembraneError as error:
        refusal = partial(_refuse, str(error).removeprefix(f"{path}: "))
        yield Source(picture_name(path, number + 1), path, refusal, SourceFile())


def _pictures(path: Path, topic: str | None, reconstructor: "Reconstructor") -> Iterator[Picture]:
    """The pictures of a file with several.

    In a bag the time is that of the header, or else of the reception; in a video it counts from the beginning, whose time the
    file name may give.
    """
    if is_bag(path):
        _only_camera(path, reconstructor)
        yield from (
            Picture(partial(_bag_image, each.message), each.time) for each in messages(path, image_topic(path, topic)[0])
        )
        return
    camera, of_stack, begun = _only_camera(path, reconstructor), picture_count(path, 1) > 0, time_in(path.stem)
    begun = 0.0 if isnan(begun) else begun
    for picture in stack_images(path, camera.image_size, camera.bits) if of_stack else video_pictures(path, camera.image_size):
        if isinstance(picture, MembraneError):
            yield Picture(partial(_refuse, str(picture)))
        else:
            after = getattr(picture, "time", None)  # an array has none
            yield Picture(partial(_image, picture), nan if after is None else begun + after)


def _only_camera(path: Path, reconstructor: "Reconstructor") -> Camera:
    """The camera whose images a file of several pictures holds."""
    if reconstructor.sensor.views:
        raise MembraneError(f"{path}: holds several pictures; of a sensor with several views expected images, NAME_VIEW.png")
    return reconstructor.sensor.camera


def _bag_image(message: Any, reconstructor: "Reconstructor") -> Tensor:
    grey = grey_of(message, reconstructor.sensor.camera.image_size, reconstructor.sensor.camera.bits)
    return torch.from_numpy(grey)[None, None].to(reconstructor.rest_pixels)


def _image(picture: Any, reconstructor: "Reconstructor") -> Tensor:
    """The image of a picture: grey values, or what PyAV gives."""
    of_stack = isinstance(picture, np.ndarray)
    grey = picture if of_stack else to_grey(picture_values(picture, reconstructor.sensor.camera.bits))
    return torch.from_numpy(grey)[None, None].to(reconstructor.rest_pixels)


def _refuse(reason: str, reconstructor: "Reconstructor") -> NoReturn:
    raise MembraneError(reason)
