"""How a camera that moves against its rim, a little, moves the image."""

import torch
from torch import Tensor


def motion_of_pixels(pixels: Tensor, image_size: tuple[int, int]) -> Tensor:
    """Derivatives `[..., 2, 4]` of `pixels [..., 2]` in du, dv, rotation and growth, the latter two in px at half the image's
    diagonal from its centre."""
    size = pixels.new_tensor(image_size) - 1
    u, v = ((2 * pixels - size) / torch.linalg.vector_norm(size)).unbind(-1)
    one, none = torch.ones_like(u), torch.zeros_like(u)
    return torch.stack([torch.stack([one, none, -v, u], -1), torch.stack([none, one, u, v], -1)], -2)
