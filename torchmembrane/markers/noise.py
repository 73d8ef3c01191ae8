"""How noisy images are."""

import torch
from torch import Tensor

STRIDE = 7  # px, between the places that are asked: at every phase of blocks of 8
GAIN = 6  # of the second difference in u of that in v, in noise (Immerkaer 1996)
EXPOSED = (0.03, 0.97)  # grey in which noise is not cut off
NO_LIMIT = 100.0  # no difference of grey in 0..1 is as large
OUTLIER_FACTOR, ROUNDS = 3.0, 4
BIAS = 0.753  # mean of |x| of what is within OUTLIER_FACTOR times that mean, of a normal x of standard deviation 1


def pixel_noise(images: Tensor) -> Tensor:
    """Standard deviation of the noise of a pixel, `[B]`, from images `[B, 1, H, W]` with edges in them.

    The mean size of a second difference that sees neither slopes nor curvatures; edges are cut off as what is far above it.

    Limitations:
        Noise that is not white, as JPEG leaves it, or texture finer than some pixels, is taken for more or less than it is.

    Example:
        >>> noise = torch.randn(1, 1, 200, 200, generator=torch.Generator().manual_seed(0))
        >>> round(pixel_noise(0.5 + 0.02 * noise).item(), 3)
        0.02
    """
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
    """Along `dim`, at every `STRIDE`-th place."""
    before, here, after = (images.movedim(dim, 0)[k : images.shape[dim] + k - 2 : STRIDE] for k in range(3))
    return (before + after).sub(here, alpha=2).movedim(0, dim)
