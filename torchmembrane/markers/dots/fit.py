"""Dots fitted to sub-pixel accuracy: a blurred ellipse on sloping background."""

from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor, nn

from ...solve.elimination import solve_positive
from ..spacing import spacing
from .ellipse import SOFTNESS, half_axes, metric_of, rms_half_axes
from .pyramid import LEVELS

RING = 2.5  # widest ring of background around a dot in the fit, pixels of its level
FINEST = 2.0  # a dot's short half axis on its level of the pyramid is at least this, where it can be
MISFIT = 0.02  # of the residual's variance, what differs from image to image besides noise: most of it is the model's, in all
RIDGE = [1e-3, 100.0, 100.0, 1e-3, 1e-3, 1e-3, 0.3]  # of the fit: background, its slope over the dot, depth, shift, growth


class Outline(NamedTuple):
    """The model's dot on the pixels of a window, each `[B, D, P]`, and its derivatives."""

    depth: Tensor  # of the pixel inside the outline, pixels of the level
    template: Tensor  # 1 inside, 0 outside
    by_u: Tensor  # of the template, by the centre
    by_v: Tensor
    by_growth: Tensor


class FittedDots(NamedTuple):
    """Of a batch: `centre [B, D, 2]` px, its `covariance [B, D, 2, 2]` px^2, `growth` of the outline `[B, D]` px, `quality
    [B, D]` in 0..1."""

    centre: Tensor
    covariance: Tensor
    growth: Tensor
    quality: Tensor


class EllipseFit(nn.Module):
    """Least-squares fit of a blurred ellipse on sloping background, `I = b_0 + b . y - a T(x - c)`, to every dot.

    Gauss-Newton steps on windows of the level of the pyramid that suits the dot's size, in pixels of that level; the first
    step sees a quarter of the pixels. What is dark outside the outline, a neighbour or the world beyond the rim, loses its
    weight.

    Args:
        pixels: centres `[D, 2]` in the rest image, px.
        shapes: `[D, 2, 2]` in the rest image, px.
        image_size: width, height.
        size_tolerance: standard deviation of a dot's log radius.
        steps: Gauss-Newton steps.

    Limitations:
        The centre moves by no more than the dot's half axis and a pixel from where the fit begins.
    """

    dot_to_row: Tensor
    linear: Tensor
    moments: Tensor
    pixel_steps: Tensor
    limit: Tensor
    stride: Tensor
    ring: Tensor
    size: Tensor
    sharpness: Tensor
    ridge: Tensor
    unit_loads: Tensor

    def __init__(
        self, pixels: np.ndarray, shapes: np.ndarray, image_size: tuple[int, int], size_tolerance: float, steps: int = 3
    ):
        super().__init__()
        width, height = image_size
        long, short = half_axes(shapes).T
        level = np.floor(np.log2(np.maximum(short / FINEST, 1))).astype(int).clip(0, LEVELS - 1)
        stride = 2**level
        sizes = np.array([(height // 2**k, width // 2**k) for k in range(LEVELS)])
        gap = (0.85 * spacing(pixels)[0] - 2 * long) / stride
        ring = np.clip(0.7 * gap, 1.5, RING) * stride
        half = int(np.round(((long + ring) / stride).max()))
        self.half_width = min(half, (min(sizes[level].min(0)) - 1) // 2)
        self.size_tolerance = size_tolerance
        offset, sparse = _disc(self.half_width)
        self.counts = [sparse] + [offset.shape[1]] * (steps - 1)
        self._register_levels(level, offset, sizes)
        self.register_buffer("limit", torch.as_tensor(sizes[level][:, ::-1].copy() - 1 - self.half_width))
        self.register_buffer("stride", torch.as_tensor(stride.astype(float)))
        self.register_buffer("ring", torch.as_tensor(ring / stride))
        self.register_buffer("size", torch.as_tensor(rms_half_axes(shapes) / stride))
        self.register_buffer("sharpness", torch.as_tensor(np.sqrt(stride) / SOFTNESS))
        ridge = np.diag(RIDGE)[..., None] * np.ones(len(stride))
        ridge[1:3, 1:3] = RIDGE[1] * np.moveaxis(shapes @ shapes.swapaxes(1, 2) / stride[:, None, None] ** 2, 0, -1)
        ridge[4:] *= stride**2
        self.register_buffer("unit_loads", torch.eye(7, dtype=torch.float64)[:, 4:6, None, None])
        self.register_buffer("ridge", torch.as_tensor(np.concatenate([ridge, np.zeros((7, 1, len(stride)))], 1))[:, :, None])

    def _register_levels(self, level: np.ndarray, offset: np.ndarray, sizes: np.ndarray) -> None:
        """Which dots are fitted on which level, and where in it the pixels of a window are."""
        self.levels = [int(k) for k in np.unique(level)]
        dots = [np.flatnonzero(level == k) for k in self.levels]
        self.register_buffer("dot_to_row", torch.as_tensor(np.argsort(np.concatenate(dots))))
        for k, on_level in zip(self.levels, dots, strict=True):
            self.register_buffer(f"dots{k}", torch.as_tensor(on_level))
            self.register_buffer(f"step{k}", torch.as_tensor(offset[1] * sizes[k, 1] + offset[0]))
        self.register_buffer("pixel_steps", torch.as_tensor(np.stack([np.ones_like(level), sizes[level, 1]], -1)))
        u, v = offset.astype(float)
        self.register_buffer("linear", torch.as_tensor(np.stack([np.ones_like(u), u, v])))
        self.register_buffer("moments", torch.as_tensor(np.stack([u**0, u, v, u, u * u, u * v, v, u * v, v * v], -1)))

    def windows(self, levels: list[Tensor], centre: Tensor) -> tuple[Tensor, Tensor]:
        """Values `[B, D, P]` of the pixels of a disc about `centre [B, D, 2]`, and the disc's middle `[B, D, 2]` px.

        Near the image's border the disc stops where its last pixel meets the border.
        """
        stride = self.stride[:, None]
        middle = ((centre.detach() - (stride - 1) / 2) / stride).round().to(torch.int64)
        pixel = torch.minimum(middle.clamp_min(self.half_width), self.limit)  # of integers: also where the centre is NaN
        first, parts = (pixel * self.pixel_steps).sum(-1, keepdim=True), []
        for k in self.levels:
            index = first.index_select(1, self.get_buffer(f"dots{k}")) + self.get_buffer(f"step{k}")
            parts.append(levels[k].flatten(1).gather(1, index.flatten(1)).unflatten(1, index.shape[1:]))
        values = parts[0] if len(parts) == 1 else torch.cat(parts, 1)[:, self.dot_to_row]
        return values, pixel * stride + (stride - 1) / 2

    def forward(self, levels: list[Tensor], centre: Tensor, shape: Tensor, noise: Tensor) -> FittedDots:
        """Fit every dot of a batch of frames.

        Args:
            levels: of `mean_pyramid`, dark dots.
            centre: `[B, D, 2]` to begin with, px.
            shape: `[B, D, 2, 2]`, px.
            noise: `[B]`, standard deviation of a pixel of the finest level.

        Returns:
            The dots; their quality comes from the share of the window's variance explained, the contrast `a / b_0`, and the
            size against that of `shape` or at rest.
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
        change = torch.zeros_like(reach)  # of place and growth, [3, B, D]
        fit: Tensor | None = None
        for count in self.counts:
            offset, window = start - change[:2], values[..., :count]
            outline = self._outline(offset, change[2:], metric, count)
            weight = torch.sigmoid(2 * (outline.depth + self.ring[:, None]))
            if fit is not None:
                weight = weight / self._intrusion(fit, outline.template, window)
            gram = self._gram(outline, window, weight)
            fit = solve_positive(gram[:7] + self.ridge)[:, 0]  # [7, B, D]
            change = change + reach * torch.tanh(fit[4:] * _gain(fit) / reach)
            change = torch.maximum(torch.minimum(change, highest), lowest)
        moved, growth = change[:2].movedim(0, -1), change[2]
        assert fit is not None
        missed = _missed(gram, fit)
        quality = self._quality(gram, fit, missed, offset, mean[..., 0])
        grown = torch.minimum(*(torch.log((size + growth) / usual).square() for usual in (size, self.size)))
        quality = quality * torch.exp(-grown / (2 * self.size_tolerance) ** 2)
        centre = centre + self.stride[:, None] * moved
        return FittedDots(centre, self._covariance(gram, fit, missed, noise), self.stride * growth, quality)

    def _outline(self, offset: Tensor, growth: Tensor, metric: Tensor, count: int) -> Outline:
        """The model's dot on the first `count` pixels of the window, its middle at `offset [2, B, D]` from the centre."""
        linear = self.linear[:, :count]
        normal = torch.cat([(metric * offset).sum(1, keepdim=True), metric], 1).movedim(1, -1)
        n_u, n_v = (rows @ linear for rows in normal)
        off_u, off_v, growth = torch.cat([offset, growth]).movedim(0, -1).split(1, -1)
        square = (linear[1] + off_u) * n_u + (linear[2] + off_v) * n_v + 1e-12
        slack = 1 / (n_u * n_u + n_v * n_v + 1e-12).sqrt()
        depth = (square.sqrt() - square) * slack + growth
        template = torch.sigmoid(depth * self.sharpness[:, None])
        edge = template * (1 - template) * self.sharpness[:, None]
        shift = edge * slack
        return Outline(depth, template, shift * n_u, shift * n_v, edge)

    def _intrusion(self, fit: Tensor, template: Tensor, window: Tensor) -> Tensor:
        """By what `[B, D, P]` the weight of a pixel is divided that is darker than the fit before and outside the outline."""
        intruder = fit[:3].movedim(0, -1) @ self.linear[:, : window.shape[-1]] + fit[3][..., None] * template - window
        intruder = (intruder * (-_gain(fit) / 0.35)[..., None]).clamp(0, 10)
        intruder = intruder * intruder
        return 1 + (1 - template) * (intruder * intruder)

    def _gram(self, outline: Outline, window: Tensor, weight: Tensor) -> Tensor:
        """Weighted products `[8, 8, B, D]` of 1, u, v, the template, its derivatives, and last the window itself."""
        linear = self.linear[:, : window.shape[-1]]
        basis = torch.stack([outline.template, outline.by_u, outline.by_v, outline.by_growth, window], -2)
        weighed = basis * weight[..., None, :]
        plain, mixed, own = weight @ self.moments[: window.shape[-1]], weighed @ linear.mT, weighed @ basis.mT
        gram = torch.cat([torch.cat([plain.unflatten(-1, (3, 3)), mixed.mT], -1), torch.cat([mixed, own], -1)], -2)
        return gram.movedim((-2, -1), (0, 1))

    def _covariance(self, gram: Tensor, fit: Tensor, missed: Tensor, noise: Tensor) -> Tensor:
        """Of the centres, `[B, D, 2, 2]` px^2: the variance of the pixels through the normal equations."""
        loads = self.unit_loads.expand(-1, -1, *gram.shape[2:])
        inverse = solve_positive(torch.cat([gram[:7, :7] + self.ridge[:, :7], loads], 1))[4:6]
        variance = (noise[:, None] / self.stride).square() + MISFIT * missed / (gram[0, 0] - 7).clamp_min(1)
        return (variance * (self.stride * _gain(fit)).square() * inverse).movedim((0, 1), (-2, -1))

    def _quality(self, gram: Tensor, fit: Tensor, missed: Tensor, offset: Tensor, mean: Tensor) -> Tensor:
        """How well the model explains the window, times whether the dot stands out: `[B, D]` in 0..1."""
        spread = gram[7, 7] - gram[0, 7].square() / gram[0, 0].clamp_min(1)
        explained = 1 - missed / (spread.clamp_min(0) + 1e-6)
        background = (fit[1:3] * offset).sum(0)
        contrast = -fit[3] / (fit[0] - background + mean).clamp_min(1e-2)
        return torch.sigmoid(12 * (explained - 0.6)) * torch.sigmoid(40 * (contrast - 0.12))


def _missed(gram: Tensor, fit: Tensor) -> Tensor:
    """Weighted sum of the squared residuals `[B, D]`."""
    miss = torch.cat([fit, -torch.ones_like(fit[:1])])
    return ((gram * miss).sum(1) * miss).sum(0).clamp_min(0)


def _gain(fit: Tensor) -> Tensor:
    """One over the amplitude of `fit [7, B, D]`, finite where that vanishes: `[B, D]`."""
    return fit[3] / (fit[3] * fit[3] + 1e-6)


def _disc(half: int) -> tuple[np.ndarray, int]:
    """Integer offsets `[2, P]` within `half` of 0, every other of every other row first; and how many those are."""
    step = np.arange(-half, half + 1)
    offset = np.stack(np.meshgrid(step, step)).reshape(2, -1)
    offset = offset[:, np.hypot(*offset) <= half + 0.5]
    sparse = (offset % 2 == 0).all(0)
    return offset[:, np.argsort(~sparse, kind="stable")], int(sparse.sum())
