"""How noisy images are."""

from torch import Tensor

STRIDE = 4  # px, between the places that are asked
GAIN = 6  # of the second difference in u of that in v, in noise (Immerkaer 1996)
EXPOSED = (0.03, 0.97)  # grey in which noise is not cut off
CUT, ROUNDS = 3.0, 5
BIAS = 0.753  # mean of |x| of what is within CUT times that mean, of a normal x of standard deviation 1


def pixel_noise(images: Tensor) -> Tensor:
    """Standard deviation of the noise of a pixel, `[B]`, from images `[B, 1, H, W]` with edges in them.

    The mean size of a second difference that sees neither slopes nor curvatures; edges are cut off as what is far above it.

    Limitations:
        Noise that is not white, as JPEG leaves it, or texture finer than some pixels, is taken for more or less than it is.

    Example:
        >>> import torch
        >>> noise = torch.randn(1, 1, 200, 200, generator=torch.Generator().manual_seed(0))
        >>> round(pixel_noise(0.5 + 0.02 * noise).item(), 3)
        0.02
    """
    size = _second_difference(_second_difference(images).mT).mT.abs().flatten(1)
    middle = images[..., 1:-1:STRIDE, 1:-1:STRIDE].flatten(1)
    kept = ((middle > EXPOSED[0]) & (middle < EXPOSED[1])).to(images.dtype)
    for _ in range(ROUNDS):
        mean = (kept * size).sum(1, keepdim=True) / kept.sum(1, keepdim=True).clamp_min(1)
        kept = kept * (size <= CUT * mean).to(images.dtype)
    return mean[:, 0] / (GAIN * BIAS)


def _second_difference(images: Tensor) -> Tensor:
    """Along every `STRIDE`-th column, in v."""
    before, here, after = images[..., :-2:STRIDE, :], images[..., 1:-1:STRIDE, :], images[..., 2::STRIDE, :]
    return before - 2 * here + after
