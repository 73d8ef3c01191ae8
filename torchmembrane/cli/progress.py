"""How far a long command is and how much time is left: a bar on a terminal, lines every few seconds elsewhere. On stderr."""

import sys
from time import monotonic
from types import TracebackType
from typing import Any

LINE_SECONDS = 5.0
"""Between two lines where stderr is no terminal."""
FEWEST_STEPS = 2
"""Fewest steps for a rate: parallel processes end several steps at once, and then none for a while."""
LEAST_DONE = 0.1
"""Share of the work after which the rate since its beginning counts, because processes may have had to start."""


def announce(title: str) -> None:
    """Say that a command has begun, before packages are loaded that take seconds.

    Args:
        title: title of the command, as `calibrate material`.
    """
    print(f"{title}: loading packages", file=sys.stderr, flush=True)


def duration(seconds: float) -> str:
    """Seconds in words, to two digits or so.

    Example:
        >>> [duration(seconds) for seconds in (0.4, 41.7, 100, 7260)]
        ['1 s', '42 s', '2 min', '2 h 1 min']
    """
    if seconds < 90:
        return f"{max(1, round(seconds))} s"
    minutes = round(seconds / 60)
    return f"{minutes} min" if minutes < 100 else f"{minutes // 60} h {minutes % 60} min"


class ProgressDisplay:
    """Shows what a computation tells of its progress; the object is the computation's `progress`.

    The time left is by the rate of the latter half of the work done since the first call, of `FEWEST_STEPS` at least: what only
    the beginning takes, other processes to start or code to compile, is soon forgotten.

    Args:
        title: title of the command.

    Example:
        >>> import contextlib
        >>> with contextlib.redirect_stderr(sys.stdout), ProgressDisplay("calibrate rest") as progress:
        ...     progress(0.0, "dots of the image")
        calibrate rest: 0 %: dots of the image
    """

    def __init__(self, title: str) -> None:
        self.title = title
        self.told: list[tuple[float, float]] = []
        self.said = -LINE_SECONDS

    def __enter__(self) -> "ProgressDisplay":
        from tqdm import tqdm

        form = "{desc}: {percentage:3.0f} %|{bar:20}| {elapsed}{postfix}"
        terminal = bool(getattr(sys.stderr, "isatty", bool)())
        self.bar: Any = tqdm(total=1.0, desc=self.title, bar_format=form, dynamic_ncols=True) if terminal else None
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        if self.bar is not None:
            self.bar.close()

    def begin(self, step: str) -> None:
        """Show what comes before the work whose share is told."""
        self._show(0.0, step, None)

    def __call__(self, share: float, step: str) -> None:
        """Show that a share of the work, 0..1, is done, and the step that begins."""
        self._show(share, step, self.time_left(share, monotonic()))

    def _show(self, share: float, step: str, left: float | None) -> None:
        words = step if left is None else f"about {duration(left)} left: {step}"
        if self.bar is not None:
            self.bar.n = share
            self.bar.set_postfix_str(words)
        elif monotonic() - self.said >= LINE_SECONDS:
            print(f"{self.title}: {100 * share:.0f} %{', ' if left is not None else ': '}{words}", file=sys.stderr, flush=True)
            self.said = monotonic()

    def time_left(self, share: float, now: float) -> float | None:
        """Seconds until all is done; None until there is a rate to tell it by.

        Args:
            share: share of the work that is done.
            now: seconds, of any clock; the first call begins.
        """
        self.told.append((share, now))
        first = self.told[0][0]
        before = [(done, at) for done, at in self.told if done < share]
        if not before:
            return None
        latter = sum(done < (first + share) / 2 for done, _ in before)
        start = min(latter, max(1, len(before) - FEWEST_STEPS), len(before) - 1)
        if start <= 1 and share - first < LEAST_DONE:
            return None
        done, at = before[start]
        return (now - at) * (1 - share) / (share - done)

    def write(self, line: str) -> None:
        """Write a line of its own, above the bar where there is one."""
        if self.bar is not None:
            self.bar.write(line, file=sys.stderr)
        else:
            print(line, file=sys.stderr, flush=True)
