"""Decoding of videos with PyAV, under any file name, including damaged and truncated files."""

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
"""FFmpeg's names of the 16-bit grey pixel formats."""
NOT_WHOLE = "it, or one that it is coded by, is not whole"
TIMED = "matroska"
"""FFmpeg's name of the container format that states a duration at its beginning, but no number of frames."""
WHOLE = 0.01
"""Largest difference between duration times rate and a whole number of frames."""


def ffmpeg_name(path: Path) -> str:
    """Return a file name for FFmpeg, which would read the text before a colon as a protocol.

    Example:
        >>> ffmpeg_name(Path("12:30:05.mp4"))
        'file:12:30:05.mp4'
    """
    return f"file:{path}"


def video_pictures(path: Path, size: tuple[int, int]) -> Iterator[Any]:
    """Yield the pictures of a video one by one as PyAV decodes them; for a damaged picture, yield the error instead.

    The pictures after a damaged one count as damaged too, up to the next key frame.

    Args:
        path: path of the video.
        size: required width and height, px.

    Yields:
        `av.VideoFrame`, or a `MembraneError` that does not name the file.

    Raises:
        MembraneError: PyAV is not installed; the file is not a video, has another size, or ends early; in the last case the
            message states how many frames the file holds and should hold.
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
    """Return the values of a picture: RGB `[height, width, 3]` uint8; for 16-bit grey video `[height, width]` in 0..1.

    Args:
        picture: picture of a video, as decoded by PyAV.
        bits: bit depth of the camera, if 16-bit values use fewer bits.

    Raises:
        MembraneError: a value exceeds `bits`.
    """
    if picture.format.name in GREY_OF_16:
        return to_grey(picture.to_ndarray(), bits)
    values: np.ndarray = picture.to_ndarray(format="rgb24")
    return values


def picture_rate(path: Path) -> float | None:
    """Return the average frame rate that a video declares; None if it declares none or is not a video.

    Raises:
        MembraneError: PyAV is not installed.
    """
    return _said(path, lambda stream: float(stream.average_rate or 0) or None)


def picture_total(path: Path) -> int | None:
    """Return the number of pictures that a video declares; None if it declares none or is not a video.

    Raises:
        MembraneError: PyAV is not installed.
    """
    return _said(path, lambda stream: stream.frames or None)


def _said(path: Path, of: Callable[[Any], Said | None]) -> Said | None:
    """Return a property that a video declares; None if the file is not a video."""
    load_pyav()
    try:
        with _opened(path) as (_, stream):
            return of(stream)
    except MembraneError:
        return None


@contextmanager
def _opened(path: Path) -> Iterator[tuple[Any, Any]]:
    """Open a video; yield it and its video stream."""
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
    """Return the first video stream that is not merely the cover image of an audio file."""
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
    """Return the number of pictures that a video should have, in words, if it declares more than were found."""
    told = stream.frames
    if not told and TIMED in container.format.name and container.duration and stream.average_rate:
        told = container.duration / 1e6 * float(stream.average_rate)
    about = "" if abs(told - round(told)) < WHOLE else "about "
    return f" of {about}{round(told)}" if told > found else ""


def _cause(error: Exception) -> str:
    return in_one_line(getattr(error, "strerror", None) or error)
