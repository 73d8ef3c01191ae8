"""The live loop: take the newest picture, reconstruct it, pass the result on, and keep statistics."""

from array import array
from collections import deque
from collections.abc import Callable, Sequence
from threading import Event
from typing import NamedTuple

import numpy as np

from ..errors import MembraneError
from ..interruption import frame_in_work
from ..results.reconstruction import Frame
from ..results.status import Status
from .mailbox import Captured, Mailbox, now
from .streams import Stream

WAIT = 0.1
"""Seconds after which the loop checks whether to stop if no picture arrives."""
RECENT = 100
"""Number of latest frames over which the displayed rate and latency are taken."""
Request = Callable[[Stream], str]
"""A request to a stream between two frames, such as taking the latest one for rest; it returns a message."""


class LiveFrame(NamedTuple):
    """A reconstructed frame of a stream.

    Attributes:
        number: number of the captured picture, from 0.
        time: time of the capture, seconds since 1970.
        image: image as captured.
        frame: arrays of the result.
        latency: time from the capture to the result, seconds.
    """

    number: int
    time: float
    image: Captured
    frame: Frame
    latency: float

    @property
    def images(self) -> list[np.ndarray | None]:
        """Return the image in a list, or the images of all views."""
        return [self.image] if isinstance(self.image, np.ndarray) else self.image

    @property
    def name(self) -> str:
        """Name of the frame in a recording: its number.

        Example:
            >>> LiveFrame(12, 0.0, np.zeros((1, 1)), {}, 0.0).name
            '000012'
        """
        return f"{self.number:06d}"


class StreamStats:
    """Statistics of a run.

    Attributes:
        captured: number of pictures up to the latest reconstructed one.
        failed: number of frames without a surface.
        times: capture times of the reconstructed frames, seconds since 1970.
        latencies: latencies of the same frames, seconds.

    Example:
        >>> stats = StreamStats()
        >>> for k in range(5):
        ...     stats.add(LiveFrame(2 * k, 0.1 * k, np.zeros((1, 1)), {"status": np.array(0)}, 0.02))
        >>> stats.followed, stats.captured, stats.dropped, round(stats.rate(), 6), stats.latency(50)
        (5, 9, 4, 10.0, 0.02)
    """

    def __init__(self) -> None:
        self.captured = self.failed = 0
        self.times, self.latencies = array("d"), array("d")

    def add(self, seen: LiveFrame) -> None:
        """Add a frame."""
        self.captured = seen.number + 1
        self.failed += not Status(int(seen.frame["status"])).has_surface
        self.times.append(seen.time)
        self.latencies.append(seen.latency)

    @property
    def followed(self) -> int:
        """Number of frames that have a result."""
        return len(self.times)

    @property
    def dropped(self) -> int:
        """Number of pictures that were replaced by a newer one before they could be taken."""
        return self.captured - self.followed

    def rate(self, frames: int = 0) -> float:
        """Return frames per second over the last `frames` frames, by default over all; NaN for fewer than two frames."""
        times = self.times[-frames:]
        return (len(times) - 1) / (times[-1] - times[0]) if len(times) > 1 else float("nan")

    def latency(self, percent: float, frames: int = 0) -> float:
        """Return a percentile of the latencies, seconds, over the last `frames` frames, by default over all; NaN if there are
        none."""
        return float(np.percentile(self.latencies[-frames:], percent)) if self.followed else float("nan")


def follow(
    stream: Stream,
    mailbox: Mailbox,
    stats: StreamStats,
    watchers: Sequence[Callable[[LiveFrame, StreamStats], None]],
    stop: Event,
    requests: deque[Request] | None = None,
    report: Callable[[str], None] = print,
) -> None:
    """Reconstruct the pictures of a camera until it ends or is stopped.

    Args:
        stream: computes the results.
        mailbox: holds the newest picture.
        stats: receives every frame.
        watchers: functions called synchronously with every frame and the statistics so far; they must defer slow work.
        stop: event that ends the loop.
        requests: queue of requests that are removed and sent to the stream before the next frame; a refusal is reported.
        report: function called with each message.

    Raises:
        MembraneError: the size of an image differs from the sensor's; any error of the source is raised as well.
    """
    while not stop.is_set():
        while requests:
            report(_answer(requests.popleft(), stream))
        picture = mailbox.take(WAIT)
        if picture is None:
            if mailbox.ended:
                break
            continue
        with frame_in_work():
            frame = stream(picture.image, picture.time)
        seen = LiveFrame(picture.number, picture.time, picture.image, frame, now() - picture.time)
        stats.add(seen)
        for watcher in watchers:
            watcher(seen, stats)


def _answer(request: Request, stream: Stream) -> str:
    try:
        return request(stream)
    except MembraneError as error:
        return f"not done: {error}"


def rezeroed(stream: Stream) -> str:
    """Take the latest frame for rest, and return a message."""
    stream.rezero()
    return "the latest frame is taken for rest"
