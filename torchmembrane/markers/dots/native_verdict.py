"""The last steps of the location of dots by machine code: outlines from which fits start, and confidence in fitted dots.

On a processor the tensor operations of these steps, some two hundred, take longer to begin than to work. The formulas are those
of `locator`, `probability`, `steps` and `seams`, which say what they mean; a test holds both to the same numbers. In single
precision only.
"""

from typing import Any, NamedTuple

import numpy as np

from ...machine_code import Kept, compiled, fingerprint, kept
from .. import native_frames, spacing
from ..native_frames import KEPT_STEPS, largest
from ..spacing import FADED
from . import native_flow, probability, scales, seams
from .native_flow import _along, _gradient
from .probability import (
    LEAST,
    PARAMETERS,
    PIXELS,
    STEP_DEVIATION,
    contrast_evidence,
    whole_evidence,
)
from .scales import LOST, PREDICTION, SHADE
from .seams import LEAST as LEAST_SEAM

HALVINGS, DEGREE = 6, 8
_contrast_evidence, _whole_evidence = compiled(contrast_evidence), compiled(whole_evidence)


class Verdict(NamedTuple):
    """Constants of a pattern, as of the modules from which they come."""

    averages: Any
    """`FlowAverages.constants`"""
    rest: Any
    """`[D, 2]`, px."""
    shapes: Any
    """`[D, 2, 2]`, px, at rest."""
    seen: Any
    """`[D]`, 1 for the dots in the image at rest, else 0."""
    near: Any
    """`[6, D]`, of `NeighbourSteps`, like the next five."""
    step: Any
    half_step: Any
    near_seen: Any
    length: Any
    share: Any
    """`[D, D]`, of `Seams`, like the next four."""
    total: Any
    narrowness: Any
    claim: Any
    log_radius: Any
    numbers: Any
    """`[3]`: `Seams.size_narrowness`, the step to which the confidence is rounded, the largest strain of an outline."""


@compiled
def _exp(x):
    """`exp(x)` of `-FADED` to 0 without a call, by a Taylor polynomial of `x / 2^HALVINGS`: to some 1e-7."""
    x, value = x / 2.0**HALVINGS, 1.0
    for n in range(DEGREE, 0, -1):
        value = 1 + value * x / n
    for _ in range(HALVINGS):
        value *= value
    return value


@compiled
def _own_evidence(found, error):
    """`own_evidence` of one dot."""
    density = 0.5 * (PREDICTION / STEP_DEVIATION) ** 2
    return np.log((found + LOST) / (1 - found + LOST) * density) - 0.5 * (error / STEP_DEVIATION) ** 2


@compiled
def _odds_of_window(explained, contrast, misfit, level):
    """Return the odds of the alternatives in a dot's own window, and the factor of the odds of another dot by its size."""
    nothing = -0.5 * PIXELS * np.log(max(1 - explained, LEAST)) - 0.5 * PARAMETERS * np.log(PIXELS)
    return np.exp(-nothing) + np.exp(-_contrast_evidence(contrast / level, 0.5)), np.exp(0.5 * misfit)


@compiled
def _steps(c, d, centre, sure, strain):
    """`NeighbourSteps` of one dot, at `centre [D, 2]`."""
    found, error, pairs = 0.0, 0.0, 0.0
    for n in range(len(c.near)):
        e, square = c.near[n, d], 0.0
        for a in range(2):
            change = centre[e, a] - centre[d, a] - c.step[a, n, d]
            for b in range(2):
                change -= (strain[a, b, e] + strain[a, b, d]) * c.half_step[b, n, d]
            square += change * change
        pair = sure[e] * sure[d]
        found, pairs = found + sure[e] * c.near_seen[n, d], pairs + pair
        error += pair * np.sqrt(max(square, 1e-12)) / c.length[n, d]
    return found, error / max(pairs, 1e-3)


@compiled
def _tears(c, centre, sure, wrong, blobs, log_radius, valid, sums, square):
    """`Seams` of a frame: write the measure to `sums[0]`, of `sums [4, D]`."""
    sums[:] = 0
    for k in range(len(blobs)):
        claimed, best, own = np.float32(0), np.float32(np.inf), 0
        for d in range(len(centre)):
            square[d] = (blobs[k, 0] - centre[d, 0]) ** 2 + (blobs[k, 1] - centre[d, 1]) ** 2
        for d in range(len(centre)):
            if square[d] < best:
                best, own = square[d], d
            if square[d] < c.claim[d]:
                claimed = max(claimed, sure[d])
        left = valid[k] * np.exp((log_radius[k] - c.log_radius[own]) ** 2 * c.numbers[0]) * (1 - claimed)
        if left != 0:
            for d in range(len(centre)):
                sums[0, d] += left * np.float32(_exp(max(np.float64(square[d] * c.narrowness[d]), -FADED)))
    for e in range(len(centre)):
        for d in range(len(centre)):
            sums[1, d] += (1 - sure[e]) * c.share[e, d]
            sums[2, d] += sure[e] * wrong[e] * c.share[e, d]
            sums[3, d] += sure[e] * c.share[e, d]
    for d in range(len(centre)):
        torn = max(min(sums[1, d], sums[0, d] / c.total[d]), LEAST_SEAM**4)
        sums[0, d] = np.sqrt(torn) * sums[2, d] / max(sums[3, d], LEAST_SEAM)


@compiled
def _judged(c, centre, explained, contrast, misfit, strain, blobs, log_radius, valid, work, confidence):
    """Write the confidence `[D]` of the dots of a frame, before their place in the image is considered; `work [10, D]`."""
    count = len(confidence)
    sure, found, wrong, window, size, square, sums = work[0], work[1], work[2], work[3], work[4], work[5], work[6:]
    clearer, level, all_seen, share = np.empty(count // 2, np.int64), 0.0, c.seen.sum(), 0.0
    for n in range(largest(contrast, clearer)):
        level += contrast[clearer[n]] / len(clearer)
    level = max(level, 0.0) + SHADE
    for d in range(count):
        window[d], size[d] = _odds_of_window(explained[d], contrast[d], misfit[d], level)
        sure[d] = 1 / (1 + window[d] + np.exp(-_own_evidence(1.0, 0.0)) * size[d])
        share += sure[d] * c.seen[d] / all_seen
    for d in range(count):
        found[d], wrong[d] = _steps(c, d, centre, sure, strain)
    _tears(c, centre, sure, wrong, blobs, log_radius, valid, sums, square)
    for d in range(count):
        others = np.exp(-_own_evidence(share * found[d], wrong[d])) * size[d] + np.exp(-_whole_evidence(sums[0, d]))
        confidence[d] = np.round(1 / (1 + window[d] + others) / c.numbers[1]) * c.numbers[1]


def _entries(sources: str) -> Any:
    @kept
    def outlines(c, certainty, place, strain, found):
        """Fill `found [B, D, 2, 2]` with the outlines from which fits start; `certainty [B, D]`, `place [B, D, 2]` px, `strain
        [B, 2, 2, D]`."""
        count = len(c.rest)
        sums = np.empty((3, c.averages[0].shape[1]), np.float32)
        flow, gradient = np.empty((2, count), np.float32), np.empty((2, 2, count), np.float32)
        for b in range(len(found) if sources else 0):
            for d in range(count):
                for a in range(2):
                    flow[a, d] = place[b, d, a] - c.rest[d, a]
            _gradient(c.averages, certainty[b], flow, strain[b], sums, gradient)
            for d in range(count):
                for a in range(2):
                    for e in range(2):
                        found[b, d, a, e] = c.shapes[d, a, e]
                        for f in range(2):
                            found[b, d, a, e] += min(max(gradient[a, f, d], -c.numbers[2]), c.numbers[2]) * c.shapes[d, f, e]

    @kept
    def verdicts(c_and_size, centre, explained, contrast, misfit, strain, blobs, log_radius, valid, found):
        """Fill `found [B, 3, D]`, confidence and pixels; `size`: width and height of the images."""
        c, size = c_and_size
        count = len(c.rest)
        sums = np.empty((3, c.averages[0].shape[1]), np.float32)
        near, fields, work = (
            np.empty((7, 3 * count), np.float32),
            np.empty((6, count), np.float32),
            np.empty((10, count), np.float32),
        )
        flow, predicted = np.empty((2, count), np.float32), np.empty((3, count), np.float32)
        gradient = np.empty((2, 2, count), np.float32)
        for b in range(len(found) if sources else 0):
            dots = centre[b], explained[b], contrast[b], misfit[b], strain[b]
            confidence = found[b, 0]
            _judged(c, *dots, blobs[b], log_radius[b], valid[b], work, confidence)
            for d in range(count):
                for a in range(2):
                    flow[a, d] = centre[b, d, a] - c.rest[d, a]
            _gradient(c.averages, confidence, flow, strain[b], sums, gradient)
            _along(c.averages, confidence, flow, gradient, fields, near, predicted)
            for d in range(count):
                u, v = c.rest[d, 0] + predicted[0, d], c.rest[d, 1] + predicted[1, d]
                confidence[d] *= u > -0.5 and u < size[0] - 0.5 and v > -0.5 and v < size[1] - 0.5
                is_found = confidence[d] > 0.5
                found[b, 1, d], found[b, 2, d] = (centre[b, d, 0], centre[b, d, 1]) if is_found else (u, v)

    return outlines, verdicts


SHARED = native_flow, native_frames, probability, scales, seams, spacing
SOURCES = fingerprint(__file__, *(module.__file__ for module in SHARED))
outlines, verdicts = _entries(SOURCES)
KEPT_STEPS.update({outlines: Kept(outlines, SOURCES, 2), verdicts: Kept(verdicts, SOURCES, 5)})


def constants(locator: Any, confidence: float, largest: float) -> Verdict:
    """Return the constants of a `DotLocator`; the step to which confidence is rounded; the largest strain of an outline."""
    match, seams, steps = locator.match, locator.seams, locator.match.neighbour_steps
    of_steps = steps.near, steps.step, steps.half_step, steps.seen, steps.length
    of_seams = seams.share, seams.total, seams.narrowness, seams.claim, seams.log_radius
    numbers = np.array([seams.size_narrowness, confidence, largest], np.float32)
    arrays = [value.numpy() for value in (locator.rest, locator.shapes, match.seen.float(), *of_steps, *of_seams)]
    return Verdict._make([match.averages.constants(), *arrays, numbers])
