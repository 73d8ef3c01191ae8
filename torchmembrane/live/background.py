"""Background work that must not delay the loop: it is done by another thread, from a queue of bounded length."""

from collections.abc import Callable
from queue import Full, Queue
from threading import Thread
from types import TracebackType
from typing import Generic, TypeVar

Item = TypeVar("Item")
DEPTH = 64
"""Largest number of waiting items; for colour images of 640 x 480 pixels, 59 MB."""


class Background(Generic[Item]):
    """Process items in a separate thread: `with Background(keep) as later`, then `later(item)`, which never waits.

    An item for which the queue has no room is dropped and counted, as is an item for which `keep` raises an error. The first
    error is reported at once, and raised when the block ends; later items are still processed. Leaving the block waits until
    the queue is empty.

    Args:
        keep: function called with each item, in order.
        depth: largest number of waiting items.
        tell: function called from the other thread with the first error.

    Attributes:
        late: number of items for which there was no room.
        failed: number of items for which `keep` raised an error.
        error: the first of these errors.

    Example:
        >>> kept = []
        >>> with Background(kept.append) as later:
        ...     for item in range(3):
        ...         later(item)
        >>> kept, later.dropped
        ([0, 1, 2], 0)
    """

    def __init__(
        self, keep: Callable[[Item], None], depth: int = DEPTH, tell: Callable[[BaseException], None] = lambda error: None
    ):
        self.keep, self.tell, self.late, self.failed = keep, tell, 0, 0
        self.error: BaseException | None = None
        self._waiting: Queue[Item | None] = Queue(depth)
        self._thread = Thread(target=self._work, name="background", daemon=True)

    @property
    def dropped(self) -> int:
        """Number of items that were not processed."""
        return self.late + self.failed

    def __enter__(self) -> "Background[Item]":
        self._thread.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None) -> None:
        self._waiting.put(None)
        self._thread.join()
        if self.error is not None and error is None:
            raise self.error

    def __call__(self, item: Item) -> None:
        """Queue an item for processing, or drop it."""
        try:
            self._waiting.put_nowait(item)
        except Full:
            self.late += 1

    def _work(self) -> None:
        while (item := self._waiting.get()) is not None:
            try:
                self.keep(item)
            except BaseException as error:  # whatever it is, the block raises it when it ends
                self.failed += 1
                if self.error is None:
                    self.error = error
                    self.tell(error)
