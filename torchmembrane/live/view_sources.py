"""Live images of several views, one per view for every moment, from cameras or from files played at a given rate."""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path

import numpy as np

from ..errors import MembraneError
from ..files.images import read_image
from ..files.order import warn_of_file_times
from ..jobs.inputs import find_inputs, of_first_view
from ..jobs.moments import TimedPicture, moments
from ..sensor.view_images import view_files
from ..sensor.views import View
from ..user_warnings import warn_user
from .mailbox import Captured, Mailbox, capture
from .sources import Timed, video_images

PATIENCE = 0.2
"""Seconds that a moment waits for the picture of a camera."""


def moments_of_cameras(cameras: Mapping[str, Iterator[Captured]]) -> Iterator[Captured]:
    """Yield the images of several cameras for each moment: as soon as every camera has a new picture, the newest of each.

    A camera that delivers no picture for `PATIENCE` seconds has none at this moment. If a camera ends with a `MembraneError`, a
    warning says so and the others continue; a camera that ends without an error is left out silently.

    Args:
        cameras: the images of each camera as they arrive, by the name of its view.

    Yields:
        For each view its image, or None.

    Raises:
        MembraneError: the error that ended the last camera.
        BaseException: any other error of any camera.
    """
    with ExitStack() as stack:
        boxes: dict[str, Mailbox] = {name: stack.enter_context(capture(images)) for name, images in cameras.items()}
        while boxes:
            waited = {name: _taken(name, boxes, PATIENCE) for name in list(boxes)}
            newest = {name: _taken(name, boxes, 0.0) for name in list(boxes)}
            moment = [waited.get(name) if newest.get(name) is None else newest[name] for name in cameras]
            if any(image is not None for image in moment):
                yield moment


def _taken(name: str, boxes: dict[str, Mailbox], seconds: float) -> np.ndarray | None:
    """Return a camera's newest image, or None if none arrives within `seconds`; remove a camera that has ended from the
    boxes."""
    box = boxes[name]
    try:
        picture = box.take(seconds)
    except MembraneError as error:
        if len(boxes) == 1:
            raise
        warn_user(f"view {name}: {error}; the other views go on")
        del boxes[name]
        return None
    if picture is None and box.ended:
        del boxes[name]
    return picture.image if picture is not None and isinstance(picture.image, np.ndarray) else None


def moments_of_videos(path: Path, views: Sequence[View], rate: float | None) -> Iterator[Timed]:
    """Yield the pictures of the views' videos NAME_VIEW.mp4, read as by `video_images`, matched by their times.

    Args:
        path: path of the first view's video; the others lie beside it.
        views: views of the sensor.
        rate: rate in Hz, in place of the videos' own.

    Raises:
        MembraneError: as for `video_images`.
    """
    files = view_files(path, [view.name for view in views])
    streams = [_timed(file, view, rate) for file, view in zip(files, views, strict=True)]
    for moment in moments(streams):
        due = min(picture.time for picture in moment if picture is not None)
        yield Timed(due, [None if picture is None else picture.picture for picture in moment])


def _timed(file: Path, view: View, rate: float | None) -> Iterator[TimedPicture[np.ndarray]]:
    for due, image in video_images(file, view.camera.image_size, rate, view.camera.bits):
        yield TimedPicture(due, np.asarray(image))


def moments_of_folder(folder: Path, views: Sequence[View], rate: float) -> Iterator[Timed]:
    """Yield the images of a folder, NAME_VIEW.png, in name order, due at `rate`, Hz; if a view's image cannot be read, the view
    has none at that moment, with a warning.

    Raises:
        MembraneError: the folder holds no images of the views.
    """
    names = [view.name for view in views]
    firsts = of_first_view(find_inputs([folder]), names).images
    warn_of_file_times(firsts)
    for number, first in enumerate(firsts):
        images = [_read(file, view) for file, view in zip(view_files(first, names), views, strict=True)]
        if any(image is not None for image in images):
            yield Timed(number / rate, images)


def _read(file: Path, view: View) -> np.ndarray | None:
    try:
        return read_image(file, view.camera.image_size, view.camera.bits)
    except MembraneError as error:
        warn_user(f"{error}; view {view.name} lacks it")
        return None
