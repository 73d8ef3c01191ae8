"""Detection of dark blobs at the pattern's scales, in a batch of frames."""

from functools import reduce

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from ..native_frames import Constants, found_by, is_native
from .bands import BandProduct, SeparableMap, blur_rows, linear_rows, pair_means
from .native_blobs import peak_constants, peaks, responses, scale_constants
from .pyramid import LEVELS
from .scales import PREDICTION, SHADE

FINEST_SIGMA = 0.9  # smallest sigma of the blob detector on a pyramid level, pixels of the level
SCALE_STEP = 1.6  # largest ratio of neighbouring scales of the blob detector

Span = tuple[int, int]


class HessianScale(nn.Module):
    """Computes the normalised Hessian's determinant at one scale, on the cells of a box.

    The Gaussian filter is a product with a constant band matrix along each axis, on the pyramid level that suits the scale.
    """

    def __init__(self, level: int, sigma: float, cell: int, box: tuple[Span, Span], size: tuple[int, int]):
        """`sigma`: pixels of the level; `cell`, `box` (v, u) and `size` (height, width): pixels of the image."""
        super().__init__()
        self.level, self.cell = level, cell
        stride = 2**level
        self.rows, self.columns = ((end - begin) // stride for begin, end in box)
        rows = [np.arange(begin // stride - 1, end // stride + 1) for begin, end in box]
        self.blur_v, self.blur_u = (
            BandProduct(sigma * blur_rows(side // stride, sigma, on)) for on, side in zip(rows, size, strict=True)
        )
        self.spread, self.native = None, Constants(scale_constants)
        if stride > cell:
            at = [(_cells(span, cell) - (stride - 1) / 2) / stride - span[0] // stride for span in box]
            self.cells = [x.clip(0, len(on) - 3) for on, x in zip(rows, at, strict=True)]
            self.spread = SeparableMap(*(linear_rows(len(on) - 2, x) for on, x in zip(rows, at, strict=True)))

    def forward(self, levels: list[Tensor]) -> Tensor:
        """Return `sigma^4 det Hessian` of the cells where the image is a dark maximum, else 0, `[B, 1, rows, columns]`."""
        level = levels[self.level]
        if is_native(level, self.blur_v.blocks):
            fine = max(1, self.cell // 2**self.level), max(1, 2**self.level // self.cell)
            shape = (side // fine[0] * fine[1] for side in (self.rows, self.columns))
            return found_by(responses, self.native.of(self, self.blur_v.blocks), (level[:, 0],), *shape)[:, None]
        blurred = self.blur_u(self.blur_v(level))
        above, middle, below = (blurred[..., n : n + self.rows, :] for n in range(3))
        left, centre, right = (slice(n, n + self.columns) for n in range(3))
        uu = (middle[..., right] + middle[..., left]).sub(middle[..., centre], alpha=2)
        vv = (below + above)[..., centre].sub(middle[..., centre], alpha=2)
        along = below - above
        uv = along[..., right] - along[..., left]
        response = (uu.relu() * vv).addcmul(uv, uv, value=-1 / 16).relu()  # where it is positive, uu and vv have one sign
        if self.spread is not None:
            response = self.spread(response)
        return pair_maxima(response) if 2**self.level < self.cell else response


class BlobDetector(nn.Module):
    """Finds the strongest dark blobs: maxima of the normalised Hessian's determinant over position and scale.

    Only the box that contains the membrane is searched. Maxima are searched on cells of at least 2 x 2 pixels of the finest
    level in use, of up to `PREDICTION` times the pitch, and interpolated by a parabola.

    Args:
        radii: radii of the pattern's dots, `[D]`, px; their 5th to 95th percentiles span the scales.
        pitch: smallest distance between two dots, px.
        count: number of blobs to return.
        inside: 1 on the membrane, else 0, `[1, 1, H, W]`.

    Limitations:
        Two blobs closer than `PREDICTION` times `pitch` are found as one. If there are fewer than `count` blobs, others of a
        strength of about 0 complete the list.
    """

    sides: Tensor
    corner: Tensor
    log_radii: Tensor
    inside: Tensor

    def __init__(self, radii: np.ndarray, pitch: float, count: int, inside: Tensor):
        super().__init__()
        smallest, largest = np.percentile(radii, [5, 95])
        steps = np.log(max(largest / smallest, 1.001)) / np.log(SCALE_STEP)
        radii = np.geomspace(smallest, largest, 1 + int(np.ceil(steps)))
        levels = np.log2(np.maximum(radii / (FINEST_SIGMA * np.sqrt(2)), 1)).astype(int).clip(0, LEVELS - 1)
        height, width = inside.shape[-2:]
        self.cell = min(2 ** (int(levels[0]) + 1), 2 ** max(0, int(np.log2(PREDICTION * pitch))))
        self.reach, self.count = max(1, int(PREDICTION * pitch / self.cell)), count
        block = max(self.cell, 2 ** (LEVELS - 1))
        lit = inside[0, 0].numpy() > 0
        self.box = _span(np.any(lit, 1), block), _span(np.any(lit, 0), block)
        (v0, v1), (u0, u1) = self.box
        columns = (u1 - u0) // self.cell
        self.register_buffer("sides", torch.tensor([-1, 1, -columns, columns]))
        self.register_buffer("corner", torch.tensor([u0, v0], dtype=torch.float64) + (self.cell - 1) / 2)
        self.register_buffer("log_radii", torch.as_tensor(np.log(radii)))
        self.register_buffer("inside", (F.avg_pool2d(inside[..., v0:v1, u0:u1], self.cell) > 0.5).double())
        self.scales = nn.ModuleList(
            HessianScale(int(k), float(r / np.sqrt(2) / 2**k), self.cell, self.box, (height, width))
            for k, r in zip(levels, radii, strict=True)
        )
        self.native = Constants(peak_constants)
        self.background = SeparableMap(
            *(_background_rows(_cells(span, self.cell), side) for span, side in zip(self.box, (height, width), strict=True))
        )

    def forward(self, levels: list[Tensor]) -> tuple[Tensor, Tensor, Tensor]:
        """Locate blobs in `levels` of `mean_pyramid` with dark dots: centres `[B, K, 2]` px, log radius, strength `[B, K]`."""
        scales = [scale(levels) for scale in self.scales]
        if is_native(*scales, levels[-1], self.inside):
            given = torch.cat(scales, 1), levels[-1][:, 0]
            found = found_by(peaks, self.native.of(self, self.inside), given, self.count, 4)
            return found[..., :2], found[..., 2], found[..., 3]
        background = self.background(levels[-1]) + SHADE
        peak = reduce(torch.maximum, scales) / background.square() * self.inside
        strength, cell = (peak * (peak == highest_around(peak, self.reach))).flatten(1).topk(self.count)
        strength = strength.clamp_min(1e-20).sqrt()
        scale = torch.cat(scales, 1).flatten(2).gather(2, cell[:, None].expand(-1, len(scales), -1)).square()
        log_radius = (scale * self.log_radii[:, None]).sum(1) / scale.sum(1).clamp_min(1e-20)
        return self._centre(peak, cell, strength), log_radius, strength

    def _centre(self, peak: Tensor, cell: Tensor, strength: Tensor) -> Tensor:
        """Return the centres `[B, K, 2]` px of the maxima at `cell [B, K]`, by a parabola through the neighbouring cells."""
        rows, columns = peak.shape[-2:]
        sides = (cell[..., None] + self.sides).clamp(0, rows * columns - 1)
        beside = peak.flatten(1).gather(1, sides.flatten(1)).unflatten(1, (-1, 2, 2))  # [B, K, uv, before or after]
        before, after = beside.clamp_min(1e-12).sqrt().unbind(-1)
        shift = 0.5 * (after - before) / (2 * strength[..., None] - after - before).clamp_min(1e-12)
        centre = torch.stack([cell % columns, cell // columns], -1) + shift.clamp(-0.5, 0.5)
        return centre * self.cell + self.corner


def highest_around(field: Tensor, reach: int) -> Tensor:
    """Return the largest value within `reach` rows and columns of every entry of `field [..., H, W]`, which is not negative.

    Example:
        >>> highest_around(torch.tensor([[0.0, 1.0, 0.0, 5.0, 4.0]]), 1).tolist()
        [[1.0, 1.0, 5.0, 5.0, 5.0]]
    """
    if torch.compiler.is_exporting():
        return F.max_pool2d(field, 2 * reach + 1, 1, reach)
    field = F.pad(field, (reach,) * 4)
    for dim in (-2, -1):
        size = field.shape[dim] - 2 * reach
        field = reduce(torch.maximum, (field.narrow(dim, k, size) for k in range(2 * reach + 1)))
    return field


def pair_maxima(field: Tensor) -> Tensor:
    """Return the maximum of every 2 x 2 block of `field [..., H, W]`, whose sides are even.

    Example:
        >>> pair_maxima(torch.tensor([[1.0, 0.0, 0.0, 2.0], [0.0, 3.0, 0.0, 0.0]])).tolist()
        [[3.0, 2.0]]
    """
    if torch.compiler.is_exporting():
        return F.max_pool2d(field, 2)
    field = torch.maximum(field[..., 0::2], field[..., 1::2])
    return torch.maximum(field[..., 0::2, :], field[..., 1::2, :])


def _span(lit: np.ndarray, block: int) -> Span:
    """Return the first pixel and the end, in whole blocks, of the range that contains all of `lit`."""
    on = np.flatnonzero(lit)
    return int(on[0]) // block * block, min(-(-(int(on[-1]) + 1) // block), len(lit) // block) * block


def _cells(span: Span, cell: int) -> np.ndarray:
    """Return the centres of the cells of a span, px."""
    return np.arange(*span, cell) + (cell - 1) / 2


def _background_rows(centres: np.ndarray, side: int) -> np.ndarray:
    """Return the weights that map a row of `side` pixels on the coarsest level to its means over about 8 pixels of the level,
    at `centres` px."""
    coarse = side // 2 ** (LEVELS - 1)
    at = (centres / 2 ** (LEVELS - 1) - (2 ** (LEVELS - 1) - 1) / 2**LEVELS - 0.5) / 2
    smooth = blur_rows(coarse // 2, 2.0, np.arange(coarse // 2)) @ pair_means(coarse)
    return linear_rows(coarse // 2, at) @ smooth
