"""What to expect of a sensor, drawn: errors over force and depth, two contacts resolved."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

from ..accuracy.spec_sheet import CLOSE, Band, SpecSheet, Spread
from .drawing import BLUE, GREY, ROW, VERMILION

BELOW = 5.6
"""Inches that the panels take."""
MIDDLE: dict[str, Any] = dict(lw=2.4)
MOST: dict[str, Any] = dict(lw=1.2, ls="--")
DOTS: dict[str, Any] = dict(ls="none", ms=4, alpha=0.5)


def draw_sheet(drawing: Figure, sheet: SpecSheet) -> None:
    """Four panels at the bottom of a figure, `BELOW` inches high.

    Args:
        drawing: the figure, its upper part `ROW` inches.
        sheet: what is drawn.

    Example:
        >>> from torchmembrane.accuracy.spec_sheet import ClosestPair, DeepestPress, LightestTouch, RestFloor
        >>> none = Spread(np.nan, np.nan)
        >>> parts = RestFloor(0, 0, 0, none, none, none), LightestTouch(0, 0, none, none), []
        >>> empty = SpecSheet("a", "mm", "N", 40.0, 0, (9, 9), (7, 7), 1.0, 1.0, [], *parts, ClosestPair(0, 0, none, 0, 0),
        ...     DeepestPress([], [], {}), [], [])
        >>> figure = Figure()
        >>> draw_sheet(figure, empty)
        >>> len(figure.axes)
        4
    """
    height = ROW + BELOW
    places = drawing.add_gridspec(
        1, 4, left=0.05, right=0.98, top=(BELOW - 0.85) / height, bottom=1.35 / height, wspace=0.42, hspace=0
    )
    words = f"What to expect: {len(sheet.presses)} simulated presses, images with {sheet.noise:.1f} dB noise, seed {sheet.seed}"
    drawing.text(0.5, (BELOW - 0.3) / height, words, ha="center", fontsize=14)
    axes = [drawing.add_subplot(places[k]) for k in range(4)]
    _draw_force(axes[0], sheet)
    _draw_lengths(axes[1], sheet)
    _draw_range(axes[2], sheet)
    _draw_pairs(axes[3], sheet)
    for each in axes:
        each.grid(lw=0.3, alpha=0.5)
        narrow: dict[str, Any] = dict(fontsize=9.5, handlelength=1.4, columnspacing=0.8)
        each.legend(loc="upper center", bbox_to_anchor=(0.5, -0.14), frameon=False, ncols=2, **narrow)


def _draw_force(axes: Axes, sheet: SpecSheet) -> None:
    trusted = [trial for trial in sheet.presses if trial.relied_on]
    axes.plot(*_columns([(t.force, 100 * t.force_error) for t in trusted]), "o", color=BLUE, **DOTS)
    _draw_bands(axes, sheet, [band.force for band in sheet.bands], 100, BLUE, "force")
    _mark_lightest(axes, sheet)
    _logarithmic(axes)
    axes.set(xlabel=f"true force [{sheet.force_unit}]", ylabel="force off by [%]", title="Force")


def _draw_lengths(axes: Axes, sheet: SpecSheet) -> None:
    trusted = [trial for trial in sheet.presses if trial.relied_on]
    axes.plot(*_columns([(t.force, t.depth_error) for t in trusted]), "o", color=BLUE, **DOTS)
    axes.plot(*_columns([(t.force, t.place_error) for t in trusted]), "s", color=VERMILION, **DOTS)
    _draw_bands(axes, sheet, [band.depth for band in sheet.bands], 1, BLUE, "depth")
    _draw_bands(axes, sheet, [band.place for band in sheet.bands], 1, VERMILION, "place")
    _logarithmic(axes)
    axes.set(xlabel=f"true force [{sheet.force_unit}]", ylabel=f"off by [{sheet.length_unit}]", title="Depth and contact point")


def _draw_range(axes: Axes, sheet: SpecSheet) -> None:
    good, bad = ([t for t in sheet.presses if (t.failure == "") is right] for right in (True, False))
    axes.plot(*_columns([(t.depth, 100 * t.surface_error) for t in good]), "o", color=BLUE, label="reconstructed", **DOTS)
    bad_style: dict[str, Any] = dict(ls="none", ms=6, mew=1.4, alpha=0.8)
    axes.plot(*_columns([(t.depth, 100 * t.surface_error) for t in bad]), "x", color=VERMILION, label="not", **bad_style)
    axes.axhline(100 * CLOSE, color="k", lw=0.8, ls=":", label="a quarter")
    if sheet.deepest.depths:
        axes.axvline(float(np.median(sheet.deepest.depths)), color="k", lw=1.2, label="deepest, median")
    _logarithmic(axes)
    axes.set(xlabel=f"true depth [{sheet.length_unit}]", ylabel="surface off by, of its displacement [%]", title="How deep")


def _draw_pairs(axes: Axes, sheet: SpecSheet) -> None:
    for told, face, label in ((True, BLUE, "resolved"), (False, "none", "not resolved")):
        points = _columns([(pair.distance, pair.direction + 1) for pair in sheet.pairs if pair.told is told])
        axes.plot(*points, "o", ls="none", ms=8, mfc=face, mec=BLUE, label=label)
    if np.isfinite(sheet.closest.distance.median):
        axes.axvline(sheet.closest.distance.median, color="k", lw=1.2, label="from here on, median")
    axes.axvline(sheet.spacing, color=GREY, lw=1.2, ls="--", label="markers' spacing")
    axes.set_yticks(sorted({pair.direction + 1 for pair in sheet.pairs}))
    axes.margins(y=0.3)
    axes.set_xlim(left=0)
    axes.set(xlabel=f"distance of two touches [{sheet.length_unit}]", ylabel="direction", title="Two touches")


def _draw_bands(axes: Axes, sheet: SpecSheet, spreads: list[Spread], scale: float, color: str, what: str) -> None:
    """Median and 90 % quantile of every band, as a step over its forces."""
    middle = [scale * spread.median for spread in spreads]
    most = [scale * spread.most for spread in spreads]
    least = min((trial.force for trial in sheet.presses), default=1.0)
    for values, style, label in ((middle, MIDDLE, f"{what}, median"), (most, MOST, f"{what}, 90 %")):
        axes.plot(*_steps(sheet.bands, values, least), color=color, label=label, **style)


def _steps(bands: Sequence[Band], values: list[float], least: float) -> np.ndarray:
    """Ends of every band's line `[2, 3 B]`, force and value, with gaps between them."""
    corners = [
        corner
        for band, value in zip(bands, values, strict=True)
        for corner in ((max(band.low, least), value), (band.high, value), (np.nan, np.nan))
    ]
    return _columns(corners)


def _mark_lightest(axes: Axes, sheet: SpecSheet) -> None:
    if np.isfinite(sheet.lightest.force.median):
        axes.axvline(sheet.lightest.force.median, color="k", lw=1.2, label="lightest found")


def _logarithmic(axes: Axes) -> None:
    axes.set(xscale="log", yscale="log")
    axes.xaxis.set_major_locator(LogLocator())
    axes.yaxis.set_major_locator(LogLocator(subs=(1, 3)))
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
        axis.set_minor_formatter(NullFormatter())


def _columns(points: list[tuple[float, float]]) -> np.ndarray:
    """Points as two rows `[2, N]`, also if there are none."""
    return np.array(points, dtype=float).reshape(-1, 2).T
