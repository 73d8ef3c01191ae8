"""Decoding of image files with Pillow: size is bounded, values are returned as stored, and damaged files are refused."""

import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from io import BytesIO
from pathlib import Path
from typing import IO, NamedTuple

import numpy as np
from PIL import Image, UnidentifiedImageError

from ..errors import MembraneError
from .jpeg import is_whole
from .levels import HIGHEST
from .safe_read import DAMAGE, in_one_line
from .tiff import refuse_damaged_page, refuse_displaced

FORMATS = ("PNG", "JPEG", "BMP", "TIFF", "WEBP")
MOST_PIXELS = 2**25
KIND, OLD_KIND, WIDTH, HEIGHT, BITS_PER_SAMPLE, PHOTOMETRIC, DESCRIPTION, ORIENTATION = 254, 255, 256, 257, 258, 262, 270, 274
"""Tag numbers of a TIFF page."""
REDUCED_OR_MASK, OLD_REDUCED, WHITE_IS_ZERO = 0b101, 2, 0
"""Values of the TIFF tags above."""
UNTURNED: dict[int, Callable[[np.ndarray], np.ndarray]] = {
    1: lambda values: values,
    2: lambda values: values[:, ::-1],
    3: lambda values: values[::-1, ::-1],
    4: lambda values: values[::-1],
    5: lambda values: values.swapaxes(0, 1),
    6: lambda values: np.rot90(values),
    7: lambda values: values[::-1, ::-1].swapaxes(0, 1),
    8: lambda values: np.rot90(values, -1),
}
"""For each orientation tag, the function that undoes the rotation or reflection. Sensor cameras do not rotate images."""
IMAGEJ = re.compile(r"ImageJ=.*^images=(\d+)", re.DOTALL | re.MULTILINE)


class Stored(NamedTuple):
    """A picture as stored in its file.

    Attributes:
        values: pixel values `[height, width]` or `[height, width, 3]`.
        bits: number of used bits per value, if the file declares fewer than 16.
        halved: whether only the upper 8 bits of the file's 16 bits were read.
    """

    values: np.ndarray
    bits: int | None
    halved: bool


@contextmanager
def opened(path: str | Path, file: IO[bytes]) -> Iterator[Image.Image]:
    """Open an image and read its header; any failure inside the block is raised as an error that names the file.

    Args:
        path: name of the file in messages.
        file: open file with the content.

    Raises:
        MembraneError: the file is not an image, is too large, or is damaged.
    """
    expected = "a whole PNG, JPEG or TIFF"
    try:
        with Image.open(file, formats=FORMATS) as image:
            if image.width * image.height > MOST_PIXELS:
                raise MembraneError(
                    f"{image.width} x {image.height} px; expected at most {MOST_PIXELS} px in all: crop the image or "
                    "reduce its resolution"
                )
            yield image
    except MembraneError as error:
        raise MembraneError(f"{path}: {str(error).removeprefix(f'{path}: ')}") from error
    except (*DAMAGE, Image.DecompressionBombError) as error:
        cause = "cannot identify image file" if isinstance(error, UnidentifiedImageError) else in_one_line(error)
        raise MembraneError(f"{path}: not readable as an image ({cause}); expected {expected}") from error


def pictures(image: Image.Image) -> Iterator[int]:
    """Seek to each picture of an opened image in turn, and yield the indices of those that are frames.

    Auxiliary pictures are skipped: previews and masks in a TIFF, and pictures of another size in an MPO, which are previews and
    gain maps.

    Raises:
        MembraneError: the file declares more pictures than its directory lists.
        Exception: one of `DAMAGE`, if a picture cannot be located.
    """
    size, place, held = image.size, 0, 0
    while True:
        if not _belongs_to_another(image, size):
            held += 1
            yield place
        place += 1
        try:
            if not getattr(image, "is_animated", False):
                break
            image.seek(place)
        except EOFError:
            break
    if (told := _told(image)) > max(held, 1):
        raise MembraneError(
            f"holds {told} images by its ImageJ description, but its directory has {held}; expected one page per image: save "
            "it as a sequence of images, or as a TIFF with one page per image"
        )


def _belongs_to_another(image: Image.Image, size: tuple[int, int]) -> bool:
    if image.format == "TIFF":
        tags = image.tag_v2  # type: ignore[attr-defined]
        return bool(tags.get(KIND, 0) & REDUCED_OR_MASK) or tags.get(OLD_KIND) == OLD_REDUCED
    return image.format == "MPO" and image.size != size


def _told(image: Image.Image) -> int:
    """Return the number of pictures that an ImageJ TIFF declares; ImageJ omits the pages of large stacks."""
    if image.format != "TIFF":
        return 0
    image.seek(0)
    said = IMAGEJ.match(str(image.tag_v2.get(DESCRIPTION, "")))  # type: ignore[attr-defined]
    return int(said[1]) if said else 0


def stored(image: Image.Image, size: tuple[int, int] | None = None) -> Stored:
    """Return the current picture of an opened image.

    Args:
        image: an image as yielded by `opened`.
        size: required width and height, px; checked before any pixel is decoded.

    Raises:
        MembraneError: the image has another size.
        Exception: one of `DAMAGE`, if the picture cannot be decoded.
    """
    found, turned = stored_size(image), _orientation(image)
    if size is not None and found != size:
        raise MembraneError(
            f"the image is {found[0]} x {found[1]} px, expected {size[0]} x {size[1]}: use images of this "
            "sensor's camera; where its mode crops or bins them, say so in the file's [camera]"
        )
    halved = any(";16" in str(tile[3]) for tile in getattr(image, "tile", ())) and not image.mode.startswith("I")
    image.load()
    values, bits = UNTURNED[turned](_values(image)), None
    if image.format == "TIFF":
        tags = image.tag_v2  # type: ignore[attr-defined]
        stated = tags.get(BITS_PER_SAMPLE, (16,))[0]
        bits = stated if values.dtype == np.uint16 and stated < 16 else None
        if tags.get(PHOTOMETRIC) == WHITE_IS_ZERO and values.dtype != np.uint8:  # Pillow turns these alone round
            values = (HIGHEST if values.dtype == np.uint16 else 1) - values
    return Stored(values, bits, halved)


def stored_size(image: Image.Image) -> tuple[int, int]:
    """Return the width and height of an opened image as stored, px."""
    tags = image.tag_v2 if image.format == "TIFF" else {}  # type: ignore[attr-defined]
    return tags.get(WIDTH, image.width), tags.get(HEIGHT, image.height)


def _orientation(image: Image.Image) -> int:
    """Return the orientation that Pillow applies when it loads an image; it does so only for TIFF files."""
    stated = image.tag_v2.get(ORIENTATION, 1) if image.format == "TIFF" else 1  # type: ignore[attr-defined]
    return stated if stated in UNTURNED else 1


def refuse_damaged(image: Image.Image, content: bytes) -> None:
    """Refuse damage that the decoder ignores: wrong PNG or TIFF checksums, libjpeg warnings, wrong lengths in a WebP file.

    Args:
        image: an image that has been loaded.
        content: content of its file; for a JPEG that is one of several in a file, the content from its first byte on.

    Raises:
        ValueError: the image is damaged; for a PNG also other exceptions of `DAMAGE`.
    """
    if image.format == "PNG":
        with Image.open(BytesIO(content), formats=FORMATS) as twin:
            twin.verify()
    if image.format == "TIFF":
        refuse_damaged_page(image.tag_v2, file := BytesIO(content))  # type: ignore[attr-defined]
        refuse_displaced(image.tag_v2, file)  # type: ignore[attr-defined]
    if image.format == "WEBP" and not _fills_its_file(content):
        raise ValueError("its chunks do not add up to the length of the file")
    if image.format in ("JPEG", "MPO"):
        if any(0 in steps for steps in image.quantization.values()):  # type: ignore[attr-defined]
            raise ValueError("a quantisation table of the JPEG holds 0")
        if image.mode in ("L", "RGB") and not is_whole(content):
            raise ValueError("corrupt JPEG data")


def _fills_its_file(riff: bytes) -> bool:
    """Return whether the declared chunk lengths of a RIFF file add up to the length of the file."""
    at, end = 12, 8 + int.from_bytes(riff[4:8], "little")
    while at < end:
        size = int.from_bytes(riff[at + 4 : at + 8], "little")
        at += 8 + size + size % 2
    return at == end == len(riff)


def _values(image: Image.Image) -> np.ndarray:
    if image.mode == "I":  # 16-bit grey as Pillow of some versions opens it
        values = np.asarray(image)
        if values.min() < 0 or values.max() > HIGHEST:
            raise MembraneError(
                f"values from {values.min()} to {values.max()}; expected whole numbers from 0 to 65535, or float in 0..1: save "
                "the image with 8 or 16 bits"
            )
        return values.astype(np.uint16)
    if image.mode == "F" or image.mode.startswith("I;16"):
        values = np.asarray(image)
        return values.astype(values.dtype.newbyteorder("="))
    grey = image.mode in ("1", "L", "LA", "La")
    return np.asarray(image.convert("L" if grey else "RGB"))
