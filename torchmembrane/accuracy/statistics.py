"""The figures of a spec sheet, computed from the trials."""

from collections import Counter
from collections.abc import Sequence
from itertools import takewhile

import numpy as np

from ..results.status import Status
from ..sensor.working_range import GENERAL, WorkingRange
from .spec_sheet import Band, ClosestPair, DeepestPress, LightestTouch, PairTrial, PressTrial, RestFloor, RestTrial, Spread

EDGES = (0.0, 0.01, 0.03, 0.1, 0.3, 1.0)
"""Edges of the bands of force, over the largest force of all presses."""
LEAST_DEPTH = 0.05
"""Smallest depth of the presses from which a range is derived, over the size."""
UNBROKEN = "the deepest press tried"
UNFOUND = "never found"


def spread(values: Sequence[float]) -> Spread:
    """Return the median and the 90 % quantile of the finite values.

    Example:
        >>> spread([3.0, 1.0, 2.0, float("inf")])
        Spread(median=2.0, most=2.8)
        >>> spread([3e-13, 1e-13, 2e-13])
        Spread(median=2e-13, most=2.8e-13)
        >>> spread([])
        Spread(median=nan, most=nan)
    """
    finite = [value for value in values if np.isfinite(value)]
    return Spread(*(float(f"{q:.12g}") for q in np.percentile(finite, (50, 90)))) if finite else Spread(np.nan, np.nan)


def rest_floor(trials: Sequence[RestTrial]) -> RestFloor:
    """Summarise frames at rest."""
    good = [trial for trial in trials if trial.status == Status.OK]
    return RestFloor(
        frames=len(trials),
        not_ok=len(trials) - len(good),
        touched=sum(trial.contacts > 0 for trial in good),
        surface=spread([trial.surface for trial in good]),
        force=spread([trial.force for trial in good]),
        pressure=spread([trial.pressure for trial in good]),
    )


def bands(trials: Sequence[PressTrial], near: float) -> list[Band]:
    """Summarise errors by force, in bands bounded by `EDGES` times the largest force; bands without a press are left out.

    Args:
        trials: the presses.
        near: largest position error of a contact that counts as found, length unit.
    """
    hardest = max((trial.force for trial in trials), default=0.0)
    table = []
    for low, high in zip(EDGES[:-1], EDGES[1:], strict=True):
        low, high = low * hardest, high * hardest
        chosen = [trial for trial in trials if low < trial.force <= high]
        trusted = [trial for trial in chosen if trial.relied_on]
        if not chosen:
            continue
        table.append(
            Band(
                low=low,
                high=high,
                presses=len(chosen),
                relied_on=len(trusted) / len(chosen),
                found=float(np.mean([trial.is_found(near) for trial in trusted])) if trusted else np.nan,
                force=spread([trial.force_error for trial in trusted]),
                depth=spread([trial.depth_error for trial in trusted]),
                place=spread([trial.place_error for trial in trusted]),
            )
        )
    return table


def lightest_touch(trials: Sequence[PressTrial], near: float) -> LightestTouch:
    """Summarise the first frames in which contacts are found; the next frame must confirm each, as one may be chance.

    Args:
        trials: the presses, in order within each stroke.
        near: largest position error of a contact that counts as found, length unit.
    """
    each = _strokes(trials)
    first = [stroke[k] for stroke in each if (k := _first_found(stroke, near)) is not None]
    force, depth = spread([trial.force for trial in first]), spread([trial.depth for trial in first])
    return LightestTouch(len(each), len(first), force, depth)


def deepest_press(trials: Sequence[PressTrial], near: float) -> DeepestPress:
    """Summarise the depths up to which strokes are reconstructed without failure from the first frame found; 0 if none is.

    Args:
        trials: the presses, in order within each stroke.
        near: largest position error of a contact that counts as found, length unit.
    """
    depths, forces, ends = [], [], []
    for stroke in _strokes(trials):
        first = _first_found(stroke, near)
        followed = [] if first is None else list(takewhile(lambda trial: not trial.failure, stroke[first:]))
        depths.append(followed[-1].depth if followed else 0.0)
        forces.append(followed[-1].force if followed else 0.0)
        end = UNFOUND if first is None else next((trial.failure for trial in stroke[first:] if trial.failure), UNBROKEN)
        ends.append(end)
    return DeepestPress(depths, forces, dict(Counter(ends).most_common()))


def closest_pair(trials: Sequence[PairTrial]) -> ClosestPair:
    """Summarise, over all directions, the smallest distance at which a pair and all wider pairs are resolved."""
    smallest = []
    directions = sorted({trial.direction for trial in trials})
    for direction in directions:
        apart = sorted((t for t in trials if t.direction == direction), key=lambda trial: -trial.distance)
        told = list(takewhile(lambda trial: trial.told, apart))
        smallest += [told[-1].distance] if told else []
    distances = [trial.distance for trial in trials] or [np.nan]
    return ClosestPair(len(directions), len(smallest), spread(smallest), min(distances), max(distances))


def working_range(trials: Sequence[PressTrial], size: float, fingerprint: str) -> WorkingRange | None:
    """Derive the validated working range: limits from the presses that are shallower than every wrong one; None if none is.

    A press is wrong if its status is ok and `PressTrial.is_wrong`. Presses shallower than `LEAST_DEPTH` are ignored, because
    noise dominates their errors.

    Args:
        trials: the presses, reconstructed without range limits.
        size: size of the surface, length unit.
        fingerprint: fingerprint of the sensor.
    """
    deep = [trial for trial in trials if trial.depth > LEAST_DEPTH * size and trial.status == Status.OK]
    wrong = [trial.depth for trial in deep if trial.is_wrong]
    right = [trial for trial in deep if trial.depth < min(wrong, default=np.inf)]
    if not right:
        return None
    depth, turn, force = (max(getattr(trial, name) for trial in right) for name in ("depth", "turn", "force"))
    depth, turn, force = (float(f"{value:.3g}") for value in (depth / size, max(turn, GENERAL.turn), force))
    return WorkingRange(depth, turn, force, fingerprint)


def _strokes(trials: Sequence[PressTrial]) -> list[list[PressTrial]]:
    return [[trial for trial in trials if trial.stroke == number] for number in sorted({trial.stroke for trial in trials})]


def _first_found(stroke: Sequence[PressTrial], near: float) -> int | None:
    found = [trial.is_found(near) for trial in stroke]
    return next((k for k, here in enumerate(found) if here and all(found[k : k + 2])), None)
