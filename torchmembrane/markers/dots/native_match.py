"""The steps of the matching in which every dot is followed, by machine code: what `DotMatcher` does where none is lost.

The steps are those of `native_flow`, joined here so that they are one call. The formulas are those of `match`, which says what
they mean; a test holds both to the same numbers. In single precision only.
"""

from typing import Any

import numpy as np

from ...machine_code import Kept, compiled, fingerprint, inlined, kept
from ..native_frames import KEPT_STEPS
from . import native_flow, probability
from .native_flow import _along, _choice, _gradient
from .probability import LEAST


@inlined
def _settled(averages, chooser, state, known, base, work, found):
    """`DotMatcher.settle` of a frame, from `state [7, D]` to `found [7, D]`."""
    sums, first, gradient, predicted, least, fields = work
    weight, flow, strain = state[0], state[1:3], state[3:].reshape(2, 2, -1)
    _gradient(averages, weight, flow, strain, sums, gradient)
    _along(averages, weight, flow, gradient, fields, first, predicted)
    _choice(chooser, predicted[:2], predicted[2], known, base, least, found)


@compiled
def _work(averages):
    """Return arrays for the steps of one frame."""
    count, width, one = len(averages[5]), averages[0].shape[1], np.float32
    moments = np.empty((3, width), one), np.empty((7, averages[1].shape[1]), one), np.empty((2, 2, count), one)
    return *moments, np.empty((3, count), one), np.empty(count, one), np.empty((6, count), one)


@inlined
def _base(c, blobs, log_radius, valid, base):
    """Write `DotMatcher.base` of a frame, `[D, K]`."""
    radii, stiffness, origin, tolerance = c
    for k in range(len(valid)):
        no_dot = -2 * np.log(max(valid[k], np.float32(LEAST)))
        square = (blobs[k, 0] - origin[0]) ** 2 + (blobs[k, 1] - origin[1]) ** 2
        for d in range(len(radii)):
            base[d, k] = ((radii[d] - log_radius[k]) / tolerance) ** 2 + no_dot + stiffness[d] * square


@inlined
def _unstrained(c, blobs, log_radius, valid, known, base):
    """Apply `DotMatcher.unstrained` to one frame: `known [7, K]` and `base [D, K]`."""
    known[0], known[3:] = 1, 0
    for k in range(len(blobs)):
        for a in range(2):
            known[1 + a, k] = blobs[k, a] - c[2][a]
    _base(c, blobs, log_radius, valid, base)


@inlined
def _followed(c, known, base, previous, work, state, before, found):
    """Write the followed dots of `DotMatcher.follow` in one frame; `before [3, D]`: working memory for what the previous frame
    knows."""
    averages, chooser, seen, origin, least_weight = c
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
    _, first, _, predicted, least, fields = work
    _along(averages, before[0], before[1:3], state[3:].reshape(2, 2, -1), fields, first, predicted)
    _choice(chooser, predicted[:2], predicted[2], known, base, least, state)
    _settled(averages, chooser, state, known, base, work, found)
    found[7] = 1
    for d in range(len(seen)):
        if before[0, d] > 0 and not found[0, d] >= least_weight:
            found[7] = 0


@inlined
def _sure(c, weight, flow, known, base, work, state, found):
    """Apply `DotMatcher.sure` to one frame."""
    averages, chooser, seen, _, least_weight = c
    state[:], complete = 0, 1
    for d in range(len(seen)):
        if weight[d] >= least_weight:
            state[0, d], state[1, d], state[2, d] = 1, flow[0, d], flow[1, d]
        elif seen[d]:
            complete = 0
    _settled(averages, chooser, state, known, base, work, found)
    sums, _, gradient, _, _, _ = work
    strain = found[3:7].reshape(2, 2, -1)
    _gradient(averages, found[0], found[1:3], strain, sums, gradient)
    strain[:], found[7] = gradient, complete


def _entries(sources: str) -> Any:
    @kept
    def bases(c, blobs, log_radius, valid, found):
        """Fill `found [B, D, K]` with `DotMatcher.base`."""
        for b in range(len(found) if sources else 0):
            _base(c, blobs[b], log_radius[b], valid[b], found[b])

    @kept
    def followed(c, blobs, log_radius, valid, previous, found):
        """Fill `found [B, 16, D]` with `DotMatcher.follow`: weight, flow, strain, and 1 if every dot was found again; then the
        same of the sure dots, and last 1 if all dots are found."""
        of_scene, of_match = c
        work, state, before = _work(of_match[0]), np.zeros_like(found[0, :7]), np.empty_like(found[0, :3])
        known = np.empty((7, blobs.shape[1]), np.float32)
        base = np.empty((found.shape[2], blobs.shape[1]), np.float32)
        for b in range(len(found) if sources else 0):
            followed, sure = found[b, :8], found[b, 8:]
            _unstrained(of_scene, blobs[b], log_radius[b], valid[b], known, base)
            _followed(of_match, known, base, previous[b], work, state, before, followed)
            _sure(of_match, followed[0], followed[1:3], known, base, work, state, sure)

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
