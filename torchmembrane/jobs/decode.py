"""Frames decoded in the background: image files and the pictures of videos, a batch ahead of the one that is computed."""

from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, NoReturn

import torch
from torch import Tensor

from ..errors import MembraneError
from ..io.images import to_grey
from ..io.optional import load_pyav
from .inputs import Inputs

if TYPE_CHECKING:
    from ..reconstruct import Reconstructor

DECODERS = 4


class Source(NamedTuple):
    """A frame still to be decoded: `load()` gives its image `[1, 1, height, width]` or raises `MembraneError`."""

    name: str
    file: Path
    load: Callable[[], Tensor]


class DecodedFrame(NamedTuple):
    """A frame to reconstruct: `image [1, 1, height, width]`, or the reason why there is none."""

    name: str
    file: Path
    image: Tensor | None
    reason: str = ""


def sources(inputs: Inputs, reconstructor: "Reconstructor") -> Iterator[Source]:
    """All frames of the inputs: the images, then the videos' pictures, which are called STEM_NUMBER."""
    for path in inputs.images:
        yield Source(path.stem, path, partial(reconstructor.read, path))
    for path in inputs.videos:
        yield from _video_frames(path, reconstructor)


def read_ahead(sources: Iterator[Source], batch: int) -> Iterator[list[DecodedFrame]]:
    """Batches of decoded frames; while one is used, the next is decoded.

    Args:
        sources: frames to decode, in order.
        batch: the number of frames in a batch.

    Yields:
        Lists of `batch` frames, the last one shorter.
    """
    with ThreadPoolExecutor(1) as reader, ThreadPoolExecutor(DECODERS) as decoders:

        def read() -> list[DecodedFrame]:
            return list(decoders.map(_decoded, islice(sources, batch)))

        following = reader.submit(read)
        while group := following.result():
            following = reader.submit(read)
            yield group


def video_length(path: Path) -> int | None:
    """The number of frames that a video says it has; None where it does not say, or is no video."""
    av = load_pyav()
    try:
        with av.open(str(path)) as container:
            return container.streams.video[0].frames or None
    except (av.FFmpegError, IndexError):
        return None


def _decoded(source: Source) -> DecodedFrame:
    try:
        return DecodedFrame(source.name, source.file, source.load())
    except MembraneError as error:
        return DecodedFrame(source.name, source.file, None, str(error).removeprefix(f"{source.file}: "))


def _video_frames(path: Path, reconstructor: "Reconstructor") -> Iterator[Source]:
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


def _video_image(picture: Any, reconstructor: "Reconstructor") -> Tensor:
    grey = to_grey(picture.to_ndarray(format="rgb24"))
    return torch.from_numpy(grey)[None, None].to(reconstructor.rest_pixels)


def _refuse(reason: str) -> NoReturn:
    raise MembraneError(reason)
