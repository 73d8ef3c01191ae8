"""The loop: take the newest picture, compute, hand on what was seen; and what is counted on the way."""

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
from .mailbox import Mailbox, now
from .streams import Stream

WAIT = 0.1
"""Seconds after which the loop looks whether it shall stop, though no picture comes."""
RECENT = 100
"""Frames over which the rate and latency that are shown as they go are taken."""
Request = Callable[[Stream], str]
"""A request to a stream between two frames, such as taking the latest one for rest; it returns the answer."""


class LiveFrame(NamedTuple):
    """A frame as it was followed.

    Attributes:
        number: number of the capture, from 0.
        time: time of the capture, seconds since 1970.
        image: as it was captured.
        frame: its result's arrays.
        latency: from the capture to the result, seconds.
    """

    number: int
    time: float
    image: np.ndarray
    frame: Frame
    latency: float

    @property
    def name(self) -> str:
        """Of the frame in a recording: its number.

        Example:
            >>> LiveFrame(12, 0.0, np.zeros((1, 1)), {}, 0.0).name
            '000012'
        """
        return f"{self.number:06d}"


class StreamStats:
    """Counts of a run.

    Attributes:
        captured: pictures, to the latest one that was followed.
        failed: frames without a surface.
        times: times of the captures of the frames followed, seconds since 1970.
        latencies: latencies of the same, seconds.

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
        """One more frame."""
        self.captured = seen.number + 1
        self.failed += not Status(int(seen.frame["status"])).has_surface
        self.times.append(seen.time)
        self.latencies.append(seen.latency)

    @property
    def followed(self) -> int:
        """Frames that have a result."""
        return len(self.times)

    @property
    def dropped(self) -> int:
        """Pictures that a newer one displaced before they could be taken."""
        return self.captured - self.followed

    def rate(self, frames: int = 0) -> float:
        """Frames per second, of the last so many, by default of all; NaN before there are two."""
        times = self.times[-frames:]
        return (len(times) - 1) / (times[-1] - times[0]) if len(times) > 1 else float("nan")

    def latency(self, percent: float, frames: int = 0) -> float:
        """Seconds that so many percent of the latencies do not exceed, of the last so many frames, by default of all; NaN
        before there is one."""
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
    """Follow a camera until it ends or is stopped.

    Args:
        stream: computes.
        mailbox: has the newest picture.
        stats: is given every frame.
        watchers: called with every frame and the counts so far, at once: what takes long is theirs to put off.
        stop: set to end.
        requests: asked of the stream before the next frame, and taken out; one that is refused is said.
        report: called with what is to be said.

    Raises:
        MembraneError: an image of another size than the sensor's, or what the source raised.
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
    """Take the latest frame for rest."""
    stream.rezero()
    return "the latest frame is taken for rest"
