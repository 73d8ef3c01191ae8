"""The spec sheet of a sensor in words."""

from collections.abc import Iterator
from math import isfinite
from statistics import median

from ..accuracy.spec_sheet import CLOSE, LOST, SpecSheet, Spread

LISTED = 4
"""Largest number of left-out trials that are listed individually."""


def sheet_lines(sheet: SpecSheet) -> list[str]:
    """Return lines on what to expect of a sensor."""
    blocks = {
        "accuracy": _conditions(sheet),
        "at rest": _rest(sheet),
        "lightest": _lightest(sheet),
        "errors": _errors(sheet),
        "two": _closest(sheet),
        "deepest": _deepest(sheet),
        "range": _range(sheet),
    }
    return [f"{key if i == 0 else '':<10}{line}" for key, block in blocks.items() for i, line in enumerate(block)]


def _conditions(sheet: SpecSheet) -> Iterator[str]:
    strokes, directions = len({t.stroke for t in sheet.presses}), len({t.direction for t in sheet.pairs})
    grids = (" x ".join(map(str, grid)) for grid in (sheet.simulated_on, sheet.reconstructed_on))
    yield (
        f"{len(sheet.presses)} presses in {strokes} strokes, {len(sheet.pairs)} pairs in {directions} directions, "
        f"{sheet.rest.frames} frames at rest, seed {sheet.seed}"
    )
    yield "simulated on {} vertices, reconstructed on {}, ".format(*grids) + f"from images with {sheet.noise:.1f} dB noise"
    yield "figures are median / 90 %; the sensor's own errors of calibration, material and light come on top"
    if sheet.left_out:
        yield f"left out, as they cannot be simulated: {len(sheet.left_out)}"
        yield from (f"  {reason}" for reason in sheet.left_out[:LISTED])
        yield from [f"  and {len(sheet.left_out) - LISTED} more"] * (len(sheet.left_out) > LISTED)


def _rest(sheet: SpecSheet) -> Iterator[str]:
    rest, length = sheet.rest, sheet.length_unit
    force, pressure = units(sheet)
    yield (
        f"surface {_spread(rest.surface, length)}, force {_spread(rest.force, force)}, "
        f"pressure {_spread(rest.pressure, pressure)}"
    )
    yield f"false contacts in {rest.touched} of {rest.frames} frames, another status than ok in {rest.not_ok}"


def _lightest(sheet: SpecSheet) -> Iterator[str]:
    touch, (force, _) = sheet.lightest, units(sheet)
    if touch.found:
        yield f"touch found: {_spread(touch.force, force)}, {_spread(touch.depth, sheet.length_unit)} deep"
    yield f"found in {touch.found} of {touch.strokes} strokes, within {_number(sheet.near)} {sheet.length_unit} of where it is"


def _errors(sheet: SpecSheet) -> Iterator[str]:
    length, (force, _) = sheet.length_unit, units(sheet)
    yield "by the true force; of results that can be relied on: status ok, no contact at the rim"
    heads = f"force, {force}", "presses", "relied on", "found", "force off by", f"depth, {length}", f"place, {length}"
    widths = 20, 7, 9, 5, 13, 15, 15
    yield "  ".join(f"{head:>{width}}" for head, width in zip(heads, widths, strict=True))
    for band in sheet.bands:
        cells = (
            f"{_number(band.low)} to {_number(band.high)}",
            str(band.presses),
            _share(band.relied_on),
            _share(band.found),
            f"{_share(band.force.median)} / {_share(band.force.most)}",
            _spread(band.depth),
            _spread(band.place),
        )
        yield "  ".join(f"{cell:>{width}}" for cell, width in zip(cells, widths, strict=True))


def _closest(sheet: SpecSheet) -> Iterator[str]:
    pair, unit = sheet.closest, sheet.length_unit
    if not sheet.pairs:
        yield "contacts: not tried"
        return
    if pair.told:
        yield f"contacts resolved from a distance of {_spread(pair.distance, unit)} on"
    tried = f"tried from {_number(pair.widest)} down to {_number(pair.nearest)} {unit}"
    yield f"resolved in {pair.told} of {pair.directions} directions; {tried}"


def _deepest(sheet: SpecSheet) -> Iterator[str]:
    deepest, unit = sheet.deepest, sheet.length_unit
    if not deepest.depths:
        yield "press: not tried"
        return
    middle, least, strokes = median(deepest.depths), min(deepest.depths), len(deepest.depths)
    yield f"press reconstructed: {_number(middle)} {unit} (median of {strokes} strokes), {_number(least)} {unit} at least"
    yield "it ends where: " + ", ".join(f"{end} ({count})" for end, count in deepest.ends.items())
    yield f"(markers lost: over {LOST:.0%} of them; surface off: by over {CLOSE:.0%} of its displacement)"


def units(sheet: SpecSheet) -> tuple[str, str]:
    """Return the units of forces and pressures."""
    relative = sheet.force_unit == "relative"
    return ("relative",) * 2 if relative else (sheet.force_unit, f"{sheet.force_unit}/{sheet.length_unit}²")


def _number(value: float) -> str:
    """Format a number with two digits, or with all digits before the decimal point.

    >>> [_number(value) for value in (0.01234, 5.678, 123.4, 0.0, float("nan"))]
    ['0.012', '5.7', '123', '0', '-']
    """
    return "-" if not isfinite(value) else f"{value:.0f}" if abs(value) >= 100 else f"{value:.2g}"


def _spread(values: Spread, unit: str = "") -> str:
    return f"{_number(values.median)} / {_number(values.most)} {unit}".rstrip()


def _share(value: float) -> str:
    return f"{_number(100 * value)} %" if isfinite(value) else "-"


def _range(sheet: SpecSheet) -> Iterator[str]:
    if sheet.range is None:
        yield "none: presses are wrong from the shallowest on that noise does not decide"
        return
    yield f"presses shown right up to {sheet.range.depth:.3g} of the size deep and {sheet.range.force:.3g} {sheet.force_unit}"
