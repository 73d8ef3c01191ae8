"""The fit of ellipses by machine code: what `EllipseFit` does, dot by dot, without gradients.

On a processor the tensor operations of the three steps, some four hundred, take longer to begin than to work. The formulas are
those of `fit`, which says what they mean; a test holds both to the same numbers. In single precision only. The pixels of a
window are in blocks of `LANES`, so that a compiler sees that they are worked out side by side.
"""

from typing import Any, NamedTuple

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from ... import vectors
from ...machine_code import Kept, compiled, fingerprint, in_threads, inlined, kept
from ...vectors import BYTES, load, total
from .scales import FAINT

MISFIT = 0.02
"""Share of the residual's variance that differs between images besides noise; most of the rest is the model's error."""

LANES, FIELDS, UNKNOWNS = 16, 8, 7
"""Pixels of a block; fields of a pixel, the last the window itself; unknowns of a fit."""
VECTOR = BYTES // 4
"""Pixels of a vector register."""
HALF, ONE, TINY = np.float32(0.5), np.float32(1), np.float32(1e-12)
LARGEST = np.float32(7.90531110763549805)
"""Above this value tanh is 1."""
TOP = (-2.76076847742355e-16, 2.00018790482477e-13, -8.60467152213735e-11, 5.12229709037114e-08, 1.48572235717979e-05)
ODD = tuple(np.float32(c) for c in (*TOP, 6.37261928875436e-04, 4.89352455891786e-03))
EVEN = tuple(np.float32(c) for c in (1.19825839466702e-06, 1.18534705686654e-04, 2.26843463243900e-03, 4.89352518554385e-03))
"""tanh as a quotient of polynomials in x^2, the highest power first (Eigen's `ptanh`): to some 1e-7."""


class Constants(NamedTuple):
    """Constants of a pattern."""

    level: Any
    """`[D]`, of the pyramid, on which a dot is fitted."""
    limit: Any
    """`[D, 2]`, numbers, the last pixel that a window's middle may be."""
    scales: Any
    """`[D, 7]`: stride, corner, sharpness, unit, fall, ring, size."""
    ridge: Any
    """`[D, 7, 7]`"""
    steps: Any
    """`[2, P]`, integer offsets u and v of the window's pixels."""
    offsets: Any
    """`[2, P']`, the same as numbers, then zeros to whole blocks."""
    counts: Any
    """`[P']`, 1 for each pixel, then zeros."""
    farthest: Any
    """`[3]`, changes over their reach."""
    numbers: Any
    """`[4]`: half the window's width, `MISFIT`, one over the variance of log radii, `FAINT`."""


@compiled
def _sigmoid(x):
    """`1 / (1 + exp(-x))` without a call, by tanh."""
    x = min(max(HALF * x, -LARGEST), LARGEST)
    square = x * x
    odd = ODD[0] * square + ODD[1]
    odd = odd * square + ODD[2]
    odd = odd * square + ODD[3]
    odd = odd * square + ODD[4]
    odd = odd * square + ODD[5]
    odd = odd * square + ODD[6]
    even = EVEN[0] * square + EVEN[1]
    even = even * square + EVEN[2]
    even = even * square + EVEN[3]
    return max(HALF + HALF * (x * odd / even), np.float32(0))


@compiled
def _window(c, d, image, centre, window, middle):
    """Return the pixels around a centre minus their mean, the middle of the window in px, and the mean."""
    stride, corner, half, count = c.scales[d, 0], c.scales[d, 1], c.numbers[0], c.steps.shape[1]
    for a in range(2):
        at = np.round((centre[a] - corner) / stride)
        middle[a] = min(at if at > half else half, c.limit[d, a])
    first_u, first_v, mean = np.int64(middle[0]), np.int64(middle[1]), np.float32(0)
    for k in range(count):
        window[k] = image[first_v + c.steps[1, k], first_u + c.steps[0, k]]
        mean += window[k]
    mean /= np.float32(count)
    for k in range(count):  # what follows stays 0
        window[k] -= mean
    for a in range(2):
        middle[a] = middle[a] * stride + corner
    return mean


@compiled
def _to_circle(unit, sharpness, shape, rows):
    """`EllipseFit._to_circle`: from an offset, and one in pixels of the level, `rows [4, 4]`; the dot's size."""
    p, q, r, s = shape[0, 0] * unit, shape[0, 1] * unit, shape[1, 0] * unit, shape[1, 1] * unit
    determinant = p * s - q * r
    rows[0, 0], rows[0, 1], rows[1, 0], rows[1, 1] = s / determinant, -q / determinant, -r / determinant, p / determinant
    for a in range(2):
        for b in range(2):
            rows[2 + a, b] = rows[0, a] * rows[0, b] + rows[1, a] * rows[1, b]
    for a in range(4):
        for b in range(2):
            rows[a, 2 + b] = rows[a, b] * sharpness
    return np.sqrt(HALF * (p * p + q * q + r * r + s * s))


@compiled
def _outlined(c, d, rows, offset, growth, before, window, fields):
    """`EllipseFit._outline` and what `_gram` multiplies, at a dot's `offset [2]`; `before [5]`: the fit before, of background
    and depth, over what stands out, and one over that; zero where there is none."""
    fall, ring, u, v = c.scales[d, 4], c.scales[d, 5], c.offsets[0], c.offsets[1]
    x0, xu, xv = rows[0, 0] * offset[0] + rows[0, 1] * offset[1], rows[0, 2], rows[0, 3]
    y0, yu, yv = rows[1, 0] * offset[0] + rows[1, 1] * offset[1], rows[1, 2], rows[1, 3]
    p0, pu, pv = rows[2, 0] * offset[0] + rows[2, 1] * offset[1], rows[2, 2], rows[2, 3]
    q0, qu, qv = rows[3, 0] * offset[0] + rows[3, 1] * offset[1], rows[3, 2], rows[3, 3]
    b0, bu, bv, bt, bw = before[0], before[1], before[2], before[3], before[4]
    for block in range(len(window) // LANES):
        first, at = block * LANES, block * LANES * FIELDS
        for k in range(LANES):
            s, t, own = u[first + k], v[first + k], window[first + k]
            x, y, along, down = x0 + xu * s + xv * t, y0 + yu * s + yv * t, p0 + pu * s + pv * t, q0 + qu * s + qv * t
            radius, per_length = np.sqrt(x * x + y * y + TINY), ONE / np.sqrt(along * along + down * down + TINY)
            depth = growth + (radius - radius * radius) * per_length
            template = _sigmoid(depth)
            darker = max(b0 + bu * s + bv * t + bt * template - bw * own, np.float32(0))
            square = darker * darker
            weight = _sigmoid(depth * fall + ring) / (ONE + square * square * (ONE - template)) * c.counts[first + k]
            root = np.sqrt(weight)
            edge = root * (template - template * template)
            fields[at + k] = root
            fields[at + LANES + k] = root * s
            fields[at + 2 * LANES + k] = root * t
            fields[at + 3 * LANES + k] = root * template
            fields[at + 4 * LANES + k] = edge * per_length * along
            fields[at + 5 * LANES + k] = edge * per_length * down
            fields[at + 6 * LANES + k] = edge
            fields[at + 7 * LANES + k] = root * own


@inlined
def _tile(fields, i, j, gram):
    """Write the products of two fields, from the i-th on, with four, from the j-th on; their eight sums stay in registers."""
    a, b = load(fields, i * LANES), load(fields, (i + 1) * LANES)
    p, q, r, s = _four(fields, j * LANES)
    ap, aq, ar, at, bp, bq, br, bt = a * p, a * q, a * r, a * s, b * p, b * q, b * r, b * s
    for n in range(1, len(fields) // FIELDS // VECTOR):
        here = n * VECTOR // LANES * FIELDS * LANES + n * VECTOR % LANES
        a, b = load(fields, here + i * LANES), load(fields, here + (i + 1) * LANES)
        p, q, r, s = _four(fields, here + j * LANES)
        ap, aq, ar, at, bp, bq, br, bt = (
            ap + a * p,
            aq + a * q,
            ar + a * r,
            at + a * s,
            bp + b * p,
            bq + b * q,
            br + b * r,
            bt + b * s,
        )
    gram[i, j], gram[i, j + 1], gram[i, j + 2], gram[i, j + 3] = total(ap), total(aq), total(ar), total(at)
    gram[i + 1, j], gram[i + 1, j + 1], gram[i + 1, j + 2], gram[i + 1, j + 3] = total(bp), total(bq), total(br), total(bt)


@inlined
def _four(fields, at):
    """Return vectors of four fields."""
    return load(fields, at), load(fields, at + LANES), load(fields, at + 2 * LANES), load(fields, at + 3 * LANES)


@compiled
def _products(fields, gram):
    """Apply `EllipseFit._gram`: write the products `[8, 8]` of the fields."""
    for i in range(0, FIELDS, 2):
        for j in range(0, i + 2, 4):
            _tile(fields, i, j, gram)
    for i in range(FIELDS):
        for j in range(i):
            gram[j, i] = gram[i, j]


@compiled
def _fitted(c, d, gram, system):
    """Fill `system [7, LANES]` and solve it in place; it becomes `[1 x 0]` for the loads of the window and of the centre's two
    coordinates."""
    for a in range(UNKNOWNS):
        for b in range(UNKNOWNS):
            system[a, b] = gram[a, b] + c.ridge[d, a, b]
        system[a, 7:] = 0
        system[a, 7], system[a, 8], system[a, 9] = gram[a, 7], np.float32(a == 4), np.float32(a == 5)
    for a in range(UNKNOWNS):
        pivot = ONE / system[a, a]
        for e in range(LANES):
            system[a, e] *= pivot
        for b in range(UNKNOWNS):
            share = system[b, a]
            if b != a:
                for e in range(LANES):
                    system[b, e] -= share * system[a, e]


@compiled
def _told(c, d, gram, system, offset, moved, size, gain, mean, noise, dot, covariance):
    """Return the covariance `[2, 2]` of a centre, and write the window's measurements to `dot [6]`, as for `FittedDots`."""
    stride, unit, missed = c.scales[d, 0], c.scales[d, 3], np.float32(0)
    for a in range(FIELDS):
        along = -gram[a, 7]
        for b in range(UNKNOWNS):
            along += gram[a, b] * system[b, 7]
        missed += along * (system[a, 7] if a < UNKNOWNS else -ONE)
    missed = max(missed, np.float32(0))
    spread = gram[7, 7] - gram[0, 7] ** 2 / max(gram[0, 0], ONE)
    dot[3] = 1 - missed / (max(spread, np.float32(0)) + 1e-6)
    background = (system[1, 7] * offset[0] + system[2, 7] * offset[1]) / c.scales[d, 2]
    dot[4] = -system[3, 7] / max(system[0, 7] - background + mean, 1e-2)
    grown = size + moved[2]
    dot[5] = min(np.log(grown / size) ** 2, np.log(grown / c.scales[d, 6]) ** 2) * c.numbers[2]
    variance = (noise / stride) ** 2 + c.numbers[1] * missed / max(gram[0, 0] - 7, 1.0)
    for a in range(2):
        for b in range(2):
            covariance[a, b] = variance * (gain / unit) ** 2 * system[4 + a, 8 + b]


def _entry(sources: str) -> Any:
    @kept
    def fits(c, level_0, level_1, level_2, centres, shapes, noise, steps, dots, covariance):
        """Fit all dots of all frames: arguments as of `EllipseFit.forward`, levels `[B, H, W]`; `dots [B, D, 6]`, the centre,
        growth, share explained, contrast and misfit, and `covariance [B, D, 2, 2]` are filled."""
        pixels, few = c.offsets.shape[1], np.empty((6, 5), np.float32)
        window, fields = np.zeros(pixels, np.float32), np.empty(FIELDS * pixels, np.float32)
        rows, gram, system = np.empty((4, 4), np.float32), np.empty((8, 8), np.float32), np.empty((7, LANES), np.float32)
        middle, offset, change, moved, before, reach = few[0], few[1], few[2], few[3], few[4], few[5]
        for b in range(len(centres) if sources else 0):
            for d in range(centres.shape[1]):
                image = level_0[b] if c.level[d] == 0 else level_1[b] if c.level[d] == 1 else level_2[b]
                centre, unit = centres[b, d], c.scales[d, 3]
                mean = _window(c, d, image, centre, window, middle)
                size = _to_circle(unit, c.scales[d, 2], shapes[b, d], rows)
                reach[0], reach[1], reach[2] = HALF * (size + unit), HALF * (size + unit), HALF * size
                change[:], moved[:], before[:], gain = 0, 0, 0, ONE
                for _ in range(steps):
                    for a in range(2):
                        offset[a] = (middle[a] - centre[a]) * unit - moved[a]
                    _outlined(c, d, rows, offset, moved[2], before, window, fields)
                    _products(fields, gram)
                    _fitted(c, d, gram, system)
                    gain = system[3, 7] / (system[3, 7] ** 2 + np.float32(1e-6))
                    for a in range(3):
                        after = change[a] + np.tanh(system[4 + a, 7] * gain / reach[a])
                        change[a] = min(max(after, -c.farthest[a]), c.farthest[a])
                        moved[a] = change[a] * reach[a]
                    before[4] = -gain / c.numbers[3]
                    for a in range(4):
                        before[a] = system[a, 7] * before[4]
                _told(c, d, gram, system, offset, moved, size, gain, mean, noise[b], dots[b, d], covariance[b, d])
                for a in range(3):
                    dots[b, d, a] = moved[a] / unit + (centre[a] if a < 2 else 0)

    return fits


SOURCES = fingerprint(__file__, vectors.__file__)
fits = _entry(SOURCES)
kept_fits = Kept(fits, SOURCES, 8)
"""Whether `fits` has been compiled."""


class NativeFit:
    """The fit of one pattern. Constants are looked up again after a move to another device."""

    def __init__(self) -> None:
        self._constants: tuple[Tensor, Constants] | None = None

    def __reduce__(self) -> tuple[Any, tuple[()]]:
        return type(self), ()

    def __call__(
        self, fit: Any, levels: list[Tensor], centre: Tensor, shape: Tensor, noise: Tensor, steps: int
    ) -> tuple[Tensor, ...]:
        """Return what `EllipseFit.forward` returns; same arguments, in single precision."""
        images = [level[:, 0].contiguous().numpy() for level in levels]
        given = [value.contiguous().numpy() for value in (centre, shape, noise)]
        dots, covariance = (
            centre.new_empty(*centre.shape[:2], 6),
            torch.empty_like(shape, memory_format=torch.contiguous_format),
        )
        constants = self._found(fit)

        def take(*part: np.ndarray) -> None:
            fits(constants, *part[:-2], steps, *part[-2:])

        with kept_fits.compiling(np.dtype(np.float32)):
            in_threads(take, *images, *given, dots.numpy(), covariance.numpy())
        return dots[..., :2], covariance, *dots[..., 2:].unbind(-1)

    def _found(self, fit: Any) -> Constants:
        if self._constants is None or self._constants[0] is not fit.ridge:
            self._constants = fit.ridge, _constants(fit)
        return self._constants[1]


def _constants(fit: Any) -> Constants:
    columns = fit.stride, fit.corner, fit.sharpness[:, None], fit.unit, fit.fall, fit.ring, fit.size[:, None]
    ones, offsets = fit.linear[:1], fit.linear[1:]
    wide = -offsets.shape[1] % LANES
    return Constants(
        level=fit.stride[:, 0].log2().round().long().numpy(),
        limit=fit.limit.float().numpy(),
        scales=torch.cat(columns, 1).numpy(),
        ridge=fit.ridge.numpy(),
        steps=offsets.long().contiguous().numpy(),
        offsets=F.pad(offsets, (0, wide)).numpy(),
        counts=F.pad(ones, (0, wide))[0].numpy(),
        farthest=fit.farthest[:, 0, 0].contiguous().numpy(),
        numbers=np.array([fit.half_width, MISFIT, fit.narrowness, FAINT], np.float32),
    )
