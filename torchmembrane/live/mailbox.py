"""The newest picture of a camera, handed from the thread that captures to the one that computes."""

import time
from collections.abc import Iterator
from contextlib import contextmanager
from threading import Condition, Thread
from typing import NamedTuple

import numpy as np

EPOCH = time.time() - time.perf_counter()
ENDING = 1.0
"""Seconds for a camera to give its last picture before its thread is left behind."""


def now() -> float:
    """Seconds since 1970 by a clock that never goes back: set when the program starts."""
    return EPOCH + time.perf_counter()


class CapturedFrame(NamedTuple):
    """An image as it was captured.

    Attributes:
        number: number of the capture, from 0; those of dropped pictures are missing among the pictures taken.
        image: `[height, width]` or `[height, width, 3]`.
        time: time of the capture, as `now` gives it.
    """

    number: int
    image: np.ndarray
    time: float


class Mailbox:
    """Holds one picture: a newer one takes its place.

    Attributes:
        captured: pictures so far.
        ended: whether no picture will come any more.

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

    def put(self, image: np.ndarray) -> None:
        """A picture captured now."""
        with self._changed:
            self._picture = CapturedFrame(self.captured, image, now())
            self.captured += 1
            self._changed.notify()

    def end(self, error: BaseException | None = None) -> None:
        """No picture will come any more, because of an error or without one."""
        with self._changed:
            self.ended, self._error = True, self._error or error
            self._changed.notify()

    def take(self, seconds: float) -> CapturedFrame | None:
        """The picture that waits, or the next one if it comes within so many seconds.

        Raises:
            BaseException: what ended the capture, once the last picture is taken.
        """
        with self._changed:
            self._changed.wait_for(lambda: self._picture is not None or self.ended, seconds)
            picture, self._picture = self._picture, None
            if picture is None and self._error is not None:
                raise self._error
            return picture


@contextmanager
def capture(images: Iterator[np.ndarray]) -> Iterator[Mailbox]:
    """A mailbox into which a thread puts these images as they come, until the block ends."""
    mailbox = Mailbox()
    thread = Thread(target=_capture, args=(images, mailbox), name="capture", daemon=True)
    thread.start()
    try:
        yield mailbox
    finally:
        mailbox.end()
        thread.join(ENDING)


def _capture(images: Iterator[np.ndarray], mailbox: Mailbox) -> None:
    try:
        for image in images:
            if mailbox.ended:
                break
            mailbox.put(image)
        mailbox.end()
    except BaseException as error:  # whatever it is, the computing thread raises it
        mailbox.end(error)
