"""A mailbox for the newest picture of a camera, between the capturing thread and the computing thread."""

import time
from collections.abc import Iterator
from contextlib import contextmanager
from threading import Condition, Thread
from typing import NamedTuple, TypeAlias

import numpy as np

EPOCH = time.time() - time.perf_counter()
ENDING = 1.0
"""Seconds to wait for a camera's last picture before its thread is abandoned."""


Captured: TypeAlias = "np.ndarray | list[np.ndarray | None]"
"""An image `[height, width]` or `[height, width, 3]`; for views with images of their own, a list with an image or None for
each."""


def now() -> float:
    """Return seconds since 1970 by a monotonic clock, which is set when the program starts."""
    return EPOCH + time.perf_counter()


class CapturedFrame(NamedTuple):
    """An image as captured.

    Attributes:
        number: number of the capture, from 0; the numbers of dropped pictures are skipped.
        image: image as captured.
        time: capture time, as returned by `now`.
    """

    number: int
    image: Captured
    time: float


class Mailbox:
    """A mailbox for one picture: a newer picture replaces it.

    Attributes:
        captured: number of pictures so far.
        ended: whether no more pictures will come.

    Example:
        >>> mailbox = Mailbox()
        >>> for value in range(3):
        ...     mailbox.put(np.full((1, 1), value))
        >>> mailbox.take(0.0).image.item(), mailbox.captured, mailbox.take(0.0)
        (2, 3, None)
    """

    def __init__(self) -> None:
        self.captured, self.ended = 0, False
        self._picture: CapturedFrame | None = None
        self._error: BaseException | None = None
        self._changed = Condition()

    def put(self, image: Captured) -> None:
        """Put in a picture captured now."""
        with self._changed:
            self._picture = CapturedFrame(self.captured, image, now())
            self.captured += 1
            self._changed.notify()

    def end(self, error: BaseException | None = None) -> None:
        """Declare that no more pictures will come, with or without an error as the cause."""
        with self._changed:
            self.ended, self._error = True, self._error or error
            self._changed.notify()

    def take(self, seconds: float) -> CapturedFrame | None:
        """Return the waiting picture, or the next one if it arrives within `seconds`; otherwise None.

        Raises:
            BaseException: the error that ended the capture, once the last picture has been taken.
        """
        with self._changed:
            self._changed.wait_for(lambda: self._picture is not None or self.ended, seconds)
            picture, self._picture = self._picture, None
            if picture is None and self._error is not None:
                raise self._error
            return picture


@contextmanager
def capture(images: Iterator[Captured]) -> Iterator[Mailbox]:
    """Yield a mailbox that a thread fills with these images as they arrive, until the block ends."""
    mailbox = Mailbox()
    thread = Thread(target=_capture, args=(images, mailbox), name="capture", daemon=True)
    thread.start()
    try:
        yield mailbox
    finally:
        mailbox.end()
        thread.join(ENDING)


def _capture(images: Iterator[Captured], mailbox: Mailbox) -> None:
    try:
        for image in images:
            if mailbox.ended:
                break
            mailbox.put(image)
        mailbox.end()
    except BaseException as error:  # whatever it is, the computing thread raises it
        mailbox.end(error)
