"""Matching of the pictures of several views by their times: one frame per moment."""

from collections import deque
from collections.abc import Iterator, Sequence
from math import inf
from statistics import median
from typing import Generic, NamedTuple, TypeVar

Image = TypeVar("Image")
RECENT = 15
"""Number of latest intervals between pictures whose median is taken as the usual interval."""


class TimedPicture(NamedTuple, Generic[Image]):
    """A picture and its time in seconds."""

    time: float
    picture: Image


def moments(streams: Sequence[Iterator[TimedPicture[Image]]]) -> Iterator[list[TimedPicture[Image] | None]]:
    """Yield the pictures of all views for each moment, in the order of time.

    A moment begins with the earliest remaining picture. The next picture of another view belongs to the same moment if its
    delay is at most half the interval to the next picture in the earliest picture's own view; if that picture may have been
    lost, the interval is the median of the latest `RECENT` intervals. Otherwise that view has no picture at this moment.

    Args:
        streams: pictures of each view, in the order of time. A picture whose time is earlier than that of its predecessor,
            because a clock was set back, is a moment of its own.

    Yields:
        For each view its picture, or None.

    Example:
        >>> left, right = ([TimedPicture(time, None) for time in times] for times in ((0.0, 0.1, 0.2), (0.02, 0.21)))
        >>> [[picture and picture.time for picture in moment] for moment in moments([iter(left), iter(right)])]
        [[0.0, 0.02], [0.1, None], [0.2, 0.21]]
    """
    queues = [_Queue(stream) for stream in streams]
    while waiting := [queue for queue in queues if queue.next is not None]:
        first = min(waiting, key=lambda queue: queue.time)
        latest = first.time + first.interval / 2
        yield [queue.taken() if queue.time <= latest else None for queue in queues]


class _Queue(Generic[Image]):
    """The pictures of a view, read two ahead."""

    def __init__(self, stream: Iterator[TimedPicture[Image]]):
        self._stream, self._intervals = stream, deque[float](maxlen=RECENT)
        self.next: TimedPicture[Image] | None = next(stream, None)
        self._after: TimedPicture[Image] | None = None
        self._look_ahead()

    @property
    def time(self) -> float:
        """Time of the next picture; infinite if none is left."""
        return inf if self.next is None else self.next.time

    @property
    def interval(self) -> float:
        """Interval from the next picture to the one after it, or the median of the latest intervals if that is shorter,
        seconds; 0 if the clock is set back in between."""
        usual = median(self._intervals) if self._intervals else inf
        return usual if self._after is None else min(usual, max(0.0, self._after.time - self.time))

    def taken(self) -> TimedPicture[Image] | None:
        """Remove and return the next picture."""
        taken, self.next = self.next, self._after
        self._look_ahead()
        return taken

    def _look_ahead(self) -> None:
        self._after = None if self.next is None else next(self._stream, None)
        if self._after is not None and self._after.time > self.time:
            self._intervals.append(self._after.time - self.time)
