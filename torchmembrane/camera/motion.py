"""How a camera that moves against its rim, a little, moves the image."""

import math

import torch
from torch import Tensor

LARGEST_SHIFT = 0.03
"""Of half the image's diagonal: no camera that is fixed to a sensor moves so far; an image that has lost bytes does."""


def motion_of_pixels(pixels: Tensor, image_size: tuple[int, int]) -> Tensor:
    """Derivatives `[..., 2, 4]` of `pixels [..., 2]` in du, dv, rotation and growth, the latter two in px at half the image's
    diagonal from its centre."""
    size = pixels.new_tensor(image_size) - 1
    u, v = ((2 * pixels - size) / torch.linalg.vector_norm(size)).unbind(-1)
    one, none = torch.ones_like(u), torch.zeros_like(u)
    return torch.stack([torch.stack([one, none, -v, u], -1), torch.stack([none, one, u, v], -1)], -2)


def shift_of(moved: Tensor, pixels: Tensor, image_size: tuple[int, int]) -> Tensor:
    """What the motion `[B, 4]` does to `pixels [B, D, 2]`, px."""
    shift: Tensor = (motion_of_pixels(pixels, image_size) * moved[:, None, None]).sum(-1)
    return shift


def in_words(moved: Tensor, image_size: tuple[int, int]) -> Tensor:
    """The motion `[B, 4]` as du, dv (px), rotation (degrees) and scale."""
    du, dv, rotation, growth = moved.unbind(-1)
    half = _half_diagonal(image_size)
    return torch.stack([du, dv, torch.rad2deg(rotation / half), 1 + growth / half], -1)


def in_pixels(motion: Tensor, image_size: tuple[int, int]) -> Tensor:
    """What `in_words` gave as a motion in px again."""
    du, dv, rotation, scale = motion.unbind(-1)
    half = _half_diagonal(image_size)
    return torch.stack([du, dv, torch.deg2rad(rotation) * half, (scale - 1) * half], -1)


def is_displaced(moved: Tensor, image_size: tuple[int, int]) -> Tensor:
    """Whether the motion `[B, 4]` shifts the image farther than a camera moves, `[B]` bool."""
    displaced: Tensor = torch.linalg.vector_norm(moved[..., :2], dim=-1) > LARGEST_SHIFT * _half_diagonal(image_size)
    return displaced


def _half_diagonal(image_size: tuple[int, int]) -> float:
    return math.hypot(image_size[0] - 1, image_size[1] - 1) / 2
