"""Patches of one level of the rest image: found by correlation, refined by Gauss-Newton steps."""

from math import isqrt

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from .pyramid import sample

SEARCH_REACH = 7  # px of the coarsest level searched to each side: 28 px of the image
PATCH_RADII = (8, 8, 6)  # px of the level, half side of a patch, finest level first
WINDOW_WIDTH = 0.6  # standard deviation of a patch's Gaussian window over its half side
WARP_DAMPING = 1e-3  # grey^2: keeps weak texture from bending a patch's own affine map with the noise


def square_offsets(radius: int) -> Tensor:
    """Return the integer offsets (u, v) in a square, `[(2 radius + 1)^2, 2]`, row by row with u varying fastest.

    Example:
        >>> square_offsets(1)[:4].tolist()
        [[-1.0, -1.0], [0.0, -1.0], [1.0, -1.0], [-1.0, 0.0]]
    """
    line = torch.arange(-radius, radius + 1, dtype=torch.float64)
    v, u = torch.meshgrid(line, line, indexing="ij")
    return torch.stack([u, v], -1).reshape(-1, 2)


class Template(nn.Module):
    """Patches of one level of the rest image, and the Gauss-Newton steps that align an image's patches with them.

    With `T` the patch less its weighted mean, scaled to unit variance, and `S` its six derivatives (by shift, by affine
    map) made orthogonal to 1 and `T`, a step is `(S^T S)^-1 S^T I / (T . I)`: linear in the image `I` but for the gain.

    Args:
        rest: level of the rest image, `[1, 1, H, W]`.
        centre: centres of the patches, `[D, 2]`, px of the level.
        radius: half side of a patch, px of the level.

    Reference:
        Baker and Matthews, Lucas-Kanade 20 years on, IJCV 56, 2004 (inverse compositional).
    """

    centre: Tensor
    offset: Tensor
    radius: Tensor
    weight: Tensor
    unit: Tensor
    rows: Tensor

    def __init__(self, rest: Tensor, centre: Tensor, radius: int):
        super().__init__()
        offset = square_offsets(radius)
        weight = torch.exp(-offset.square().sum(-1) / (2 * (WINDOW_WIDTH * radius) ** 2))
        weight = weight / weight.sum()
        still = torch.eye(2).to(rest)[None, None]
        half = 0.5 * torch.eye(2).to(rest)
        value = sample(rest, centre[None], still, offset)[0]
        value = value - (weight * value).sum(-1, keepdim=True)
        contrast = (weight * value.square()).sum(-1, keepdim=True).sqrt() + 1e-6
        unit = (value / contrast)[:, None]
        ahead, behind = ([sample(rest, centre[None] + s * h, still, offset)[0] for h in half] for s in (1, -1))
        slope = torch.stack(ahead, 1) - torch.stack(behind, 1)  # [D, 2, N]
        slope = torch.cat([slope, (slope[:, :, None] * offset.T / radius).flatten(1, 2)], 1)
        slope = slope - (weight * slope).sum(-1, keepdim=True)
        slope = slope - (weight * slope * unit).sum(-1, keepdim=True) * unit
        damping = torch.diag(rest.new_tensor([1e-8] * 2 + [WARP_DAMPING] * 4))
        newton = torch.linalg.solve((weight * slope) @ slope.mT + damping, weight * slope) * contrast[:, None]
        self.register_buffer("centre", centre.clone())
        self.register_buffer("offset", offset)
        self.register_buffer("radius", torch.tensor(float(radius), dtype=torch.float32))
        self.register_buffer("weight", weight)
        self.register_buffer("unit", weight * unit[:, 0])
        self.register_buffer("rows", torch.cat([weight.expand_as(unit), weight * unit, newton], 1))  # [D, 8, N]

    def forward(self, image: Tensor, flow: Tensor, gradient: Tensor, steps: int) -> tuple[Tensor, Tensor]:
        """Align the patches of an image with those of the rest image.

        Args:
            image: level of the image, `[B, 1, H, W]`.
            flow: initial flow, `[B, D, 2]`, px of the level.
            gradient: gradient of the flow, `[B, D, 2, 2]`.
            steps: number of Gauss-Newton steps.

        Returns:
            Flow `[B, D, 2]`, px of the level, and similarity `[B, D]` in 0..1 by correlation, before the last step.
        """
        eye = torch.eye(2, dtype=flow.dtype, device=flow.device)
        affine = gradient + eye
        for _ in range(steps):
            value = sample(image, self.centre + flow, affine, self.offset)
            mean, gain, step = torch.einsum("drn,bdn->bdr", self.rows, value).split([1, 1, 6], -1)
            step = step / gain.clamp(min=1e-4)
            shift, warp = (step / step.square().sum(-1, keepdim=True).clamp(min=1).sqrt()).split([2, 4], -1)
            affine = affine @ (eye - warp.unflatten(-1, (2, 2)) / self.radius)
            flow = flow - (affine @ shift[..., None])[..., 0]
        variance = value.square() @ self.weight - mean[..., 0].square()
        ncc = gain[..., 0] / (variance.clamp(min=0) + 1e-6).sqrt()
        return flow, ((ncc - 0.7) / 0.25).clamp(0, 1)


def normalised_correlation(window: Tensor, unit: Tensor, weight: Tensor) -> Tensor:
    """Correlate patches with windows of an image at all integer shifts: -1..1, `[B, D, n - s + 1, n - s + 1]`.

    Args:
        window: grey values of the windows, `[B, D, n^2]`, in rows of u.
        unit: weighted patches, `[D, 1, s, s]`, as in `Template.unit`.
        weight: weights of the patches' pixels, `[1, 1, s, s]`, with sum 1.
    """
    side, patches = isqrt(window.shape[-1]), unit.shape[0]
    window = (window - window.mean(-1, keepdim=True)).unflatten(-1, (side, side))
    weight = weight.expand(patches, -1, -1, -1)
    product = F.conv2d(window, unit, groups=patches)
    mean = F.conv2d(window, weight, groups=patches)
    variance = F.conv2d(window.square(), weight, groups=patches) - mean.square()
    return product / (variance.clamp(min=0) + 1e-6).sqrt()


class Search(nn.Module):
    """Exhaustive normalised correlation of the coarsest templates over all shifts up to `SEARCH_REACH`."""

    centre: Tensor
    offset: Tensor
    unit: Tensor
    weight: Tensor
    shift: Tensor
    near: Tensor

    def __init__(self, template: Template):
        super().__init__()
        side, shift = 2 * PATCH_RADII[-1] + 1, square_offsets(SEARCH_REACH)
        self.register_buffer("centre", template.centre.clone())
        self.register_buffer("offset", square_offsets(PATCH_RADII[-1] + SEARCH_REACH))
        self.register_buffer("unit", template.unit.reshape(-1, 1, side, side).clone())
        self.register_buffer("weight", template.weight.reshape(1, 1, side, side).clone())
        self.register_buffer("shift", shift)
        self.register_buffer("near", torch.exp(-(shift[:, None] - shift).square().sum(-1) / 2))

    def forward(self, image: Tensor) -> tuple[Tensor, Tensor]:
        """Return the shift `[B, D, 2]` of the highest correlation, px of the level, and a score `[B, D]` in 0..1: high and
        unique."""
        still = torch.eye(2, dtype=image.dtype, device=image.device).expand(image.shape[0], 1, 2, 2)
        window = sample(image, self.centre.expand(image.shape[0], -1, -1), still, self.offset)
        ncc = normalised_correlation(window, self.unit, self.weight).flatten(-2)
        best, at = ncc.max(-1)
        near = self.near[at]
        share = torch.softmax(40 * ncc, -1) * near
        shift = (share @ self.shift) / (share.sum(-1, keepdim=True) + 1e-12)
        rival = (ncc - 2 * near).amax(-1)
        return shift, ((best - 0.5) / 0.3).clamp(0, 1) * ((best - rival) / 0.2).clamp(0, 1)
