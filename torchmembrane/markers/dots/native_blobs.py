"""The detection of blobs by machine code: what `HessianScale` and `BlobDetector` do, and the validity of the blobs.

On a processor the tensor operations move several images for every step of the arithmetic. Here a row of an image stays in the
cache from the blur to the Hessian, and the narrow bands of the blur are used as such. The formulas are those of `detect` and
`locator`, which say what they mean; a test holds both to the same numbers. In single precision only.
"""

from typing import Any, NamedTuple

import numpy as np

from ...machine_code import Kept, compiled, fingerprint, kept
from .. import native_frames
from ..native_frames import KEPT_STEPS, largest
from . import probability, scales
from .probability import LEAST, contrast_evidence
from .scales import FAINT, SHADE

_contrast_evidence = compiled(contrast_evidence)


class Scale(NamedTuple):
    """Constants of a scale."""

    first_v: Any
    """`[m]`, the first row of the level that each blurred row takes."""
    along_v: Any
    """`[m, T]`, the weights of that row and those that follow."""
    first_u: int
    """The column of the level, maybe outside, of the first weight of the first blurred column; of the next it is the next."""
    along_u: Any
    """`[T, n]`"""
    cells_v: Any
    """`[rows]` and `[columns]`: positions in the response of the cells, if they are finer than its pixels, else empty."""
    cells_u: Any
    is_paired: bool
    """Whether the cells are coarser than the pixels of the level."""


class Peaks(NamedTuple):
    """Constants of the detector."""

    inside: Any
    """`[rows, columns]`"""
    first_v: Any
    """`[rows]`, the first row of the coarsest level that the background of each row of cells takes."""
    along_v: Any
    """`[rows, T]`, the weights of that row and those that follow."""
    first_u: Any
    """The same of columns."""
    along_u: Any
    log_radii: Any
    corner: Any
    cell: int
    reach: int


@compiled
def _blurred(c, image, row, blurred):
    """Write the blurred image `[m, n]`; `row`: columns of the level from `first_u`, 0 outside of it."""
    begin, end = max(c.first_u, 0), min(c.first_u + len(row), image.shape[1])
    row[:] = 0
    for i in range(len(blurred)):
        middle, found = row[begin - c.first_u : end - c.first_u], blurred[i]
        middle[:] = 0
        for t in range(c.along_v.shape[1]):
            weight, line = c.along_v[i, t], image[c.first_v[i] + t, begin:end]
            for k in range(len(middle)):
                middle[k] += weight * line[k]
        found[:] = 0
        for t in range(len(c.along_u)):
            weights, line = c.along_u[t], row[t : t + len(found)]
            for k in range(len(found)):
                found[k] += weights[k] * line[k]


@compiled
def _response(blurred, response):
    """Write `sigma^4 det Hessian` where the image is a dark maximum, else 0, `[m - 2, n - 2]`."""
    for i in range(len(response)):
        above, middle, below, row = blurred[i], blurred[i + 1], blurred[i + 2], response[i]
        for k in range(len(row)):
            uu = middle[k + 2] + middle[k] - 2 * middle[k + 1]
            vv = below[k + 1] + above[k + 1] - 2 * middle[k + 1]
            uv = (below[k + 2] - above[k + 2]) - (below[k] - above[k])
            row[k] = max(max(uu, np.float32(0)) * vv - uv * uv * np.float32(1 / 16), np.float32(0))


@compiled
def _on_cells(c, response, found):
    """Write the response of the cells, `[rows, columns]`."""
    for i in range(len(found)):
        for k in range(found.shape[1]):
            if c.is_paired:
                above = max(response[2 * i, 2 * k], response[2 * i, 2 * k + 1])
                found[i, k] = max(above, response[2 * i + 1, 2 * k], response[2 * i + 1, 2 * k + 1])
            elif len(c.cells_v) > 0:
                v, u = min(int(c.cells_v[i]), len(response) - 2), min(int(c.cells_u[k]), response.shape[1] - 2)
                down, right = c.cells_v[i] - np.float32(v), c.cells_u[k] - np.float32(u)
                above = response[v, u] + right * (response[v, u + 1] - response[v, u])
                below = response[v + 1, u] + right * (response[v + 1, u + 1] - response[v + 1, u])
                found[i, k] = above + down * (below - above)
            else:
                found[i, k] = response[i, k]


@compiled
def _relative(c, scales, coarse, middle, peak):
    """Write the largest response over the squared background inside the membrane, `[rows, columns]`; `coarse`: the coarsest
    level."""
    for i in range(len(peak)):
        middle[:] = 0
        for t in range(c.along_v.shape[1]):
            weight, line = c.along_v[i, t], coarse[c.first_v[i] + t]
            for k in range(len(middle)):
                middle[k] += weight * line[k]
        for k in range(peak.shape[1]):
            background, line, weights = np.float32(0), middle[c.first_u[k] :], c.along_u[k]
            for t in range(len(weights)):
                background += weights[t] * line[t]
            peak[i, k] = background + np.float32(SHADE)
        for k in range(peak.shape[1]):
            highest = scales[0, i, k]
            for s in range(1, len(scales)):
                highest = max(highest, scales[s, i, k])
            peak[i, k] = highest / (peak[i, k] * peak[i, k]) * c.inside[i, k]


@compiled
def _is_highest(peak, i, k, reach):
    """Whether no cell around is higher."""
    for p in range(max(i - reach, 0), min(i + reach + 1, peak.shape[0])):
        for q in range(max(k - reach, 0), min(k + reach + 1, peak.shape[1])):
            if peak[p, q] > peak[i, k]:
                return False
    return True


@compiled
def _maxima(c, peak, values, places, cells):
    """Write the cells of the highest maxima to `cells`, the highest first, and return how many there are; cells of
    value 0 complete the list."""
    columns, size, other, flat = peak.shape[1], 0, -1, peak.reshape(-1)
    for i in range(len(peak)):
        for k in range(columns):
            if peak[i, k] > 0 and _is_highest(peak, i, k, c.reach):
                values[size], places[size] = peak[i, k], i * columns + k
                size += 1
    size = largest(values[:size], cells)
    for k in range(len(cells)):
        if k < size:
            cells[k] = places[cells[k]]
            continue
        other += 1
        while other < peak.size - 1 and flat[other] > 0:
            other += 1
        cells[k] = min(other, peak.size - 1)
    return size


@compiled
def _blob(c, scales, peak, cell, height, found):
    """Write a blob to `found [4]`: centre, log radius, strength; `height`: of its maximum; `scales [S, rows, columns]`."""
    rows, columns = peak.shape
    i, k, flat = cell // columns, cell % columns, peak.reshape(-1)
    strength, weight, total = np.sqrt(max(height, np.float32(1e-20))), np.float32(0), np.float32(0)
    for s in range(len(scales)):
        square = scales[s, i, k] ** 2
        weight, total = weight + square, total + square * c.log_radii[s]
    for a in range(2):
        side = 1 if a == 0 else columns
        before = np.sqrt(max(flat[max(cell - side, 0)], np.float32(1e-12)))
        after = np.sqrt(max(flat[min(cell + side, rows * columns - 1)], np.float32(1e-12)))
        shift = np.float32(0.5) * (after - before) / max(2 * strength - after - before, np.float32(1e-12))
        shift = min(max(shift, np.float32(-0.5)), np.float32(0.5))
        found[a] = (np.float32(k if a == 0 else i) + shift) * np.float32(c.cell) + c.corner[a]
    found[2], found[3] = total / max(weight, np.float32(1e-20)), strength


def _entries(sources: str) -> Any:
    @kept
    def responses(c, levels, found):
        """Fill `found [B, rows, columns]` for images `[B, H, W]` of the scale's level."""
        m, n = len(c.along_v), c.along_u.shape[1]
        row, blurred = np.empty(n + len(c.along_u) - 1, np.float32), np.empty((m, n), np.float32)
        response = np.empty((m - 2, n - 2), np.float32)
        for b in range(len(found) if sources else 0):
            _blurred(c, levels[b], row, blurred)
            _response(blurred, response)
            _on_cells(c, response, found[b])

    @kept
    def peaks(c, scales, coarse, found):
        """Fill `found [B, K, 4]`: centre, log radius, strength; from `scales [B, S, rows, columns]` and the coarsest level."""
        peak, count, middle = np.empty_like(c.inside), found.shape[1], np.empty(coarse.shape[2], np.float32)
        values, places, cells = np.empty(peak.size, np.float32), np.empty(peak.size, np.int64), np.empty(count, np.int64)
        for b in range(len(found) if sources else 0):
            _relative(c, scales[b], coarse[b], middle, peak)
            maxima, flat = _maxima(c, peak, values, places, cells), peak.reshape(-1)
            for k in range(count):
                height = flat[cells[k]] if k < maxima else np.float32(0)
                _blob(c, scales[b], peak, cells[k], height, found[b, k])

    @kept
    def validities(c, blobs, strength, found):
        """Fill `found [B, K]` with the probability that each blob is a dot: `DotLocator.validity`."""
        pixels, strengths = c
        for b in range(len(found) if sources else 0):
            level = 0.0
            for k in range(found.shape[1]):
                best, own = np.float32(np.inf), 0
                for d in range(len(pixels)):
                    square = (blobs[b, k, 0] - pixels[d, 0]) ** 2 + (blobs[b, k, 1] - pixels[d, 1]) ** 2
                    if square < best:
                        best, own = square, d
                found[b, k] = strength[b, k] / strengths[own]
                if k < len(pixels) // 2:
                    level += found[b, k] / (len(pixels) // 2)
            for k in range(found.shape[1]):
                found[b, k] = 1 / (1 + np.exp(-_contrast_evidence(found[b, k] / max(level, LEAST), FAINT)))

    return responses, peaks, validities


SOURCES = fingerprint(__file__, native_frames.__file__, probability.__file__, scales.__file__)
responses, peaks, validities = _entries(SOURCES)
KEPT_STEPS.update({function: Kept(function, SOURCES, 4) for function in (responses, peaks, validities)})


def scale_constants(scale: Any) -> Scale:
    """Return the constants of a `HessianScale`."""
    along_v, along_u = (_dense(blur)[: side + 2] for blur, side in ((scale.blur_v, scale.rows), (scale.blur_u, scale.columns)))
    first, last = (end - np.arange(len(along_u)) for end in _range(along_u))
    column = np.arange(len(along_u)) + np.arange(first.min(), last.max() + 1)[:, None]
    is_there = (column >= 0) & (column < along_u.shape[1])
    weights = np.where(is_there, along_u[np.arange(len(along_u)), column.clip(0, along_u.shape[1] - 1)], 0)
    cells_v, cells_u = [np.zeros(0)] * 2 if scale.spread is None else scale.cells
    return Scale(
        *_banded(along_v),
        int(first.min()),
        weights.astype(np.float32),
        cells_v.astype(np.float32),
        cells_u.astype(np.float32),
        2**scale.level < scale.cell,
    )


def peak_constants(detector: Any) -> Peaks:
    """Return the constants of a `BlobDetector`."""
    inside, log_radii, corner = (value.numpy() for value in (detector.inside[0, 0], detector.log_radii, detector.corner))
    along_v, along_u = (_banded(matrix.numpy()) for matrix in (detector.background.along_v, detector.background.along_u.mT))
    (first_v, weights_v), (first_u, weights_u) = along_v, along_u
    first_v, first_u = first_v + detector.background.rows.start, first_u + detector.background.columns.start
    return Peaks(inside, first_v, weights_v, first_u, weights_u, log_radii, corner, detector.cell, detector.reach)


def _dense(blur: Any) -> np.ndarray:
    """Return the matrix of a `BandProduct`."""
    blocks, columns = blur.blocks.numpy(), blur.columns.numpy()
    matrix = np.zeros((*blocks.shape[:2], columns.max() + 1), np.float32)
    np.put_along_axis(matrix, np.broadcast_to(columns[:, None], blocks.shape), blocks, 2)
    return matrix.reshape(-1, matrix.shape[2])


def _banded(matrix: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the first columns `[m]` and the weights `[m, T]` of a band matrix."""
    first, last = _range(matrix)
    width = (last - first).max() + 1
    first = np.minimum(first, matrix.shape[1] - width)
    return first, np.take_along_axis(matrix, first[:, None] + np.arange(width), 1)


def _range(matrix: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the first and the last column of each row that is not zero."""
    is_used = matrix != 0
    return is_used.argmax(1), matrix.shape[1] - 1 - is_used[:, ::-1].argmax(1)
