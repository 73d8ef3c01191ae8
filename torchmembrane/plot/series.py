"""Force, moment and pressure of recordings over time, with uncertainties and statuses: `view DIR --plot`."""

from collections.abc import Mapping, Sequence
from datetime import UTC, datetime

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Patch
from matplotlib.ticker import MaxNLocator

from ..results.status import Status
from ..results.summary import UNREADABLE
from .drawing import BLUE, GREY, VERMILION, readable

GREEN = "#009E73"  # distinguishable from the others with any colour vision
COLOURS = dict(zip("xyz", (VERMILION, GREEN, BLUE), strict=True))
SHADES = ("#F0E442", "#CC79A7", "#56B4E9", "#E69F00", "#999999", "#8C564B")
"""Colours of the bands of statuses other than ok, in the order in which they appear."""
WIDTH, HEIGHT = 9.0, 3.1
"""Inches, of a recording's column and of a row."""
LONGEST = 1e8
"""Seconds that no recording takes: a later time is one since 1970."""
ABOVE, BELOW, LEFT, GAP = 0.75, 1.35, 1.05, 0.35
"""Inches: the title, the axis and legend, labels, between panels."""


@readable
def series_figure(runs: Mapping[str, Sequence[Mapping[str, str]]]) -> Figure:
    """Draw rows of force, moment and pressure change with a column for each recording, all on the same scales.

    The shaded band of a force component is one standard deviation. The background colour shows the status of frames that are
    not ok. A frame without a result leaves a gap.

    Args:
        runs: rows of `summary.csv`, by the names of the recordings.

    Example:
        >>> from torchmembrane.results.summary_row import NAMES
        >>> row = dict.fromkeys(NAMES, "") | {"status": "0", "force_x": "1", "force_unit": "N", "length_unit": "mm"}
        >>> len(series_figure({"day 1": [row, row], "day 2": [row]}).axes)
        6
    """
    width, height = LEFT + len(runs) * (WIDTH + GAP), ABOVE + BELOW + 3 * HEIGHT + 2 * GAP
    drawing = Figure(figsize=(width, height), dpi=100)
    places = dict(left=LEFT / width, right=1 - GAP / width, top=1 - ABOVE / height, bottom=BELOW / height)
    axes = drawing.subplots(
        3, len(runs), sharex="col", sharey="row", squeeze=False, gridspec_kw=places | dict(hspace=0.1, wspace=0.05)
    )
    shades: dict[int, str] = {}
    for column, (name, rows) in enumerate(runs.items()):
        times, label = _times(rows)
        for panel, (what, unit) in zip(axes[:, column], _rows(rows), strict=True):
            _draw(panel, times, rows, what)
            _shade(panel, times, rows, shades)
            panel.grid(lw=0.3, alpha=0.5)
            panel.margins(x=0)
            if column == 0:
                panel.set_ylabel(f"{what.replace('_', ' ')} [{unit}]")
        axes[0, column].set_title(name)
        axes[2, column].set_xlabel(label)
        axes[2, column].xaxis.set_major_locator(MaxNLocator(integer=label == "frame"))
    drawing.align_ylabels(axes[:, 0])
    _legend(drawing, shades)
    return drawing


def _rows(rows: Sequence[Mapping[str, str]]) -> list[tuple[str, str]]:
    """Return the columns to be drawn, with their units."""
    length, force = rows[0]["length_unit"], rows[0]["force_unit"]
    pressure = ("pressure change", "hPa") if force == "N" else ("pressure change", f"{force}/{length}²")
    return [("force", force), ("moment", f"{force} {length}"), pressure]


def _draw(axes: Axes, times: np.ndarray, rows: Sequence[Mapping[str, str]], what: str) -> None:
    if what == "pressure change":
        key = "pressure_change_hpa" if rows[0]["force_unit"] == "N" else "pressure_change"
        found = _numbers(rows, key)
        _line(axes, times, found, color="k", lw=1.6)
        gauge = _numbers(rows, "gauge_pressure_hpa") - _numbers(rows, "pressure_hpa") + found  # minus the pressure at rest
        if np.isfinite(gauge).any():
            axes.plot(times, gauge, ".", ms=4, color=VERMILION, label="read by a gauge")
            axes.legend(frameon=False, fontsize=11.5)
        return
    for axis, colour in COLOURS.items():
        values = _numbers(rows, f"{what}_{axis}")
        _line(axes, times, values, color=colour, lw=1.4, label=f"{axis}")
        if what == "force":
            off = _numbers(rows, f"force_deviation_{axis}")
            axes.fill_between(times, values - off, values + off, color=colour, alpha=0.2, lw=0)
    if what == "force":
        _line(axes, times, _numbers(rows, "force"), color="k", lw=1.0, label="magnitude")


def _line(axes: Axes, times: np.ndarray, values: np.ndarray, **style) -> None:
    """Draw a line, with a point for each frame without a neighbour."""
    known = np.isfinite(values)
    alone = known & ~np.append(False, known[:-1]) & ~np.append(known[1:], False)
    axes.plot(times, values, **style)
    axes.plot(times[alone], values[alone], ".", ms=5, color=style["color"])


def _shade(axes: Axes, times: np.ndarray, rows: Sequence[Mapping[str, str]], shades: dict[int, str]) -> None:
    """Shade frames whose status is not ok, from halfway to the preceding frame to halfway to the next."""
    statuses = np.array([int(row["status"]) for row in rows])
    middles = (times[1:] + times[:-1]) / 2
    before = (2 * times[0] - middles[0], 2 * times[-1] - middles[-1]) if len(middles) else (times[0] - 0.5, times[0] + 0.5)
    edges = np.concatenate([before[:1], middles, before[1:]])
    starts = np.flatnonzero(np.append(True, statuses[1:] != statuses[:-1]))
    for start, end in zip(starts, np.append(starts[1:], len(statuses)), strict=True):
        if (status := int(statuses[start])) != Status.OK:
            shade = shades.setdefault(status, SHADES[len(shades) % len(SHADES)])
            axes.axvspan(edges[start], edges[end], color=shade, alpha=0.45, lw=0, zorder=0)


def _times(rows: Sequence[Mapping[str, str]]) -> tuple[np.ndarray, str]:
    """Times of the frames and the label of their axis: seconds since the first frame if all are known and in order, else frame
    numbers."""
    times = _numbers(rows, "time")
    if np.isfinite(times).all() and (np.diff(times) > 0).all():
        return times - times[0], f"time [s]{_since(times[0])}"
    return np.arange(len(rows), dtype=float), "frame"


def _since(time: float) -> str:
    """Return the text of a recording's start, empty if its times count from its own beginning.

    Example:
        >>> _since(1790509109.25), _since(3.0)
        (' since 2026-09-27 11:38:29 UTC', '')
    """
    return datetime.fromtimestamp(time, UTC).strftime(" since %Y-%m-%d %H:%M:%S UTC") if time > LONGEST else ""


def _numbers(rows: Sequence[Mapping[str, str]], key: str) -> np.ndarray:
    return np.array([float(row[key] or "nan") for row in rows])


def _legend(drawing: Figure, shades: Mapping[int, str]) -> None:
    handles, labels = drawing.axes[0].get_legend_handles_labels()
    handles.append(Patch(color=GREY, alpha=0.6))
    labels.append("one standard deviation")
    for status, shade in shades.items():
        handles.append(Patch(color=shade, alpha=0.45))
        text = "unreadable" if status == UNREADABLE else Status(status).text
        labels.append(f"status {status}: {text.partition(':')[0].partition(' (')[0]}")
    drawing.legend(handles, labels, loc="lower center", ncols=min(5, len(labels)), frameon=False, fontsize=11.5)
