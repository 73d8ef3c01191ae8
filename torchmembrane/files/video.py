"""Videos decoded by PyAV, with any file name, also if they are damaged or cut off."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from ..errors import MembraneError
from .images import to_grey
from .optional import load_pyav
from .safe_read import in_one_line
from .video_end import missing_end

Said = TypeVar("Said", int, float)

GREY_OF_16 = ("gray16le", "gray16be")
"""Formats of pictures, as FFmpeg calls them."""
NOT_WHOLE = "it, or one that it is coded by, is not whole"
TIMED = "matroska"
"""The format, as FFmpeg calls it, that tells a film's duration at its beginning, and no number of frames."""
WHOLE = 0.01
"""By how much duration times rate may be off a number of frames."""


def ffmpeg_name(path: Path) -> str:
    """A file's name for FFmpeg, which would read the text before a colon as a protocol.

    Example:
        >>> ffmpeg_name(Path("12:30:05.mp4"))
        'file:12:30:05.mp4'
    """
    return f"file:{path}"


def video_pictures(path: Path, size: tuple[int, int]) -> Iterator[Any]:
    """The pictures of a video one after another, as PyAV gives them; in place of a damaged one, the error.

    The pictures after a damaged one count as damaged too, up to the next key frame.

    Args:
        path: path of the video.
        size: width and height that they must have, px.

    Yields:
        `av.VideoFrame`, or a `MembraneError` that does not name the file.

    Raises:
        MembraneError: PyAV is not installed; the file is not a video, has another size, or ends early; the message then says
            how many frames it holds and should hold.
    """
    av, number, damage = load_pyav(), 0, ""
    with _opened(path) as (container, stream):
        _refuse_size(stream, size)
        missing = missing_end(path)
        for packet in container.demux(stream):
            try:
                decoded = packet.decode()
            except av.FFmpegError as error:
                damage = _cause(error)
                if not missing:  # else it may be the last one, cut off, of which the end tells
                    number += 1
                    yield MembraneError(f"a damaged picture ({damage})")
                continue
            for picture in decoded:
                _refuse_size(picture, size)
                number += 1
                damage = NOT_WHOLE if picture.is_corrupt else "" if picture.key_frame else damage
                yield MembraneError(f"a damaged picture ({damage})") if damage else picture
        if missing:
            raise MembraneError(
                f"the file ends early: {number}{_of_how_many(number, container, stream)} frames are there, {missing}; expected "
                "a whole video: copy or record it again"
            )


def picture_values(picture: Any, bits: int | None = None) -> np.ndarray:
    """A picture's values: RGB `[height, width, 3]` uint8; of a video of 16-bit grey `[height, width]` in 0..1.

    Args:
        picture: picture of a video, as PyAV gives it.
        bits: bits of the camera, where 16 hold fewer.

    Raises:
        MembraneError: values beyond `bits`.
    """
    if picture.format.name in GREY_OF_16:
        return to_grey(picture.to_ndarray(), bits)
    values: np.ndarray = picture.to_ndarray(format="rgb24")
    return values


def picture_rate(path: Path) -> float | None:
    """The average frame rate that a video declares; None if it declares none or is no video.

    Raises:
        MembraneError: PyAV is not installed.
    """
    return _said(path, lambda stream: float(stream.average_rate or 0) or None)


def picture_total(path: Path) -> int | None:
    """The number of pictures that a video declares; None if it declares none or is no video.

    Raises:
        MembraneError: PyAV is not installed.
    """
    return _said(path, lambda stream: stream.frames or None)


def _said(path: Path, of: Callable[[Any], Said | None]) -> Said | None:
    """A property that a video declares; None for a file that is no video."""
    load_pyav()
    try:
        with _opened(path) as (_, stream):
            return of(stream)
    except MembraneError:
        return None


@contextmanager
def _opened(path: Path) -> Iterator[tuple[Any, Any]]:
    """A video and its stream of pictures."""
    av, expected = load_pyav(), "expected a video that FFmpeg decodes"
    if not path.is_file():
        raise MembraneError(f"no such file; {expected}")
    try:
        with av.open(ffmpeg_name(path), metadata_errors="replace") as container:
            yield container, _stream(container)
    except av.FFmpegError as error:
        missing = missing_end(path)
        raise MembraneError(
            f"not readable as a video ({_cause(error)}{f'; {missing}' if missing else ''}); {expected}"
        ) from error


def _stream(container: Any) -> Any:
    """The first stream of pictures that is more than the cover of a sound file."""
    streams = container.streams.video
    moving = [stream for stream in streams if not stream.disposition & type(stream.disposition).attached_pic]
    if not moving:
        held = "sound" if container.streams.audio else "no pictures"
        cover = " and a cover picture" if streams else ""
        raise MembraneError(f"no video: the file holds {held}{cover}; expected a video")
    return moving[0]


def _refuse_size(pictures: Any, size: tuple[int, int]) -> None:
    if (pictures.width, pictures.height) != size:
        raise MembraneError(
            f"images of {pictures.width} x {pictures.height} px; expected the sensor's {size[0]} x {size[1]}: choose that mode "
            "of the camera, or say in the file's [camera] how its mode crops or bins"
        )


def _of_how_many(found: int, container: Any, stream: Any) -> str:
    """In words, how many pictures a video should have, if it declares more than were found."""
    told = stream.frames
    if not told and TIMED in container.format.name and container.duration and stream.average_rate:
        told = container.duration / 1e6 * float(stream.average_rate)
    about = "" if abs(told - round(told)) < WHOLE else "about "
    return f" of {about}{round(told)}" if told > found else ""


def _cause(error: Exception) -> str:
    return in_one_line(getattr(error, "strerror", None) or error)
