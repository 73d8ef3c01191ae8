"""The steps of the matching in which every dot is followed, by machine code: what `DotMatcher` does where none is lost.

The steps are those of `native_flow`, joined here so that they are one call. The formulas are those of `match`, which says what
they mean; a test holds both to the same numbers. In single precision only.
"""

from typing import Any

import numpy as np

from ...machine_code import Kept, compiled, fingerprint, kept
from ..native_frames import KEPT_STEPS
from . import native_flow, probability
from .native_flow import _along, _choice, _gradient
from .probability import LEAST


@compiled
def _settled(averages, chooser, state, known, base, rows, moments, fields, found):
    """`DotMatcher.settle` of a frame, from `state [7, D]` to `found [7, D]`."""
    sums, first, gradient, predicted, least = moments
    weight, flow, strain = state[0], state[1:3], state[3:].reshape(2, 2, -1)
    _gradient(averages, weight, flow, strain, rows, sums, gradient)
    _along(averages, weight, flow, gradient, fields, rows, first, predicted)
    _choice(chooser, predicted[:2], predicted[2], known, base, least, found)


@compiled
def _work(averages):
    """Return arrays for the steps of one frame."""
    count, width, one = len(averages[5]), averages[0].shape[1], np.float32
    moments = np.empty((3, width), one), np.empty((7, averages[1].shape[1]), one), np.empty((2, 2, count), one)
    return np.empty(count, one), (*moments, np.empty((3, count), one), np.empty(count, one)), np.empty((6, count), one)


@compiled
def _followed(c, known, base, previous, work, state, before, found):
    """Apply `DotMatcher.follow` to one frame; `before [3, D]`: working memory for what the previous frame knows."""
    averages, chooser, seen, origin, least_weight = c
    rows, moments, fields = work
    count = 0
    for d in range(len(seen)):
        is_known = np.isfinite(previous[d, 0]) and np.isfinite(previous[d, 1])
        count, before[0, d] = count + is_known, is_known
    enough = 2 * count > len(seen)
    for d in range(len(seen)):
        before[0, d] = before[0, d] if enough else seen[d]
        for a in range(2):
            is_moved = enough and before[0, d] > 0
            before[1 + a, d] = previous[d, a] - chooser[0][d, a] - origin[a] if is_moved else 0
    state[:] = 0
    predicted, least = moments[3], moments[4]
    _along(averages, before[0], before[1:3], state[3:].reshape(2, 2, -1), fields, rows, moments[1], predicted)
    _choice(chooser, predicted[:2], predicted[2], known, base, least, state)
    _settled(averages, chooser, state, known, base, rows, moments, fields, found)
    found[7] = 1
    for d in range(len(seen)):
        if before[0, d] > 0 and not found[0, d] >= least_weight:
            found[7] = 0


@compiled
def _sure(c, weight, flow, known, base, work, state, found):
    """Apply `DotMatcher.sure` to one frame."""
    averages, chooser, seen, _, least_weight = c
    rows, moments, fields = work
    state[:], complete = 0, 1
    for d in range(len(seen)):
        if weight[d] >= least_weight:
            state[0, d], state[1, d], state[2, d] = 1, flow[0, d], flow[1, d]
        elif seen[d]:
            complete = 0
    _settled(averages, chooser, state, known, base, rows, moments, fields, found)
    strain = found[3:7].reshape(2, 2, -1)
    _gradient(averages, found[0], found[1:3], strain, rows, moments[0], moments[2])
    strain[:], found[7] = moments[2], complete


def _entries(sources: str) -> Any:
    @kept
    def bases(c, blobs, log_radius, valid, found):
        """Fill `found [B, D, K]` with `DotMatcher.base`."""
        radii, stiffness, origin, tolerance = c
        for b in range(len(found) if sources else 0):
            for k in range(found.shape[2]):
                no_dot = -2 * np.log(max(valid[b, k], np.float32(LEAST)))
                square = (blobs[b, k, 0] - origin[0]) ** 2 + (blobs[b, k, 1] - origin[1]) ** 2
                for d in range(len(radii)):
                    found[b, d, k] = ((radii[d] - log_radius[b, k]) / tolerance) ** 2 + no_dot + stiffness[d] * square

    @kept
    def followed(c, known, base, previous, found):
        """Fill `found [B, 8, D]` with `DotMatcher.follow`: weight, flow, strain, and last 1 if every dot was found again."""
        work, state, before = _work(c[0]), np.zeros_like(found[0, :7]), np.empty_like(found[0, :3])
        for b in range(len(found) if sources else 0):
            _followed(c, known[b], base[b], previous[b], work, state, before, found[b])

    @kept
    def sure_states(c, weight, flow, known, base, found):
        """Fill `found [B, 8, D]` with `DotMatcher.sure`: weight, flow, gradient, and last 1 if all dots are found."""
        work, state = _work(c[0]), np.zeros_like(found[0, :7])
        for b in range(len(found) if sources else 0):
            _sure(c, weight[b], flow[b], known[b], base[b], work, state, found[b])

    return bases, followed, sure_states


SOURCES = fingerprint(__file__, native_flow.__file__, probability.__file__)
bases, followed, sure_states = _entries(SOURCES)
KEPT_STEPS.update({function: Kept(function, SOURCES, 5) for function in (bases, followed, sure_states)})
