"""Steps of the matching by machine code: what `FlowAverages` and `DotMatcher.choose` do, without gradients.

On a processor the tensor operations of a step, some seventy, take longer to begin than to work. The formulas are those of
`flow` and `match`, which say what they mean; a test holds both to the same numbers. In single precision only.
"""

import numpy as np

from ...machine_code import Kept, fingerprint, inlined, kept
from ..native_frames import KEPT_STEPS


@inlined
def _sums(weight, fields, moments, sums):
    """Compute `sums [R, M D] = rows @ moments`; the rows are the weight, and the weight times each of `fields [R - 1, D]`."""
    sums[:] = 0
    for n in range(len(weight)):
        row = moments[n]
        for r in range(len(sums)):
            share, total = weight[n] if r == 0 else weight[n] * fields[r - 1, n], sums[r]
            if share != 0:
                for k in range(len(row)):
                    total[k] += share * row[k]


@inlined
def _gradient(c, weight, flow, prior, sums, gradient):
    """Apply `FlowAverages.gradient` to one frame."""
    moments, _, _, raised, pull, h = c
    count = len(h)
    _sums(weight, flow, moments, sums)
    for d in range(count):
        total = sums[0, d] + raised[0, d]
        u, v = (sums[0, count + d] + raised[1, d]) / total, (sums[0, 2 * count + d] + raised[2, d]) / total
        first, second = sums[0, count + d] + raised[1, d], sums[0, 2 * count + d] + raised[2, d]
        uu, uv = sums[0, 3 * count + d] + raised[3, d] - first * u, sums[0, 4 * count + d] + raised[4, d] - first * v
        vv = sums[0, 6 * count + d] + raised[6, d] - second * v
        determinant = (uu * vv - uv * uv) * h[d]
        for a in range(2):
            mean = sums[1 + a, d]
            p = sums[1 + a, count + d] + pull[d] * prior[a, 0, d] - mean * u
            q = sums[1 + a, 2 * count + d] + pull[d] * prior[a, 1, d] - mean * v
            gradient[a, 0, d], gradient[a, 1, d] = (p * vv - q * uv) / determinant, (q * uu - p * uv) / determinant


@inlined
def _along(c, weight, flow, gradient, fields, sums, found):
    """Apply `FlowAverages.along` to one frame: write the flow and the support to `found [3, D]`."""
    _, moments, still, _, _, h = c
    count = len(h)
    for d in range(count):
        for a in range(2):
            fields[a, d] = flow[a, d]
            for b in range(2):
                fields[2 + 2 * a + b, d] = gradient[a, b, d]
    _sums(weight, fields, moments, sums)
    for d in range(count):
        support = sums[0, d] + still[0, d]
        for a in range(2):
            change = sums[3 + 2 * a, count + d] + sums[4 + 2 * a, 2 * count + d]
            for b in range(2):
                change += gradient[a, b, d] * (sums[0, (1 + b) * count + d] + still[1 + b, d])
            found[a, d] = (sums[1 + a, d] - h[d] * change / 2) / (support + np.float32(1e-3))
        found[2, d] = support


@inlined
def _choice(c, predicted, support, blobs, base, least, found):
    """`DotMatcher.choose` of a frame: `found [7, D]`, the weight, the flow and the strain; `numbers`: as of `match`."""
    pixels, stiffness, numbers = c
    cost, rival = np.empty_like(base), np.full(blobs.shape[1], np.inf, base.dtype)
    for d in range(len(pixels)):
        x, y, row, best = pixels[d, 0] + predicted[0, d], pixels[d, 1] + predicted[1, d], cost[d], np.float32(np.inf)
        alone = (x * x + y * y) * stiffness[d] + (numbers[2] if support[d] < numbers[0] else np.float32(0))
        x, y = -2 * stiffness[d] * x, -2 * stiffness[d] * y
        for k in range(len(row)):
            row[k] = alone + x * blobs[1, k] + y * blobs[2, k] + base[d, k]
        for k in range(len(row)):
            best, rival[k] = min(best, row[k]), min(rival[k], row[k])
        least[d] = best
    for d in range(len(pixels)):
        best, count, of_blob, found[:, d] = least[d], 0, 0.0, 0
        for k in range(len(rival)):
            if cost[d, k] <= best:
                count, of_blob = count + 1, of_blob + rival[k]
                for e in range(6):
                    found[1 + e, d] += blobs[1 + e, k]
        for e in range(6):
            found[1 + e, d] /= count
        weight = np.exp(-0.5 * best) * (support[d] / (support[d] + 0.5))
        found[0, d] = weight if best <= of_blob / count + 1e-6 * abs(best) else 0.0
        for a in range(2):
            found[1 + a, d] = found[1 + a, d] - pixels[d, a] if found[0, d] > numbers[1] else predicted[a, d]


@kept
def gradients(c, weight, flow, prior, found):
    """Fill `found [B, 2, 2, D]` for all frames."""
    sums = np.empty((3, c[0].shape[1]), np.float32)
    for b in range(len(found)):
        _gradient(c, weight[b], flow[b], prior[b], sums, found[b])


@kept
def flows(c, weight, flow, gradient, found):
    """Fill `found [B, 3, D]` for all frames."""
    count = len(c[5])
    fields, sums = np.empty((6, count), np.float32), np.empty((7, 3 * count), np.float32)
    for b in range(len(found)):
        _along(c, weight[b], flow[b], gradient[b], fields, sums, found[b])


@kept
def choices(c, predicted, support, blobs, base, found):
    """Fill `found [B, 7, D]` for all frames."""
    least = np.empty(len(c[0]), np.float32)
    for b in range(len(found)):
        _choice(c, predicted[b], support[b], blobs[b], base[b], least, found[b])


SOURCES = fingerprint(__file__)
KEPT_STEPS.update({function: Kept(function, SOURCES, 3) for function in (gradients, flows, choices)})
