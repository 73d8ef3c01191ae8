"""Dots fitted to sub-pixel accuracy: a blurred ellipse on sloping background."""

import numpy as np
import torch
from torch import nn

from ..spacing import spacing
from .ellipse import SOFTNESS, half_axes, metric_of
from .pyramid import LEVELS

RING = 2.5  # widest ring of background around a dot in the fit, pixels of its level
FINEST = 2.0  # a dot's short half axis on its level of the pyramid is at least this, where it can be
RIDGE = [1e-3, 100.0, 100.0, 1e-3, 1e-3, 1e-3, 0.3]  # of the fit: background, its slope over the dot, depth, shift, growth


def solve_positive(system):
    """`x [n, ...]` with `matrix x = load` from `system = [matrix, load] [n, n + 1, ...]`: Gauss-Jordan without pivoting.

    The matrix must be positive definite; the batch comes last, so that each row is one long vector.
    """
    n = system.shape[0]
    unit = torch.eye(n, dtype=system.dtype, device=system.device).reshape(n, n, *(1,) * (system.ndim - 2))
    for i in range(n):
        column, rest = system.split([1, system.shape[1] - 1], 1)
        system = rest - (column - unit[:, i : i + 1]) * (rest[i : i + 1] / column[i : i + 1])
    return system[:, 0]


class EllipseFit(nn.Module):
    """Least-squares fit of a blurred ellipse on sloping background, `I = b_0 + b . y - a T(x - c)`, to every dot.

    Gauss-Newton steps on windows of the level of the pyramid that suits the dot's size, in pixels of that level; the first
    step sees a quarter of the pixels. What is dark outside the outline, a neighbour or the world beyond the rim, loses its
    weight.
    """

    def __init__(self, pixels, shapes, image_size, size_tolerance, steps=3):
        super().__init__()
        width, height = image_size
        long, short = half_axes(shapes).T
        level = np.floor(np.log2(np.maximum(short / FINEST, 1))).astype(int).clip(0, LEVELS - 1)
        stride = 2**level
        sizes = np.array([(height // 2**k, width // 2**k) for k in range(LEVELS)])
        gap = (0.85 * spacing(pixels)[0] - 2 * long) / stride
        ring = np.clip(0.7 * gap, 1.5, RING) * stride
        half = int(np.round(((long + ring) / stride).max()))
        half = min(half, (min(sizes[level].min(0)) - 1) // 2)
        step = np.arange(-half, half + 1)
        offset = np.stack(np.meshgrid(step, step)).reshape(2, -1)
        offset = offset[:, np.hypot(*offset) <= half + 0.5]
        sparse = (offset % 2 == 0).all(0)
        offset = offset[:, np.argsort(~sparse, kind="stable")]
        self.size_tolerance, self.half = size_tolerance, half
        self.counts = [int(sparse.sum())] + [len(sparse)] * (steps - 1)
        self.levels = [(int(k), torch.as_tensor(np.flatnonzero(level == k))) for k in np.unique(level)]
        order = np.concatenate([dots for _, dots in self.levels])
        self.register_buffer("order", torch.as_tensor(np.argsort(order)))
        u, v = offset.astype(float)
        self.register_buffer("linear", torch.as_tensor(np.stack([np.ones_like(u), u, v])))
        self.register_buffer("moments", torch.as_tensor(np.stack([u**0, u, v, u, u * u, u * v, v, u * v, v * v], -1)))
        for k, dots in self.levels:
            self.register_buffer(f"dots{k}", dots)
            self.register_buffer(f"step{k}", torch.as_tensor(offset[1] * sizes[k, 1] + offset[0]))
        self.register_buffer("pixel_steps", torch.as_tensor(np.stack([np.ones_like(level), sizes[level, 1]], -1)))
        self.register_buffer("limit", torch.as_tensor(sizes[level][:, ::-1].copy() - 1 - half))
        self.register_buffer("stride", torch.as_tensor(stride.astype(float)))
        self.register_buffer("ring", torch.as_tensor(ring / stride))
        self.register_buffer("size", torch.as_tensor(np.linalg.norm(shapes, axis=(1, 2)) / 2**0.5 / stride))
        self.register_buffer("sharpness", torch.as_tensor(np.sqrt(stride) / SOFTNESS))
        ridge = np.diag(RIDGE)[..., None] * np.ones(len(stride))
        ridge[1:3, 1:3] = RIDGE[1] * np.moveaxis(shapes @ shapes.swapaxes(1, 2) / stride[:, None, None] ** 2, 0, -1)
        ridge[4:] *= stride**2
        self.register_buffer("ridge", torch.as_tensor(np.concatenate([ridge, np.zeros((7, 1, len(stride)))], 1))[:, :, None])

    def windows(self, levels, centre):
        """Values `[B, D, P]` of the pixels of a disc about `centre [B, D, 2]`, and the disc's middle `[B, D, 2]` px.

        Near the image's border the disc stops where its last pixel meets the border.
        """
        stride = self.stride[:, None]
        middle = ((centre.detach() - (stride - 1) / 2) / stride).round().to(torch.int64)
        pixel = torch.minimum(middle.clamp_min(self.half), self.limit)  # of integers: also where the centre is NaN
        first, values = (pixel * self.pixel_steps).sum(-1, keepdim=True), []
        for k, _ in self.levels:
            index = first.index_select(1, getattr(self, f"dots{k}")) + getattr(self, f"step{k}")
            values.append(levels[k].flatten(1).gather(1, index.flatten(1)).unflatten(1, index.shape[1:]))
        values = values[0] if len(values) == 1 else torch.cat(values, 1)[:, self.order]
        return values, pixel * stride + (stride - 1) / 2

    def forward(self, levels, centre, shape):
        """`levels` of `pyramid` with dark dots, `centre [B, D, 2]`, `shape [B, D, 2, 2]` to begin with.

        Returns centre `[B, D, 2]`, growth of the outline `[B, D]` px, and quality `[B, D]` in 0..1, from the share of
        the window's variance explained, the contrast `a / b_0`, and the size against that of `shape` or at rest.
        """
        values, middle = self.windows(levels, centre)
        mean = values.mean(-1, keepdim=True)
        values = values - mean
        shape = shape / self.stride[:, None, None]
        size = torch.linalg.vector_norm(shape, dim=(-2, -1)) / 2**0.5
        far = size + 1 / self.stride
        reach = torch.stack([0.5 * far, 0.5 * far, 0.5 * size])  # of a step, in place and growth
        lowest, highest = torch.stack([-far, -far, -0.5 * size]), torch.stack([far, far, 0.8 * size])
        metric = metric_of(shape)
        start = ((middle - centre) / self.stride[:, None]).movedim(-1, 0)
        change, fit, gain = torch.zeros_like(reach), None, None  # of place and growth, [3, B, D]
        for k, count in enumerate(self.counts):
            off, linear, seen = start - change[:2], self.linear[:, :count], values[..., :count]
            normal = torch.cat([(metric * off).sum(1, keepdim=True), metric], 1).movedim(1, -1)
            n_u, n_v = (rows @ linear for rows in normal)
            off_u, off_v, growth = torch.cat([off, change[2:]]).movedim(0, -1).split(1, -1)
            square = (linear[1] + off_u) * n_u + (linear[2] + off_v) * n_v + 1e-12
            slack = 1 / (n_u * n_u + n_v * n_v + 1e-12).sqrt()
            depth = (square.sqrt() - square) * slack + growth  # inside the outline
            template = torch.sigmoid(depth * self.sharpness[:, None])
            outside = 1 - template
            edge = template * outside * self.sharpness[:, None]
            weight = torch.sigmoid(2 * (depth + self.ring[:, None]))
            if k > 0:
                intruder = fit[:3].movedim(0, -1) @ linear + fit[3][..., None] * template - seen
                intruder = (intruder * (-gain / 0.35)[..., None]).clamp(0, 10)
                intruder = intruder * intruder
                weight = weight / (1 + outside * (intruder * intruder))
            shift = edge * slack
            basis = torch.stack([template, shift * n_u, shift * n_v, edge, seen], -2)  # and 1, u, v
            weighed = basis * weight[..., None, :]
            plain, mixed, own = weight @ self.moments[:count], weighed @ linear.mT, weighed @ basis.mT
            gram = torch.cat([torch.cat([plain.unflatten(-1, (3, 3)), mixed.mT], -1), torch.cat([mixed, own], -1)], -2)
            gram = gram.movedim((-2, -1), (0, 1))
            fit = solve_positive(gram[:7] + self.ridge)  # [7, B, D]
            gain = fit[3] / (fit[3] * fit[3] + 1e-6)
            change = change + reach * torch.tanh(fit[4:] * gain / reach)
            change = torch.maximum(torch.minimum(change, highest), lowest)
        moved, growth, amplitude = change[:2].movedim(0, -1), change[2], -fit[3]
        miss = torch.cat([fit, -torch.ones_like(fit[:1])])
        spread = gram[7, 7] - gram[0, 7].square() / gram[0, 0].clamp_min(1)
        explained = 1 - ((gram * miss).sum(1) * miss).sum(0) / (spread.clamp_min(0) + 1e-6)
        background = (fit[1:3] * off).sum(0)
        contrast = amplitude / (fit[0] - background + mean[..., 0]).clamp_min(1e-2)
        quality = torch.sigmoid(12 * (explained - 0.6)) * torch.sigmoid(40 * (contrast - 0.12))
        grown = torch.minimum(*(torch.log((size + growth) / usual).square() for usual in (size, self.size)))
        quality = quality * torch.exp(-grown / (2 * self.size_tolerance) ** 2)
        return centre + self.stride[:, None] * moved, self.stride * growth, quality
