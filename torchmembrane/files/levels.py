"""Grey levels: which level is white if a camera has fewer bits than its images are stored with."""

from collections.abc import Callable
from functools import wraps
from typing import Any, Concatenate, ParamSpec, TypeVar

import numpy as np

from ..errors import MembraneError, expect

FEWEST_BITS, MOST_BITS = 8, 16
USUAL_BITS = (8, 10, 12, 14)
"""Numbers of bits of cameras whose values are stored in 16."""
MOST_AVERAGED = 16
"""Pixels or images whose mean is still recognised as one of whole levels."""
HIGHEST = 2**16 - 1

P = ParamSpec("P")
Found = TypeVar("Found")


def check_bits(bits: int | None) -> None:
    """Refuse a number of bits that no camera has.

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
    """The level that is white.

    Args:
        stored: bits that a value is stored in, 8 or 16.
        bits: bits of the camera, where 16 hold fewer; None: those it is stored in.

    Example:
        >>> white_of(16, 12), white_of(16, None), white_of(8, 12)
        (4095, 65535, 255)
    """
    return (1 << (bits if bits is not None and stored == 16 else stored)) - 1


def refuse_beyond(highest: Any, white: int) -> None:
    """Refuse values beyond those of a camera's bits.

    Args:
        highest: of the values.
        white: as for `white_of` gives it.

    Raises:
        MembraneError: the highest is beyond white.
    """
    if int(highest) > white:
        bits = (white + 1).bit_length() - 1
        raise MembraneError(
            f"values up to {int(highest)}; expected at most {white}, as bits = {bits} in the sensor file's [camera] says: "
            "correct it, or leave it out if the values use all 16 bits"
        )


def telling_bits(find: Callable[Concatenate[np.ndarray, P], Found]) -> Callable[Concatenate[np.ndarray, P], Found]:
    """Decorate a function of an image so that its errors end with the hint of `too_few_bits` on that image."""

    @wraps(find)
    def found(image: np.ndarray, /, *args: P.args, **kwargs: P.kwargs) -> Found:
        try:
            return find(image, *args, **kwargs)
        except MembraneError as error:
            raise MembraneError(f"{error}{too_few_bits(image)}") from error

    return found


def too_few_bits(image: np.ndarray) -> str:
    """A hint for the error on an image that shows nothing: how high its values go, if it looks like a camera's fewer bits
    stored as 16; "" for all other images.

    Args:
        image: uint16, or grey in 0..1; also a mean of up to `MOST_AVERAGED` such images or pixels.

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
