"""Grey levels: which level is white if a camera uses fewer bits than its images are stored with."""

from collections.abc import Callable
from functools import wraps
from typing import Any, Concatenate, ParamSpec, TypeVar

import numpy as np

from ..errors import MembraneError, expect

FEWEST_BITS, MOST_BITS = 8, 16
USUAL_BITS = (8, 10, 12, 14)
"""Usual bit depths of cameras whose values are stored in 16 bits."""
MOST_AVERAGED = 16
"""Largest number of averaged pixels or images whose mean is still recognised as a mean of integer levels."""
HIGHEST = 2**16 - 1

P = ParamSpec("P")
Found = TypeVar("Found")


def check_bits(bits: int | None) -> None:
    """Refuse a bit depth that no camera has.

    Raises:
        MembraneError: it is not a whole number from 8 to 16.

    Example:
        >>> check_bits(7)
        Traceback (most recent call last):
        ...
        torchmembrane.errors.MembraneError: Camera: bits is 7; expected a whole number from 8 to 16, the bits of the camera's \
values where these are stored in 16, or leave it out
    """
    right = bits is None or (isinstance(bits, int | np.integer) and FEWEST_BITS <= bits <= MOST_BITS)
    expected = f"a whole number from {FEWEST_BITS} to {MOST_BITS}, the bits of the camera's values where these are stored in 16"
    expect(right, "Camera: bits", bits, f"{expected}, or leave it out")


def white_of(stored: int, bits: int | None) -> int:
    """Return the level that is white.

    Args:
        stored: number of bits in which a value is stored, 8 or 16.
        bits: bit depth of the camera, if 16-bit values use fewer bits; None: all stored bits.

    Example:
        >>> white_of(16, 12), white_of(16, None), white_of(8, 12)
        (4095, 65535, 255)
    """
    return (1 << (bits if bits is not None and stored == 16 else stored)) - 1


def refuse_beyond(highest: Any, white: int) -> None:
    """Refuse values that exceed the bit depth of the camera.

    Args:
        highest: largest value.
        white: level of white, as `white_of` returns it.

    Raises:
        MembraneError: the largest value exceeds white.
    """
    if int(highest) > white:
        bits = (white + 1).bit_length() - 1
        raise MembraneError(
            f"values up to {int(highest)}; expected at most {white}, as bits = {bits} in the sensor file's [camera] says: "
            "correct it, or leave it out if the values use all 16 bits"
        )


def telling_bits(find: Callable[Concatenate[np.ndarray, P], Found]) -> Callable[Concatenate[np.ndarray, P], Found]:
    """Decorate a function of an image so that its errors end with the hint that `too_few_bits` gives for that image."""

    @wraps(find)
    def found(image: np.ndarray, /, *args: P.args, **kwargs: P.kwargs) -> Found:
        try:
            return find(image, *args, **kwargs)
        except MembraneError as error:
            raise MembraneError(f"{error}{too_few_bits(image)}") from error

    return found


def too_few_bits(image: np.ndarray) -> str:
    """Return a hint for the error on an image without content: how high its values go, if they look like those of a camera of
    fewer bits stored in 16; return "" for any other image.

    Args:
        image: uint16 image, or grey values in 0..1; also a mean of up to `MOST_AVERAGED` such images or pixels.

    Example:
        >>> too_few_bits(np.array([[90, 612]], np.uint16))
        "; its values go up to 612 of 65535, as of a camera of 10 bits: say bits = 10 in the file's [camera] (init: --bits)"
        >>> too_few_bits(np.array([[90, 61200]], np.uint16)), too_few_bits(np.array([[1, 3]], np.uint8) / 255)
        ('', '')
    """
    levels = image.astype(np.float64) * (1 if image.dtype.kind == "u" else HIGHEST)
    highest = levels.max(initial=0.0)
    bits = next((bits for bits in USUAL_BITS if highest < 2**bits), None)
    if bits is None or image.dtype == np.uint8:
        return ""
    multiples = (levels * parts for parts in range(1, MOST_AVERAGED + 1))
    whole = next((each for each in multiples if np.abs(each - np.rint(each)).max() < 0.05), None)
    if whole is None or not (np.rint(whole) % (HIGHEST // 255)).any():  # of colour; of 8 bits
        return ""
    return (
        f"; its values go up to {highest:.0f} of {HIGHEST}, as of a camera of {bits} bits: say bits = {bits} in the file's "
        "[camera] (init: --bits)"
    )
