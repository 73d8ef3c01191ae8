"""Progress and remaining time of a long command, on stderr: a bar on a terminal, a line every few seconds elsewhere."""

import sys
from time import monotonic
from types import TracebackType
from typing import Any

LINE_SECONDS = 5.0
"""Seconds between two lines if stderr is not a terminal."""
FEWEST_STEPS = 2
"""Smallest number of steps for a rate: parallel processes may finish several steps at once, and then none for a while."""
LEAST_DONE = 0.1
"""Share of work from which on the rate since the beginning is used, because processes may have had to start."""


def announce(title: str) -> None:
    """Print that a command has started, before packages are loaded that take seconds.

    Args:
        title: title of the command, such as `calibrate material`.
    """
    print(f"{title}: loading packages", file=sys.stderr, flush=True)


def duration(seconds: float) -> str:
    """Return seconds in words, rounded to about two digits.

    Example:
        >>> [duration(seconds) for seconds in (0.4, 41.7, 100, 7260)]
        ['1 s', '42 s', '2 min', '2 h 1 min']
    """
    if seconds < 90:
        return f"{max(1, round(seconds))} s"
    minutes = round(seconds / 60)
    return f"{minutes} min" if minutes < 100 else f"{minutes // 60} h {minutes % 60} min"


class ProgressDisplay:
    """Display of a computation's progress; the object is passed as the computation's `progress`.

    The remaining time is estimated from the rate over the later half of the work done since the first call, at least
    `FEWEST_STEPS` steps: one-time costs at the beginning, such as starting processes or compiling code, soon lose their
    influence.

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
        """Show a step that precedes the measured work."""
        self._show(0.0, step, None)

    def __call__(self, share: float, step: str) -> None:
        """Show that a share of the work, 0..1, is done, and which step begins."""
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
        """Return the estimated seconds until all work is done; None until there is a rate.

        Args:
            share: share of the work that is done, 0..1.
            now: current time of any clock in seconds; the first call starts the measurement.
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
        """Write a separate line, above the bar if there is one."""
        if self.bar is not None:
            self.bar.write(line, file=sys.stderr)
        else:
            print(line, file=sys.stderr, flush=True)
