"""The status line of a stream: overwritten in place in a terminal, written line by line elsewhere."""

import shutil
import time
from typing import TextIO

from ..files.digits import together
from ..files.levels import too_few_bits
from ..results.status import Status
from ..results.store import Mesh
from ..results.view_status import status_in_words
from .loop import RECENT, LiveFrame, StreamStats

TERMINAL_SECONDS, PLAIN_SECONDS = 0.1, 1.0
"""Shortest time between two lines, seconds."""
DIGITS = 4  # of the largest component of force and moment


class StatusLine:
    """Show the latest frame, with rate and latency over the last `RECENT` frames.

    Args:
        mesh: mesh of the stream.
        file: stream to which the line is written.
    """

    def __init__(self, mesh: Mesh, file: TextIO):
        self._mesh, self._file, self._in_place = mesh, file, file.isatty()
        self._next = 0.0

    def __call__(self, seen: LiveFrame, stats: StreamStats) -> None:
        """Show a frame, unless the previous line was written too recently."""
        at = time.monotonic()
        if at < self._next:
            return
        self._next = at + (TERMINAL_SECONDS if self._in_place else PLAIN_SECONDS)
        text = described(seen, stats, self._mesh)
        if self._in_place:
            self._write(f"\r\x1b[K{text[: shutil.get_terminal_size().columns - 1]}")
        else:
            self._write(f"{text}\n")

    def say(self, text: str) -> None:
        """Write a line that is not overwritten."""
        self._write(f"\r\x1b[K{text}\n" if self._in_place else f"{text}\n")

    def _write(self, text: str) -> None:
        self._file.write(text)
        self._file.flush()


def described(seen: LiveFrame, stats: StreamStats, mesh: Mesh) -> str:
    """Return one line with rate, latency, dropped pictures, status, wrench and pressure change."""
    milliseconds = [1000 * stats.latency(percent, RECENT) for percent in (50, 95)]
    rate = f"{stats.rate(RECENT):.1f} Hz, " if stats.followed > 1 else ""
    pace = rate + "{:.0f} ms (95 %: {:.0f}), {} dropped".format(*milliseconds, stats.dropped)
    status = Status(int(seen.frame["status"]))
    if not status.has_surface:
        hints = [too_few_bits(image) for image in seen.images if image is not None]
        return f"{pace} | {status.text}{''.join(hints[:1])}"
    unit = "relative" if mesh.force_unit == "relative" else mesh.force_unit
    force, moment = (together(half, DIGITS) for half in seen.frame["wrench"].reshape(2, 3))
    pressure = mesh.pressure_in_words(float(seen.frame["pressure_change"]))
    left_out = status_in_words(seen.frame, mesh.view_names.split()).removeprefix(status.text)
    words = status.text.partition(":")[0] + left_out
    return f"{pace} | {words} | force {force} {unit} | moment {moment} {unit} {mesh.length_unit} | pressure {pressure}"


def summary(stats: StreamStats) -> str:
    """Return a line with the numbers of captured, followed and dropped pictures."""
    if not stats.followed:
        return "no frame was captured"
    without = f", {stats.failed} of them without a surface" if stats.failed else ""
    milliseconds = [1000 * stats.latency(percent) for percent in (50, 95)]
    return (
        f"frames: {stats.captured} captured, {stats.followed} followed{without}, {stats.dropped} dropped for newer ones; "
        "{:.1f} Hz, latency {:.0f} ms in the median, {:.0f} ms at 95 %".format(stats.rate(), *milliseconds)
    )
