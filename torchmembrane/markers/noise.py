"""Estimation of the noise of images."""

import torch
from torch import Tensor

from .native_frames import found_by, is_native
from .native_image import noises

STRIDE = 7  # px between the sampled positions, which visit every phase of 8-px blocks
GAIN = 6  # of the second difference in u of that in v, in noise (Immerkaer 1996)
EXPOSED = (0.03, 0.97)  # range of grey in which noise is not clipped
NO_LIMIT = 100.0  # larger than any difference of grey values in 0..1
OUTLIER_FACTOR, ROUNDS = 3.0, 4
BIAS = 0.753  # mean of |x| of what is within OUTLIER_FACTOR times that mean, of a normal x of standard deviation 1


def pixel_noise(images: Tensor) -> Tensor:
    """Estimate the standard deviation of pixel noise, `[B]`, from images `[B, 1, H, W]` that contain edges.

    It is the mean magnitude of a second difference that slopes and curvatures do not affect; edges are excluded as outliers.

    Limitations:
        The estimate is off if the noise is not white, as after JPEG compression, or if texture is only a few pixels wide.

    Example:
        >>> noise = torch.randn(1, 1, 200, 200, generator=torch.Generator().manual_seed(0))
        >>> round(pixel_noise(0.5 + 0.02 * noise).item(), 3)
        0.02
    """
    if is_native(images):
        return found_by(noises, (STRIDE, *EXPOSED, NO_LIMIT, OUTLIER_FACTOR, ROUNDS, GAIN * BIAS), (images[:, 0],))
    size = _second_difference(_second_difference(images, -2), -1).abs()
    middle = images[..., 1:-1:STRIDE, 1:-1:STRIDE]
    size = torch.where((middle > EXPOSED[0]) & (middle < EXPOSED[1]), size, 2 * NO_LIMIT).flatten(1)[:, None]
    summands = torch.cat([size, torch.ones_like(size)], 1).mT
    limit = torch.full_like(size[..., :1], NO_LIMIT)
    for _ in range(ROUNDS):
        total, count = ((size <= limit).to(size.dtype) @ summands).split(1, -1)
        mean = total / count.clamp_min(1)
        limit = OUTLIER_FACTOR * mean
    return mean[:, 0, 0] / (GAIN * BIAS)


def _second_difference(images: Tensor, dim: int) -> Tensor:
    """Return the second difference along `dim` at every `STRIDE`-th position."""
    before, here, after = (images.movedim(dim, 0)[k : images.shape[dim] + k - 2 : STRIDE] for k in range(3))
    return (before + after).sub(here, alpha=2).movedim(0, dim)
