"""Images with their resolution halved twice, by averages, so that a pixel covers those that it replaces."""

import torch
import torch.nn.functional as F
from torch import Tensor

from ..native_frames import found_by, is_native
from ..native_image import halves

LEVELS = 3


def mean_pyramid(image: Tensor) -> list[Tensor]:
    """Return the image and its means over 2 x 2 and 4 x 4 pixels.

    Pixel `p` of level `k` is centred at `2^k p + (2^k - 1) / 2` of the image.

    Args:
        image: `[B, 1, H, W]`.

    Returns:
        `LEVELS` images `[B, 1, H // 2^k, W // 2^k]`, the finest first.

    Example:
        >>> [level.flatten().tolist() for level in mean_pyramid(torch.arange(16.0).reshape(1, 1, 4, 4))[1:]]
        [[2.5, 4.5, 10.5, 12.5], [7.5]]
    """
    levels = [image]
    for _ in range(LEVELS - 1):
        levels.append(_halved(levels[-1]))
    return levels


def _halved(image: Tensor) -> Tensor:
    """Return `F.avg_pool2d(image, 2)`; on a processor, sums of slices take a sixth of its time, but not in exported models."""
    if torch.compiler.is_exporting():
        return F.avg_pool2d(image, 2)
    if is_native(image):
        return found_by(halves, (), (image[:, 0],), image.shape[-2] // 2, image.shape[-1] // 2)[:, None]
    height, width = (side // 2 * 2 for side in image.shape[-2:])
    rows = image[..., 0:height:2, :] + image[..., 1:height:2, :]
    return 0.25 * (rows[..., 0:width:2] + rows[..., 1:width:2])
