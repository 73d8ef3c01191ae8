"""Fit of dots to sub-pixel accuracy: a blurred ellipse on a sloping background."""

from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor, nn

from ...machine_code import takes
from ...solve.elimination import solve_dense
from ..spacing import spacing
from .ellipse import SOFTNESS, half_axes, rms_half_axes
from .native_fit import MISFIT, NativeFit
from .pyramid import LEVELS
from .scales import FAINT

RING = 2.5  # largest width of the ring of background around a dot, pixels of its level
FINEST = 2.0  # smallest short half axis of a dot on its pyramid level, if there is such a level, pixels
SLOPE, GROWTH = 100.0, 0.3  # ridges of the fit, for the slope of the background and the growth of the dot


class Outline(NamedTuple):
    """The model of a dot at the pixels of a window, each `[..., P]`; lengths are relative to the softness of its outline."""

    depth: Tensor  # of the pixel inside the outline
    template: Tensor  # 1 inside, 0 outside
    edge: Tensor  # the template's derivative in growth
    normal: Tensor  # `[2, ..., P]`, outwards; the template's derivative in the centre is `edge normal / length`
    length: Tensor


class FittedDots(NamedTuple):
    """Fitted dots of a batch.

    Attributes:
        centre: centres, `[B, D, 2]`, px.
        covariance: covariance of the centres, `[B, D, 2, 2]`, px^2.
        growth: growth of the outline, `[B, D]`, px.
        explained: share of the window's variance that the model explains, `[B, D]`, at most 1.
        contrast: contrast with the background, `[B, D]`.
        misfit: misfit of the size, `[B, D]`, squared standard deviations.
    """

    centre: Tensor
    covariance: Tensor
    growth: Tensor
    explained: Tensor
    contrast: Tensor
    misfit: Tensor


class EllipseFit(nn.Module):
    """Least-squares fit of a blurred ellipse on a sloping background, `I = b_0 + b . y - a T(x - c)`, to every dot.

    It takes Gauss-Newton steps on windows of the pyramid level that suits the dot's size. Dark pixels outside the outline, such
    as a neighbour or objects beyond the rim, are down-weighted. Pixel offsets are in pixels of that level; position, size and
    growth of a dot are in units of the softness of its outline.

    Args:
        pixels: centres in the rest image, `[D, 2]`, px.
        shapes: shapes in the rest image, `[D, 2, 2]`, px.
        image_size: width, height.
        size_tolerance: standard deviation of a dot's log radius.

    Limitations:
        The centre moves by at most the dot's half axis plus one pixel from its start.
    """

    dot_to_row: Tensor
    linear: Tensor
    pixel_steps: Tensor
    limit: Tensor
    stride: Tensor
    corner: Tensor
    sharpness: Tensor
    unit: Tensor
    fall: Tensor
    ring: Tensor
    size: Tensor
    ridge: Tensor
    unit_loads: Tensor
    least: Tensor
    farthest: Tensor

    def __init__(self, pixels: np.ndarray, shapes: np.ndarray, image_size: tuple[int, int], size_tolerance: float):
        super().__init__()
        width, height = image_size
        long, short = half_axes(shapes).T
        level = np.floor(np.log2(np.maximum(short / FINEST, 1))).astype(int).clip(0, LEVELS - 1)
        stride = 2**level
        sizes = np.array([(height // 2**k, width // 2**k) for k in range(LEVELS)])
        gap = (spacing(pixels)[0] - 2 * long) / stride
        ring = np.clip(gap / 2, 1, RING) * stride
        half = int(np.round(((long + ring) / stride).max()))
        self.native = NativeFit()
        self.half_width = min(half, (min(sizes[level].min(0)) - 1) // 2)
        self.narrowness = size_tolerance**-2.0
        self._register_levels(level, _disc(self.half_width), sizes)
        sharpness = np.sqrt(stride) / SOFTNESS
        unit = sharpness / stride
        self.register_buffer("limit", torch.as_tensor(sizes[level][:, ::-1].copy() - 1 - self.half_width))
        self.register_buffer("stride", torch.as_tensor(stride.astype(float))[:, None])
        self.register_buffer("corner", torch.as_tensor((stride - 1) / 2)[:, None])
        self.register_buffer("sharpness", torch.as_tensor(sharpness))
        self.register_buffer("unit", torch.as_tensor(unit)[:, None])
        self.register_buffer("fall", torch.as_tensor(2 / sharpness)[:, None])
        self.register_buffer("ring", torch.as_tensor(2 * ring / stride)[:, None])
        self.register_buffer("size", torch.as_tensor(rms_half_axes(shapes) * unit))
        ridge = np.ones((len(stride), 1, 1)) * np.diag([*6 * [1e-3], GROWTH])
        ridge[:, 1:3, 1:3] = SLOPE * shapes @ shapes.swapaxes(1, 2) / stride[:, None, None] ** 2
        ridge[:, 4:] /= unit[:, None, None] ** 2
        self.register_buffer("ridge", torch.as_tensor(ridge))
        self.register_buffer("unit_loads", torch.eye(7, dtype=torch.float64)[:, 4:6])
        self.register_buffer("least", torch.tensor(1e-12, dtype=torch.float64))
        self.register_buffer("farthest", torch.tensor([2.0, 2.0, 1.0])[:, None, None])

    def _register_levels(self, level: np.ndarray, offset: np.ndarray, sizes: np.ndarray) -> None:
        """Register on which level each dot is fitted, and the positions of the pixels of its window on that level."""
        self.levels = [int(k) for k in np.unique(level)]
        dots = [np.flatnonzero(level == k) for k in self.levels]
        self.register_buffer("dot_to_row", torch.as_tensor(np.argsort(np.concatenate(dots))))
        for k, on_level in zip(self.levels, dots, strict=True):
            self.register_buffer(f"dots{k}", torch.as_tensor(on_level))
            self.register_buffer(f"step{k}", torch.as_tensor(offset[1] * sizes[k, 1] + offset[0]))
        self.register_buffer("pixel_steps", torch.as_tensor(np.stack([np.ones_like(level), sizes[level, 1]], -1)))
        u, v = offset.astype(float)
        self.register_buffer("linear", torch.as_tensor(np.stack([np.ones_like(u), u, v])))

    def windows(self, levels: list[Tensor], centre: Tensor) -> tuple[Tensor, Tensor]:
        """Return the values `[B, D, P]` of the pixels of a disc around `centre [B, D, 2]`, and the middle of the disc `[B, D,
        2]` px.

        Near the image's border the disc stops where its last pixel meets the border.
        """
        middle = ((centre.detach() - self.corner) / self.stride).round().to(torch.int64)
        pixel = torch.minimum(middle.clamp_min(self.half_width), self.limit)  # of integers: also where the centre is NaN
        first, parts = (pixel * self.pixel_steps).sum(-1, keepdim=True), []
        for k in self.levels:
            index = first.index_select(1, self.get_buffer(f"dots{k}")) + self.get_buffer(f"step{k}")
            parts.append(levels[k].flatten(1).gather(1, index.flatten(1)).unflatten(1, index.shape[1:]))
        values = parts[0] if len(parts) == 1 else torch.cat(parts, 1)[:, self.dot_to_row]
        return values.to(centre), pixel * self.stride + self.corner

    def forward(self, levels: list[Tensor], centre: Tensor, shape: Tensor, noise: Tensor, steps: int) -> FittedDots:
        """Fit every dot of a batch of frames.

        Args:
            levels: levels of `mean_pyramid`, with dark dots.
            centre: initial centres, `[B, D, 2]`, px.
            shape: initial shapes, `[B, D, 2, 2]`, px.
            noise: standard deviation of a pixel of the finest level, `[B]`.
            steps: number of Gauss-Newton steps.

        Returns:
            The dots; the misfit of their size is the smaller of those relative to `shape` and to the shape at rest.
        """
        centre, shape, noise = (value.to(self.size) for value in (centre, shape, noise))
        if self.size.dtype == torch.float32 and takes(*levels, centre, shape, noise):
            return FittedDots(*self.native(self, levels, centre, shape, noise, steps))
        values, middle = self.windows(levels, centre)
        mean = values.mean(-1, keepdim=True)
        window = values - mean
        to_circle, size = self._to_circle(shape)
        far = size + self.unit[:, 0]
        reach = 0.5 * torch.stack([far, far, size])  # of a step, in place and growth
        start = ((middle - centre) * self.unit).movedim(-1, 0)
        change = moved = torch.zeros_like(reach)  # of place and growth, [3, B, D]; the change over its reach
        before: tuple[Tensor, Tensor] | None = None
        for _ in range(steps):
            offset = start - moved[:2]
            outline = self._outline(offset, moved[2], to_circle)
            weight = torch.sigmoid(outline.depth * self.fall + self.ring)
            if before is not None:
                weight = weight / self._intrusion(*before, outline.template, window)
            gram = self._gram(outline, window, weight)
            loads = torch.cat([gram[..., :7, 7:], self.unit_loads.expand(*gram.shape[:2], -1, -1)], -1)
            solved = solve_dense(gram[..., :7, :7] + self.ridge, loads)
            fit = solved[..., 0].movedim(-1, 0)  # [7, B, D]
            gain = fit[3] / (fit[3] * fit[3] + 1e-6)  # one over the amplitude, finite where that vanishes
            change = (change + torch.tanh(fit[4:] * gain / reach)).clamp(-self.farthest, self.farthest)
            moved, before = change * reach, (fit, gain)
        missed = _missed(gram, solved[..., :1])
        explained, contrast = self._seen(gram, fit, missed, offset / self.sharpness, mean[..., 0])
        grown = size + moved[2]
        misfit = torch.minimum((grown / size).log().square(), (grown / self.size).log().square())
        scale = (gain[..., None] / self.unit).square()[..., None]
        variance = (noise[:, None, None] / self.stride).square()[..., 0] + MISFIT * missed / (gram[..., 0, 0] - 7).clamp_min(1)
        covariance = (variance[..., None, None] * scale) * solved[..., 4:6, 1:]
        moved = moved.movedim(0, -1) / self.unit
        return FittedDots(centre + moved[..., :2], covariance, moved[..., 2], explained, contrast, misfit * self.narrowness)

    def _to_circle(self, shape: Tensor) -> tuple[Tensor, Tensor]:
        """Return the matrices `[4, 4, B, D]` that map an offset, and one in pixels of the level, to the unit circle and to the
        outline's normal, and the dot's size `[B, D]`."""
        entries = shape.flatten(-2) * self.unit
        a, b, c, d = entries.unbind(-1)
        inverse = torch.stack([d, -b, -c, a]).unflatten(0, (2, 2)) / (a * d - b * c)
        metric = (inverse[:, :, None] * inverse[:, None]).sum(0)
        both = torch.cat([inverse, metric])
        return torch.cat([both, both * self.sharpness], 1), (0.5 * entries.square().sum(-1)).sqrt()

    def _outline(self, offset: Tensor, growth: Tensor, to_circle: Tensor) -> Outline:
        """Return the model of the dot at the window's pixels, with the middle of the window at `offset [2, B, D]` from the
        centre."""
        at_middle, to_circle = (to_circle[:, :2] * offset).sum(1, keepdim=True), to_circle[:, 2:]
        rows = (torch.cat([at_middle, to_circle], 1).movedim(1, -1) @ self.linear).unflatten(0, (2, 2))
        u, v = rows.unbind(1)
        (radius, length), normal = self.least.addcmul(u, u).addcmul(v, v).sqrt(), rows[1]
        depth = torch.addcdiv(growth[..., None], radius.addcmul(radius, radius, value=-1), length)
        template = torch.sigmoid(depth)
        return Outline(depth, template, template.addcmul(template, template, value=-1), normal, length)

    def _intrusion(self, fit: Tensor, gain: Tensor, template: Tensor, window: Tensor) -> Tensor:
        """Return the divisors `[B, D, P]` of the weights of pixels that are darker than the previous fit and outside the
        outline: 2 if darker by `FAINT` times the dot's amplitude."""
        gain = gain / -FAINT
        scaled = (fit[:4] * gain).movedim(0, -1)
        darker = (scaled[..., :3] @ self.linear).addcmul(scaled[..., 3:], template)
        square = darker.addcmul(gain[..., None], window, value=-1).clamp_min(0).square()
        return 1 + square.square() * (1 - template)

    def _gram(self, outline: Outline, window: Tensor, weight: Tensor) -> Tensor:
        """Return the weighted products `[B, D, 8, 8]` of 1, u, v, the template, its derivatives, and last the window itself."""
        root = weight.sqrt()[None]
        edge, sides = root * outline.edge, self.linear[1:, None, None]
        fields = [root, root * sides, root * outline.template, edge / outline.length * outline.normal, edge, root * window]
        basis = torch.cat(fields).movedim(0, -2)
        return basis @ basis.mT

    def _seen(self, gram: Tensor, fit: Tensor, missed: Tensor, offset: Tensor, mean: Tensor) -> tuple[Tensor, Tensor]:
        """Return the share of the window's variance that the model explains, and the dot's contrast, `[B, D]`."""
        spread = gram[..., 7, 7] - gram[..., 0, 7].square() / gram[..., 0, 0].clamp_min(1)
        explained = 1 - missed / (spread.clamp_min(0) + 1e-6)
        background = (fit[1:3] * offset).sum(0)
        return explained, -fit[3] / (fit[0] - background + mean).clamp_min(1e-2)


def _missed(gram: Tensor, fit: Tensor) -> Tensor:
    """Return the weighted sum `[B, D]` of the squared residuals of `fit [B, D, 7, 1]`."""
    miss = torch.cat([fit, -torch.ones_like(fit[..., :1, :])], -2)
    return ((gram @ miss) * miss).sum((-2, -1)).clamp_min(0)


def _disc(half: int) -> np.ndarray:
    """Return the integer offsets `[2, P]` within the distance `half` of 0."""
    step = np.arange(-half, half + 1)
    offset = np.stack(np.meshgrid(step, step)).reshape(2, -1)
    return np.asarray(offset[:, np.hypot(*offset) <= half + 0.5])
