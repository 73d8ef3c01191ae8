"""Image motion caused by small movements of a camera relative to the rim."""

import math

import torch
import torch.nn.functional as F
from torch import Tensor

LARGEST_SHIFT = 0.03
"""Largest shift over half the image's diagonal: a fixed camera never moves so far, but a corrupted image may appear to."""


def motion_of_pixels(pixels: Tensor, image_size: tuple[int, int]) -> Tensor:
    """Return the derivatives `[..., 2, 4]` of `pixels [..., 2]` with respect to du, dv, rotation and scaling. The latter two
    are given as the displacement in px of a point half the image's diagonal from its centre."""
    twice_half = 2 * _half_diagonal(image_size)
    u, v = ((2 * along - (size - 1)) / twice_half for along, size in zip(pixels.unbind(-1), image_size, strict=True))
    one, none = torch.ones_like(u), torch.zeros_like(u)
    return torch.stack([torch.stack([one, none, -v, u], -1), torch.stack([none, one, u, v], -1)], -2)


def shift_of(moved: Tensor, pixels: Tensor, image_size: tuple[int, int]) -> Tensor:
    """Return the shift of `pixels [B, D, 2]` by the motion `[B, 4]`, px."""
    shift: Tensor = (motion_of_pixels(pixels, image_size) * moved[:, None, None]).sum(-1)
    return shift


def to_degrees_and_scale(moved: Tensor, image_size: tuple[int, int]) -> Tensor:
    """Convert the motion `[B, 4]` to du, dv (px), rotation (degrees) and scale."""
    du, dv, rotation, growth = moved.unbind(-1)
    half = _half_diagonal(image_size)
    return torch.stack([du, dv, torch.rad2deg(rotation / half), 1 + growth / half], -1)


def to_pixels(motion: Tensor, image_size: tuple[int, int]) -> Tensor:
    """Convert the result of `to_degrees_and_scale` back to a motion in px."""
    du, dv, rotation, scale = motion.unbind(-1)
    half = _half_diagonal(image_size)
    return torch.stack([du, dv, torch.deg2rad(rotation) * half, (scale - 1) * half], -1)


def is_displaced(moved: Tensor, image_size: tuple[int, int]) -> Tensor:
    """Return whether the motion `[B, 4]` shifts the image farther than a camera can move, `[B]` bool."""
    displaced: Tensor = torch.linalg.vector_norm(moved[..., :2], dim=-1) > LARGEST_SHIFT * _half_diagonal(image_size)
    return displaced


class ImageMotion:
    """Base class of a camera, with one image, and a rig, with several; each image may have moved relative to the rim.

    `moved [B, 4 W]` contains the motions of W images one after another; pixels `[..., N, 2]` are those of the markers in the
    first image, then in the second, and so on.

    Attributes:
        image_sizes: width and height of each image.
    """

    image_sizes: list[tuple[int, int]]

    def motion_of_pixels(self, pixels: Tensor) -> Tensor:
        """Return the derivatives `[..., N, 2, 4 W]` of `pixels [..., N, 2]`, as the function of the same name."""
        sizes = self.image_sizes
        if len(sizes) == 1:
            return motion_of_pixels(pixels, sizes[0])
        each = zip(pixels.unflatten(-2, (len(sizes), -1)).unbind(-3), sizes, strict=True)
        blocks = [motion_of_pixels(*part) for part in each]
        return torch.cat([F.pad(block, (4 * w, 4 * (len(sizes) - 1 - w))) for w, block in enumerate(blocks)], -3)

    def shift_of(self, moved: Tensor, pixels: Tensor) -> Tensor:
        """Return the shift of `pixels [B, N, 2]` by the motion, px."""
        if len(self.image_sizes) == 1:
            return shift_of(moved, pixels, self.image_sizes[0])
        shift: Tensor = (self.motion_of_pixels(pixels) * moved[:, None, None]).sum(-1)
        return shift

    def motion_in_words(self, moved: Tensor) -> Tensor:
        """Convert the motion to du, dv (px), rotation (degrees) and scale, `[B, 4]`; of several images `[B, W, 4]`."""
        sizes = self.image_sizes
        if len(sizes) == 1:
            return to_degrees_and_scale(moved, sizes[0])
        return torch.stack([to_degrees_and_scale(each, size) for each, size in zip(moved.split(4, -1), sizes, strict=True)], -2)

    def motion_in_pixels(self, motion: Tensor) -> Tensor:
        """Convert the result of `motion_in_words` back to `moved`."""
        sizes = self.image_sizes
        if len(sizes) == 1:
            return to_pixels(motion, sizes[0])
        return torch.cat([to_pixels(each, size) for each, size in zip(motion.unbind(-2), sizes, strict=True)], -1)

    def is_displaced(self, moved: Tensor) -> Tensor:
        """Return whether an image has shifted farther than a camera can move, `[B]` bool."""
        sizes = self.image_sizes
        if len(sizes) == 1:
            return is_displaced(moved, sizes[0])
        each = [is_displaced(part, size) for part, size in zip(moved.split(4, -1), sizes, strict=True)]
        return torch.stack(each).any(0)


def _half_diagonal(image_size: tuple[int, int]) -> float:
    return math.hypot(image_size[0] - 1, image_size[1] - 1) / 2
