"""How noisy images are."""

import torch
import torch.nn.functional as F
from torch import Tensor

LAPLACIAN = ((1.0, -2.0, 1.0), (-2.0, 4.0, -2.0), (1.0, -2.0, 1.0))
"""Blind to slopes and curvatures of grey; takes noise of standard deviation 1 to 6 (Immerkaer 1996)."""
STRIDE = 4  # px, between the places that are asked
EXPOSED = (0.03, 0.97)  # grey in which noise is not cut off
CUT, ROUNDS = 3.0, 5
BIAS = 0.753  # mean of |x| of what is within CUT times that mean, of a normal x of standard deviation 1


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
    kernel = torch.tensor(LAPLACIAN, dtype=images.dtype, device=images.device)[None, None]
    size = F.conv2d(images, kernel, stride=STRIDE).abs().flatten(1)
    middle = images[..., 1:-1:STRIDE, 1:-1:STRIDE].flatten(1)
    kept = ((middle > EXPOSED[0]) & (middle < EXPOSED[1])).to(images.dtype)
    for _ in range(ROUNDS):
        mean = (kept * size).sum(1, keepdim=True) / kept.sum(1, keepdim=True).clamp_min(1)
        kept = kept * (size <= CUT * mean).to(images.dtype)
    return mean[:, 0] / (6 * BIAS)
