"""The image and its means over 2 x 2 and 4 x 4 pixels."""

import torch.nn.functional as F

LEVELS = 3


def pyramid(image):
    """`image [B, 1, H, W]` and its means over 2 x 2 and 4 x 4 pixels."""
    levels = [image]
    for _ in range(LEVELS - 1):
        levels.append(F.avg_pool2d(levels[-1], 2))
    return levels
