"""Low-passed images at full, half and quarter resolution, and values between their pixels."""

import torch
from torch import Tensor
from torch.nn import functional as F

LEVELS = 3  # pyramid: full, half, quarter resolution
BINOMIAL = (1 / 16, 4 / 16, 6 / 16, 4 / 16, 1 / 16)


def low_pass_pyramid(image: Tensor) -> list[Tensor]:
    """The image at full, half and quarter resolution, low-passed.

    Pixel `p` of level `k` is centred at `2^k p` of the image.

    Args:
        image: `[B, 1, H, W]`.

    Returns:
        `LEVELS` images, the finest first.

    Example:
        >>> [list(level.shape) for level in low_pass_pyramid(torch.zeros(1, 1, 12, 17))]
        [[1, 1, 12, 17], [1, 1, 6, 9], [1, 1, 3, 5]]
    """
    levels = [smooth(image)]
    for _ in range(LEVELS - 1):
        levels.append(smooth(levels[-1])[..., ::2, ::2])
    return levels


def smooth(image: Tensor) -> Tensor:
    """Binomial 5 x 5 low-pass of `[B, 1, H, W]`, the border replicated."""
    kernel = torch.tensor(BINOMIAL, dtype=image.dtype, device=image.device)
    image = F.conv2d(F.pad(image, (2, 2, 0, 0), mode="replicate"), kernel.view(1, 1, 1, 5))
    return F.conv2d(F.pad(image, (0, 0, 2, 2), mode="replicate"), kernel.view(1, 1, 5, 1))


def sample(image: Tensor, centre: Tensor, affine: Tensor, offset: Tensor) -> Tensor:
    """Bilinear values `[B, D, N]` of `image [B, 1, H, W]` at `centre [B, D, 2] + affine [B, D, 2, 2] offset [N, 2]`, px."""
    scale = 2 / centre.new_tensor([image.shape[-1] - 1, image.shape[-2] - 1])
    grid = (scale * centre - 1)[:, :, None] + offset @ (scale[:, None] * affine).mT
    return F.grid_sample(image, grid, "bilinear", "border", align_corners=True)[:, 0]
