"""Dark blobs at the pattern's scales, in a batch of frames."""

from functools import reduce

import numpy as np
import torch
import torch.nn.functional as F
from torch import nn

from .bands import bands, blur_rows, halves, linear_rows
from .pyramid import LEVELS

FINEST_SIGMA = 0.9  # of the blob detector on a level of the pyramid, pixels of the level
SCALE_STEP = 1.6  # ratio of neighbouring scales of the blob detector at most


class BlobDetector(nn.Module):
    """The strongest `count` dark blobs: maxima over place and scale of the normalised Hessian's determinant.

    Only the box that holds the membrane is looked at. A Gaussian over it is two products with constant band matrices, on
    the level of the pyramid that suits the scale; maxima are looked for on cells of 2 x 2 pixels of the finest of them.
    """

    def __init__(self, radii, pitch, count, inside):
        super().__init__()
        smallest, largest = np.percentile(radii, [5, 95])
        steps = np.log(max(largest / smallest, 1.001)) / np.log(SCALE_STEP)
        radii = np.geomspace(smallest, largest, 1 + int(np.ceil(steps)))
        levels = np.log2(np.maximum(radii / (FINEST_SIGMA * np.sqrt(2)), 1)).astype(int).clip(0, LEVELS - 1)
        self.scales = [(int(k), float(r / np.sqrt(2) / 2**k)) for k, r in zip(levels, radii, strict=True)]
        self.cell = 2 ** (int(levels[0]) + 1)
        self.reach, self.count = max(1, int(0.25 * pitch / self.cell)), count
        block, sides = max(self.cell, 2 ** (LEVELS - 1)), inside.shape[-2:]
        lit = [np.flatnonzero(inside[0, 0].numpy().any(1 - axis)) for axis in (0, 1)]
        self.box = [
            (int(on[0]) // block * block, min(-(-(int(on[-1]) + 1) // block), side // block) * block)
            for on, side in zip(lit, sides, strict=True)
        ]
        (v0, v1), (u0, u1) = self.box
        self.parts = {}
        self.register_buffer("log_radii", torch.as_tensor(np.log(radii)))
        self.register_buffer("inside", (F.avg_pool2d(inside[..., v0:v1, u0:u1], self.cell) > 0.5).double())
        for axis, ((begin, end), side) in enumerate(zip(self.box, sides, strict=True)):
            cells = (np.arange(begin, end, self.cell) + (self.cell - 1) / 2) / 2 ** (LEVELS - 1)
            for i, (k, sigma) in enumerate(self.scales):
                rows = np.arange(begin // 2**k - 1, end // 2**k + 1)
                blocks, columns = bands(blur_rows(side // 2**k, sigma, rows))
                self.register_buffer(f"blur{i}_{'vu'[axis]}", torch.as_tensor(blocks))
                self.register_buffer(f"seen{i}_{'vu'[axis]}", torch.as_tensor(columns))
                if 2**k > self.cell:
                    places = (np.arange(begin, end, self.cell) + (self.cell - 1) / 2 - (2**k - 1) / 2) / 2**k
                    self._matrix(f"spread{i}", axis, linear_rows(len(rows) - 2, places - begin // 2**k))
            coarse = side // 2 ** (LEVELS - 1)
            places = (cells - (2 ** (LEVELS - 1) - 1) / 2**LEVELS - 0.5) / 2
            smooth = blur_rows(coarse // 2, 2.0, np.arange(coarse // 2)) @ halves(coarse)
            self._matrix("background", axis, linear_rows(coarse // 2, places) @ smooth)

    def _matrix(self, name, axis, matrix):
        """Keep `matrix` for `apply`, without the columns of pixels that it does not look at."""
        used = np.flatnonzero(matrix.any(0))
        part = slice(int(used[0]), int(used[-1]) + 1)
        self.parts.setdefault(name, [])[axis:] = [part]
        matrix = matrix[:, part] if axis == 0 else matrix[:, part].T
        self.register_buffer(f"{name}_{'vu'[axis]}", torch.as_tensor(matrix.copy()))

    def apply(self, name, image):
        v, u = self.parts[name]
        return getattr(self, f"{name}_v") @ image[..., v, u] @ getattr(self, f"{name}_u")

    def response(self, levels, i):
        """`sigma^4 det Hessian` where the image is darkest, else 0, `[B, 1, rows, columns]` of the cells."""
        (k, sigma), blurred = self.scales[i], levels[self.scales[i][0]]
        for axis in "vu":
            seen = getattr(self, f"seen{i}_{axis}")
            blocks = blurred.index_select(-2, seen.flatten()).unflatten(-2, seen.shape)
            blurred = (getattr(self, f"blur{i}_{axis}") @ blocks).flatten(-3, -2).mT
        rows, columns = ((end - begin) // 2**k for begin, end in self.box)
        above, middle, below = (blurred[..., n : n + rows, :] for n in range(3))
        left, centre, right = (slice(n, n + columns) for n in range(3))
        uu = middle[..., right] + middle[..., left] - 2 * middle[..., centre]
        vv = (below + above - 2 * middle)[..., centre]
        along = below - above
        uv = along[..., right] - along[..., left]
        response = (uu.relu() * vv.relu() - uv * uv / 16).relu()  # uu and vv have one sign where the determinant is positive
        if 2**k > self.cell:
            response = self.apply(f"spread{i}", response)
        return sigma**4 * (F.max_pool2d(response, 2) if 2**k < self.cell else response)

    def forward(self, levels):
        """`levels` of `pyramid` with dark dots -> blobs `[B, K, 2]` px, log radius `[B, K]`, strength `[B, K]`."""
        background = self.apply("background", levels[-1]) + 0.05
        scales = [self.response(levels, i) for i in range(len(self.scales))]
        peak = reduce(torch.maximum, scales) / background.square() * self.inside
        reach = self.reach
        highest = F.max_pool2d(peak, (1, 2 * reach + 1), 1, (0, reach))
        highest = F.max_pool2d(highest, (2 * reach + 1, 1), 1, (reach, 0))
        strength, cell = (peak * (peak == highest)).flatten(1).topk(self.count)
        rows, columns = peak.shape[-2:]
        sides = torch.stack([cell - 1, cell + 1, cell - columns, cell + columns], -1).clamp(0, rows * columns - 1)
        beside = (
            peak.flatten(1).gather(1, sides.flatten(1)).unflatten(1, (-1, 2, 2)).clamp_min(1e-12).sqrt()
        )  # [B, K, uv, before or after]
        strength = strength.clamp_min(1e-20).sqrt()
        before, after = beside.unbind(-1)
        shift = 0.5 * (after - before) / (2 * strength[..., None] - after - before).clamp_min(1e-12)
        place = torch.stack([cell % columns, cell // columns], -1) + shift.clamp(-0.5, 0.5)
        scale = torch.cat(scales, 1).flatten(2).gather(2, cell[:, None].expand(-1, len(self.scales), -1)).square()
        log_radius = (scale * self.log_radii[:, None]).sum(1) / scale.sum(1).clamp_min(1e-20)
        (v0, _), (u0, _) = self.box
        place = place * self.cell + (self.cell - 1) / 2 + place.new_tensor([u0, v0])
        return place, log_radius, strength
