"""State of the node, published once a second on /diagnostics: rate, latency, statuses, drift, age of the calibration."""

import time
from collections import Counter, deque
from datetime import date
from math import inf, isfinite
from pathlib import Path
from typing import NamedTuple

import numpy as np

import torchmembrane as tm
from torchmembrane.integrations.frame_messages import DOUBTFUL, FAILED, GOOD, Message, diagnosis

RECENT = 100
"""Number of latest images over which rate and latency are computed."""
SILENT = 2.0
"""Seconds without an image after which this is reported."""


class Followed(NamedTuple):
    """A reconstructed image: time of completion (s), age of the image at that time (s, NaN if unknown), and status."""

    time: float
    latency: float
    status: tm.Status


class Health:
    """Statistics of the reconstructed images.

    Args:
        sensor: sensor of the node.
        path: path of its file, whose age is reported if the file has no record of its calibration.
    """

    def __init__(self, sensor: tm.Sensor, path: Path):
        self.name, self.record = sensor.name, sensor.record
        self.written = date.fromtimestamp(path.stat().st_mtime)
        self.recent: deque[Followed] = deque(maxlen=RECENT)
        self.statuses: Counter[tm.Status] = Counter()
        self.refused, self.refused_at = 0, -inf

    def add(self, latency: float, status: tm.Status) -> None:
        """Add a reconstructed image."""
        self.recent.append(Followed(time.monotonic(), latency, status))
        self.statuses[status] += 1

    def refuse(self) -> None:
        """Add an image that could not be read."""
        self.refused += 1
        self.refused_at = time.monotonic()

    def message(self, received: int, drift: float) -> Message:
        """Return a `DiagnosticStatus`.

        Args:
            received: number of images so far; those neither reconstructed nor refused were replaced by newer ones.
            drift: drift of the tracker, px.
        """
        recent = list(self.recent)
        times, latencies = [each.time for each in recent], [1000 * each.latency for each in recent if isfinite(each.latency)]
        rate = (len(times) - 1) / (times[-1] - times[0]) if len(times) > 1 else 0.0
        median, most = np.percentile(latencies, [50, 99]) if latencies else (np.nan, np.nan)
        followed = self.statuses.total()
        values = {
            "rate, Hz": f"{rate:.1f}",
            "latency, ms (median)": f"{median:.0f}",
            "latency, ms (99 %)": f"{most:.0f}",
            "images received": str(received),
            "images followed": str(followed),
            "images refused": str(self.refused),
            "images displaced by newer ones": str(max(received - followed - self.refused, 0)),
            "drift, px": f"{drift:.3f}",
            "serial": self.record.serial or "unknown",
            **self._age(),
        }
        values |= {f"status {int(status)}: {status.text}": str(count) for status, count in sorted(self.statuses.items())}
        return diagnosis(*self._judged(), values)

    def _age(self) -> dict[str, str]:
        """Return the age in days of the calibration, or of the sensor file."""
        what, day = ("calibration", self.record.calibrated) if self.record.calibrated else ("sensor file", self.written)
        return {f"age of the {what}, days": str((date.today() - day).days)}

    def _judged(self) -> tuple[int, str, str]:
        """Return level, name and text."""
        name = f"torchmembrane: {self.name}"
        silent_since = time.monotonic() - SILENT
        if not self.recent or self.recent[-1].time < silent_since:
            is_refusing = self.refused_at > silent_since
            return DOUBTFUL, name, "images come, none can be followed" if is_refusing else "no images come"
        status = self.recent[-1].status
        return GOOD if status == tm.Status.OK else DOUBTFUL if status.has_surface else FAILED, name, status.text
