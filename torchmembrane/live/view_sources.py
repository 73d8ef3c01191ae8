"""Images of several views as they come, one of each for every moment: of cameras, or of files at a pace."""

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
"""Seconds that a moment waits for a camera's picture."""


def moments_of_cameras(cameras: Mapping[str, Iterator[Captured]]) -> Iterator[Captured]:
    """What several cameras show at once: as soon as each has a new picture, the newest of each.

    A camera without one for `PATIENCE` seconds lacks its picture at this moment. One that gives none any more is said once, and
    the others go on.

    Args:
        cameras: by the names of their views, their images as they come.

    Yields:
        Of each view its image, or None.

    Raises:
        BaseException: what ended the last of them.
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
    """A camera's newest image, None where there is none within so many seconds; one that has ended leaves the boxes."""
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
    """The pictures of the views' videos, NAME_VIEW.mp4, as of `video_images`, matched by their times.

    Args:
        path: of the first view's; the others lie beside it.
        views: of the sensor.
        rate: Hz, in place of the videos' own.

    Raises:
        MembraneError: as of `video_images`.
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
    """The images of a folder, NAME_VIEW.png, in name order, due at `rate`, Hz; a view whose image cannot be read lacks it, with
    a warning.

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
