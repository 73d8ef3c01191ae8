"""Sources of live images: a camera, or files played at a given rate."""

import time
from collections.abc import Generator, Iterable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ..errors import MembraneError
from ..files.images import picture_count, stack_images
from ..files.optional import load_opencv
from ..files.order import in_order, warn_of_file_times
from ..files.video import picture_rate, picture_values, video_pictures
from ..jobs.inputs import find_inputs
from ..user_warnings import warn_user
from .mailbox import Captured

MOST_MISSED = 100
"""Number of consecutive failed reads after which a camera is given up."""
BREATH = 0.01
"""Seconds between failed reads."""
IMAGE_RATE = 30.0
"""Default rate, Hz, for images and for videos that declare no rate."""


class Timed(NamedTuple):
    """An image of a recording and the time at which it is due, in seconds since the beginning of the recording."""

    due: float
    image: Captured


def camera_images(camera: int | str, size: tuple[int, int]) -> Iterator[np.ndarray]:
    """Yield the images of a camera through OpenCV, RGB `[height, width, 3]` or grey `[height, width]`, without end.

    Args:
        camera: number of the camera, or the path or address of a stream that OpenCV opens.
        size: requested and expected width and height, px.

    Raises:
        MembraneError: OpenCV is missing or cannot open the camera; the images have another size, or no image comes any more.
    """
    return images_of(opened_camera(camera, size), camera, size)


def opened_camera(camera: int | str, size: tuple[int, int] | None) -> Any:
    """Open a camera and return its `cv2.VideoCapture`.

    Args:
        camera: as for `camera_images`.
        size: requested width and height, px; None: the camera's own.

    Raises:
        MembraneError: OpenCV is missing or cannot open the camera.
    """
    cv2 = load_opencv("cameras need OpenCV")
    opened = cv2.VideoCapture(camera)
    if not opened.isOpened():
        raise MembraneError(f"--camera {camera}: cannot be opened; expected a camera's number, 0 the first, or its path")
    if size is not None:
        opened.set(cv2.CAP_PROP_FRAME_WIDTH, size[0])
        opened.set(cv2.CAP_PROP_FRAME_HEIGHT, size[1])
    opened.set(cv2.CAP_PROP_ORIENTATION_AUTO, 0)  # images and videos are not turned either
    return opened


def images_of(opened: Any, camera: int | str, size: tuple[int, int] | None) -> Generator[np.ndarray, None, None]:
    """Yield the images of an open camera, as `camera_images` does, until no more come; then release the camera."""
    missed = 0
    try:
        while missed < MOST_MISSED:
            taken, image = opened.read()
            if taken:
                missed = 0
                image = _red_first(image, camera)
                yield image if size is None else _checked(image, size, f"--camera {camera}")
            else:
                missed += 1
                time.sleep(BREATH)
        raise MembraneError(f"--camera {camera}: no image in {missed} reads; is it unplugged, or used by another program?")
    finally:
        opened.release()


def _red_first(image: np.ndarray, camera: int | str) -> np.ndarray:
    """Convert a frame of OpenCV (grey, BGR or BGRA) to grey `[height, width]` or RGB."""
    channels = 1 if image.ndim == 2 else image.shape[-1]
    if channels == 1:
        return image.reshape(image.shape[:2])
    if channels not in (3, 4):
        raise MembraneError(
            f"--camera {camera}: frames {list(image.shape)}; expected grey, BGR or BGRA: choose another format of the camera "
            "(two channels are mostly YUV)"
        )
    return image[..., 2::-1]


def video_images(path: Path, size: tuple[int, int], rate: float | None, bits: int | None = None) -> Iterator[Timed]:
    """Yield the pictures of a video, RGB `[height, width, 3]` uint8 or grey `[height, width]` in 0..1, due at its own rate or
    at `rate`, Hz; the pictures of an image file, which has no rate of its own, at `IMAGE_RATE`.

    A damaged picture is skipped with a warning.

    Raises:
        MembraneError: PyAV is missing; the file is not a video, ends early, or has another size.
    """
    if picture_count(path, 1):
        yield from _of_files([path], size, rate or IMAGE_RATE, bits)
        return
    own = rate or picture_rate(path) or IMAGE_RATE
    try:
        for number, picture in enumerate(video_pictures(path, size)):
            if isinstance(picture, MembraneError):
                _leave_out(f"--video {path}: frame {number}: {picture}")
                continue
            due = number / own if rate or picture.time is None else picture.time
            yield Timed(due, picture_values(picture, bits))
    except MembraneError as error:
        raise MembraneError(f"--video {path}: {error}") from error


def folder_images(folder: Path, size: tuple[int, int], rate: float, bits: int | None = None) -> Iterator[Timed]:
    """Yield the images of a folder in name order, and all pictures of a file of several, as grey `[height, width]` in 0..1, due
    at `rate`, Hz.

    An image that cannot be read is skipped with a warning.

    Raises:
        MembraneError: the folder holds no images.
    """
    found = find_inputs([folder])
    paths = sorted([*found.images, *found.videos], key=in_order)
    warn_of_file_times(paths)
    yield from _of_files(paths, size, rate, bits)


def _of_files(paths: Iterable[Path], size: tuple[int, int], rate: float, bits: int | None) -> Iterator[Timed]:
    number = 0
    for path in paths:
        try:
            for image in stack_images(path, size, bits):
                if isinstance(image, MembraneError):
                    _leave_out(f"{path}: {image}")
                else:
                    yield Timed(number / rate, image)
                number += 1
        except MembraneError as error:
            _leave_out(error)
            number += 1


def _leave_out(said: object) -> None:
    warn_user(f"{said}; left out")


def paced(images: Iterable[Timed]) -> Iterator[Captured]:
    """Yield images when they are due; images that are late are yielded at once.

    Example:
        >>> [image.item() for image in paced(Timed(0.001 * k, np.array(k)) for k in range(3))]
        [0, 1, 2]
    """
    start = None
    for due, image in images:
        start = time.monotonic() - due if start is None else start
        time.sleep(max(0.0, start + due - time.monotonic()))
        yield image


def _checked(image: np.ndarray, size: tuple[int, int], source: str) -> np.ndarray:
    height, width = image.shape[:2]
    if (width, height) != size:
        raise MembraneError(
            f"{source}: images of {width} x {height} px; expected the sensor's {size[0]} x {size[1]}: choose that mode of the "
            "camera, or say in the file's [camera] how its mode crops or bins"
        )
    return image
