"""Conversion of camera images to one batch of grey images."""

from typing import Literal

import numpy as np
import torch
from torch import Tensor

from ..control_flow import can_sync
from ..errors import MembraneError
from ..user_warnings import warn_user
from .images import GREY
from .levels import refuse_beyond, white_of

Channels = Literal["rgb", "bgr"]
CHANNELS = ("rgb", "bgr")
SHAPES = "[H, W], [H, W, 3], [B, H, W], [B, 1 | 3, H, W] or [B, H, W, 1 | 3]"
STORED_BITS = {torch.uint8: 8, torch.uint16: 16}
THREE_FRAMES = (
    "images [3, H, W] are taken for three grey frames. If they are the red, green and blue of one image, give image[None]; if "
    "they are three frames, images[:, None] says so"
)


def to_grayscale_batch(
    images: Tensor | np.ndarray, size: tuple[int, int], channels: Channels, like: Tensor, bits: int | None = None
) -> Tensor:
    """Convert images to grey values `[B, 1, height, width]` in 0..1, with the dtype and on the device of `like`.

    Args:
        images: torch or numpy images, `[H, W]`, `[H, W, 3]`, `[B, H, W]`, `[B, 1 | 3, H, W]` or `[B, H, W, 1 | 3]`; uint8,
            uint16 or float in 0..1. Grey is 0.299 R + 0.587 G + 0.114 B. A shape `[3, H, W]` is read as three grey frames, with
            a warning because it might be one colour image.
        size: width and height of the sensor's images, px.
        channels: order of the three colour channels, "rgb" or "bgr".
        like: tensor that sets the dtype and device of the result.
        bits: bit depth of the camera, if uint16 images use fewer than 16 bits: white is `2^bits - 1`.

    Raises:
        MembraneError: the images have another shape, size or type, or values beyond `bits`; the message states what was given,
            what was expected, and how to permute the axes.

    Example:
        >>> photograph = np.zeros((480, 640, 3), np.uint8)
        >>> list(to_grayscale_batch(photograph, (640, 480), "bgr", torch.zeros(())).shape)
        [1, 1, 480, 640]
    """
    pixels = image_tensor(images)
    if not (pixels.is_floating_point() or pixels.dtype in STORED_BITS):
        raise MembraneError(f"images of type {pixels.dtype}; expected uint8, uint16, or float in 0..1")
    planes = _planes(pixels, (size[1], size[0]))
    planes = [plane.to(like) for plane in planes]
    if not pixels.is_floating_point():
        white = white_of(STORED_BITS[pixels.dtype], bits)
        if bits is not None and can_sync(pixels):
            refuse_beyond(max(plane.max() for plane in planes), white)
        planes = [plane / white for plane in planes]
    if len(planes) == 1:
        return planes[0][:, None]
    red, green, blue = planes if channels == "rgb" else reversed(planes)
    return (GREY[0] * red + GREY[1] * green + GREY[2] * blue)[:, None]


def check_image(name: str, image: np.ndarray, size: tuple[int, int] | None = None) -> np.ndarray:
    """Return an image as an array `[H, W]`.

    Args:
        name: name of the image in error messages.
        image: an array or a tensor.
        size: required width and height, px; None: any size.

    Raises:
        MembraneError: the image has another shape.

    Example:
        >>> check_image("depth", np.zeros((3, 4)), (4, 3)).shape
        (3, 4)
    """
    array = np.asarray(image)
    if array.ndim != 2 or array.size == 0 or size not in (None, array.shape[::-1]):
        expected = "[H, W]" if size is None else f"[{size[1]}, {size[0]}], the camera's"
        raise MembraneError(f"{name} has the shape {list(array.shape)}; expected {expected}")
    return array


def image_tensor(images: Tensor | np.ndarray) -> Tensor:
    """Return images as a tensor on their own device, with their values; an array may have any strides and byte order.

    Raises:
        MembraneError: torch has no such type.

    Example:
        >>> image_tensor(np.arange(3.0, dtype=">f4")[::-1]).tolist()
        [2.0, 1.0, 0.0]
    """
    if isinstance(images, Tensor):
        return images
    array = np.asarray(images)
    try:
        return torch.from_numpy(np.require(array, array.dtype.newbyteorder("="), ["C", "W"]))
    except TypeError as error:
        raise MembraneError(f"images of type {array.dtype}; expected uint8, uint16, or float in 0..1") from error


def _planes(pixels: Tensor, size: tuple[int, int]) -> list[Tensor]:
    """Return the one or three channels, `[B, H, W]` each."""
    shape = tuple(pixels.shape)
    if shape[-2:] == size and len(shape) == 2:
        return [pixels[None]]
    if shape[-2:] == size and len(shape) == 3:
        if not torch.compiler.is_compiling() and shape[0] == 3:
            warn_user(THREE_FRAMES)
        return [pixels]
    if shape[-2:] == size and len(shape) == 4 and shape[1] in (1, 3):
        return list(pixels.unbind(1))
    if shape[-3:-1] == size and len(shape) in (3, 4) and shape[-1] in (1, 3):
        return list((pixels if len(shape) == 4 else pixels[None]).unbind(-1))
    raise MembraneError(_refusal(shape, size))


def _refusal(shape: tuple[int, ...], size: tuple[int, int]) -> str:
    height, width = size
    said = f"images {list(shape)}; expected {SHAPES} with H = {height}, W = {width}"
    if len(shape) < 2:
        return f"{said}: give an image's array"
    if size[::-1] in (shape[-2:], shape[-3:-1]):
        return f"{said}: rows and columns are exchanged; swap them, images.swapaxes(-1, -2), or (-2, -3) with channels last"
    if shape[-2:] == size or shape[-3:-1] == size:
        return f"{said}: other than one or three channels; give grey or colour, without alpha"
    given = shape[-3:-1] if shape[-1] in (1, 3) else shape[-2:]
    if len(given) == 2:
        said = f"the image is {given[1]} x {given[0]} px, expected {width} x {height} ({said})"
    return f"{said}: use images of this sensor's camera; where its mode crops or bins them, say so in the file's [camera]"
