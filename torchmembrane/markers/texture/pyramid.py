"""Low-passed images at full, half and quarter resolution, and interpolation between their pixels."""

from torch import Tensor
from torch.nn import functional as F

LEVELS = 3  # pyramid: full, half, quarter resolution
TAPS = 5  # of the binomial low-pass, along each axis


def low_pass_pyramid(image: Tensor) -> list[Tensor]:
    """Return the low-passed image at full, half and quarter resolution.

    Binomial 5 x 5 low-pass, the border replicated. Pixel `p` of level `k` is centred at `2^k p` of the image.

    Args:
        image: `[B, 1, H, W]`.

    Returns:
        `LEVELS` images, the finest first.

    Example:
        >>> import torch
        >>> [list(level.shape) for level in low_pass_pyramid(torch.zeros(1, 1, 12, 17))]
        [[1, 1, 12, 17], [1, 1, 6, 9], [1, 1, 3, 5]]
    """
    levels = [low_pass(image, 1)]
    for _ in range(LEVELS - 1):
        levels.append(low_pass(levels[-1], 2))
    return levels


def low_pass(image: Tensor, stride: int) -> Tensor:
    """Return every `stride`-th (1 or 2) pixel of the binomial 5 x 5 low-pass of `[B, 1, H, W]`, the border replicated."""
    from kornia.filters import blur_pool2d  # here: kornia takes half a second to load, and dots do not need it

    reach, margin = TAPS // 2, TAPS // 2 // stride
    image = F.pad(image, (reach, reach, reach, reach), mode="replicate")  # `blur_pool2d` adds a border of zeros
    return blur_pool2d(image, TAPS, stride)[..., margin:-margin, margin:-margin]


def sample(image: Tensor, centre: Tensor, affine: Tensor, offset: Tensor) -> Tensor:
    """Return bilinear values `[B, D, N]` of `image [B, 1, H, W]` at `centre [B, D, 2] + affine [B, D, 2, 2] offset [N, 2]`,
    px."""
    scale = 2 / centre.new_tensor([image.shape[-1] - 1, image.shape[-2] - 1])
    grid = (scale * centre - 1)[:, :, None] + offset @ (scale[:, None] * affine).mT
    return F.grid_sample(image, grid, "bilinear", "border", align_corners=True)[:, 0]
