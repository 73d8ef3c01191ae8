"""Passes over whole images by machine code: their status, their noise, and images of half their resolution.

Each tensor operation reads the image again. The formulas are those of `observer`, `noise` and `dots.pyramid`, which say what
they mean; a test holds both to the same numbers. In single precision only.
"""

import numpy as np

from ..machine_code import Kept, fingerprint, kept
from .native_frames import KEPT_STEPS


@kept
def statuses(c, images, found):
    """Fill `found [B]` with `MarkerObserver.check`."""
    least_contrast, saturated_share, stride, blank, bad = c
    lows, highs, totals = np.empty((3, images.shape[2]), np.float32)
    for b in range(len(found)):
        saturated, count, mean, lows[:], highs[:], totals[:] = 0, 0, 0.0, np.inf, -np.inf, 0
        for i in range(images.shape[1]):
            row = images[b, i]
            for k in range(len(row)):
                totals[k] += row[k]
                lows[k] = min(lows[k], row[k])
                highs[k] = max(highs[k], row[k])
            if i % stride == 0:
                for k in range(0, len(row), stride):
                    saturated, count = saturated + (abs(row[k] - np.float32(0.5)) > np.float32(0.495)), count + 1
        low, high = lows.min(), highs.max()
        for k in range(len(totals)):
            mean += totals[k] / images[b].size
        is_blank = high - low < least_contrast or (saturated > saturated_share * count and mean > 0.5)
        is_good = mean < np.inf and low > -1e-3 and high < 1.001
        found[b] = (blank if is_blank else 0) if is_good else bad


@kept
def noises(c, images, found):
    """Fill `found [B]` with `pixel_noise`."""
    stride, low, high, no_limit, factor, rounds, divisor = c
    height, width = images.shape[1:]
    sizes = np.empty((height // stride + 1) * (width // stride + 1), np.float32)
    for b in range(len(found)):
        size = 0
        for i in range(0, height - 2, stride):
            for k in range(0, width - 2, stride):
                if low < images[b, i + 1, k + 1] < high:
                    left = images[b, i, k] + images[b, i + 2, k] - 2 * images[b, i + 1, k]
                    here = images[b, i, k + 1] + images[b, i + 2, k + 1] - 2 * images[b, i + 1, k + 1]
                    right = images[b, i, k + 2] + images[b, i + 2, k + 2] - 2 * images[b, i + 1, k + 2]
                    sizes[size] = abs(left + right - 2 * here)
                    size += 1
        mean, limit = 0.0, no_limit
        for _ in range(rounds):
            total, count = 0.0, 0
            for n in range(size):
                if sizes[n] <= limit:
                    total, count = total + sizes[n], count + 1
            mean = total / max(count, 1)
            limit = factor * mean
        found[b] = mean / divisor


@kept
def halves(_, images, found):
    """Fill `found [B, H // 2, W // 2]` with means over 2 x 2 pixels."""
    row = np.empty(2 * found.shape[2], np.float32)
    for b in range(len(found)):
        for i in range(found.shape[1]):
            above, below, means = images[b, 2 * i], images[b, 2 * i + 1], found[b, i]
            for k in range(len(row)):
                row[k] = above[k] + below[k]
            for k in range(len(means)):
                means[k] = np.float32(0.25) * (row[2 * k] + row[2 * k + 1])


SOURCES = fingerprint(__file__)
KEPT_STEPS.update({function: Kept(function, SOURCES, 2) for function in (statuses, noises, halves)})
