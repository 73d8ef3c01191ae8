"""Whether matches hang together, by machine code: what `Coherence` does, without gradients.

The formulas are those of `coherence` and `steps`, which say what they mean; a test holds both to the same numbers. In single
precision only.
"""

from typing import Any, NamedTuple

import numpy as np
from torch import Tensor

from ...machine_code import Kept, compiled, fingerprint, kept
from ..spacing import FADED


class Constants(NamedTuple):
    """Of a pattern, as the buffers of `Coherence` and of its steps are named."""

    share: Any
    total: Any
    narrowness: Any
    claim: Any
    rival: Any
    decision: Any
    log_radius: Any
    near: Any
    step: Any
    length: Any


NOTHING = 20.0
"""A sigmoid of less than minus this is zero beside one."""


@compiled
def _sigmoid(x):
    return 1 / (1 + np.exp(-x))


@compiled
def _left_over(c, pixels, sure, blobs, log_radius, valid, narrowness, left):
    """How surely each blob is a dot's that no dot has."""
    for k in range(len(blobs)):
        claimed, least, nearest = 0.0, np.inf, 0
        for d in range(len(pixels)):
            square = (blobs[k, 0] - pixels[d, 0]) ** 2 + (blobs[k, 1] - pixels[d, 1]) ** 2
            if square < c.claim[d]:
                claimed = max(claimed, sure[d])
            if square < least:
                least, nearest = square, d
        left[k] = valid[k] * np.exp(narrowness * (log_radius[k] - c.log_radius[nearest]) ** 2) * (1 - claimed)


@compiled
def _beside(c, d, pixels, predicted, blobs, left):
    """How many blobs are left over around a dot, over the dots there; whether it has no rival."""
    length = np.sqrt(max((pixels[d, 0] - predicted[d, 0]) ** 2 + (pixels[d, 1] - predicted[d, 1]) ** 2, 1e-12))
    around, rival = 0.0, 0.0
    for k in range(len(blobs)):
        square = (blobs[k, 0] - pixels[d, 0]) ** 2 + (blobs[k, 1] - pixels[d, 1]) ** 2
        other = (blobs[k, 0] - predicted[d, 0]) ** 2 + (blobs[k, 1] - predicted[d, 1]) ** 2
        if square * c.narrowness[d] > -FADED:
            around += left[k] * np.exp(square * c.narrowness[d])
        margin = (length + c.rival[d] - np.sqrt(max(other, 1e-12))) * c.decision[d]
        if margin > -NOTHING:
            rival = max(rival, left[k] * _sigmoid(margin))
    return around / c.total[d], 1 - rival


@compiled
def _steps(c, d, pixels, sure, gradient):
    """`NeighbourSteps` of a dot."""
    error, pairs, there, change = 0.0, 0.0, 0.0, np.empty(2)
    count = len(c.near)
    for s in range(count):
        n = c.near[s, d]
        for a in range(2):
            change[a] = pixels[n, a] - pixels[d, a] - c.step[a, s, d]
            for b in range(2):
                change[a] -= (gradient[n, a, b] + gradient[d, a, b]) * c.step[b, s, d] / 2
        pair = sure[n] * sure[d]
        error += pair * np.sqrt(max(change[0] ** 2 + change[1] ** 2, 1e-12)) / c.length[s, d]
        pairs, there = pairs + pair, there + sure[n]
    return error, pairs, 1 - there / count


@kept
def trusts(c, numbers, pixels, confidence, gradient, predicted, blobs, log_radius, valid, found):
    """`found [B, D]` of every frame; `numbers`: narrowness of sizes, `TEAR`, `STRAY`; the rest as of `Coherence.forward`."""
    count = pixels.shape[1]
    sure, left, alone = np.empty(count), np.empty(blobs.shape[1]), np.empty(count)
    fields, means = np.empty((4, count)), np.empty((3, count))
    for f in range(len(found)):
        for d in range(count):
            sure[d] = _sigmoid(20 * (confidence[f, d] - 0.5))
        _left_over(c, pixels[f], sure, blobs[f], log_radius[f], valid[f], numbers[0], left)
        means[:] = 0
        for d in range(count):
            fields[0, d], alone[d] = _beside(c, d, pixels[f], predicted[f], blobs[f], left)
            fields[1, d], fields[2, d], fields[3, d] = _steps(c, d, pixels[f], sure, gradient[f])
            for other in range(count):
                share = c.share[d, other]
                means[0, other] += (1 - sure[d]) * share
                means[1, other] += fields[1, d] * share
                means[2, other] += fields[2, d] * share
        for d in range(count):
            tear = np.sqrt(max(min(means[0, d], fields[0, d]), 1e-12)) * means[1, d] / (means[2, d] + 1e-3)
            stray = fields[3, d] * fields[1, d] / (fields[2, d] + 1e-3)
            found[f, d] = alone[d] * _sigmoid(8 * (1 - tear / numbers[1])) * _sigmoid(8 * (1 - stray / numbers[2]))


kept_trusts = Kept(trusts, fingerprint(__file__), 4)
"""Whether `trusts` has been compiled."""


def trust_of(coherence: Any, numbers: tuple[float, float, float], *given: Tensor) -> Tensor:
    """`[B, D]`, of what `Coherence.forward` is given."""
    buffers = dict(coherence.named_buffers(recurse=False)) | dict(coherence.steps.named_buffers(recurse=False))
    constants = Constants(*(buffers[name].numpy() for name in Constants._fields))
    found = given[1].new_empty(given[1].shape)
    with kept_trusts.compiling(np.dtype(np.float32)):
        trusts(constants, numbers, *(value.contiguous().numpy() for value in given), found.numpy())
    return found
