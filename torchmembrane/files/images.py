"""Image files read as grey values, 0.299 R + 0.587 G + 0.114 B in floating point; all readers compute them in the same way."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from io import BytesIO
from itertools import islice
from pathlib import Path
from typing import IO

import numpy as np
from PIL import Image

from ..errors import MembraneError
from .atomic import whole_file
from .decoder import opened, pictures, refuse_damaged, stored, stored_size
from .levels import refuse_beyond, white_of
from .safe_read import DAMAGE, in_one_line, read_bytes, regular_size
from .tiff import refuse_damaged_page

MOST_IMAGE_BYTES, MOST_STACK_BYTES = 2**28, 2**32
"""Largest size in bytes of an image file, and of a multi-page TIFF, whose pages are read one by one."""
IMAGES = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".webp")
VIDEOS = (".mp4", ".m4v", ".mov", ".avi", ".mkv", ".webm", ".gif")
"""Endings of the files that are taken from a folder, and of those that are read as videos."""
MOST_PICTURES = 2**17
"""Largest number of pictures in a file."""
GREY = (0.299, 0.587, 0.114)


def read_image(path: str | Path, size: tuple[int, int] | None = None, bits: int | None = None) -> np.ndarray:
    """Return the grey values of an image file, float32 `[height, width]` in 0..1.

    Supported are grey images of 8 and 16 bits and of floats (TIFF), RGB, palette and CMYK; alpha is ignored. The EXIF
    orientation is not applied: pixels stay where the camera measured them. Colour of 16 bits is reduced to 8 bits (a limit of
    Pillow). Any decoder warning is an error, except for padding in a JPEG: wrong PNG checksums, corrupt or missing JPEG data,
    inconsistent lengths in a WebP file.

    Args:
        path: a PNG, JPEG, BMP, TIFF or WebP file with one picture.
        size: required width and height, px; checked before any pixel is decoded.
        bits: bit depth of the camera, if 16-bit files use fewer bits; None: as the file declares, or 16.

    Returns:
        Grey values.

    Raises:
        MembraneError: the file is missing, not an image, too large, of another size, truncated or damaged, or it has several
            pictures or values beyond `bits`; the message names the file and the cause.

    Limitations:
        TIFF, BMP, WebP and JPEG have no pixel checksums: damage that leaves such a file well formed is not detected.

    Example:
        >>> image = read_image("examples/rest.png")
        >>> image.shape, str(image.dtype), float(image.max()) <= 1
        ((480, 640), 'float32', True)
    """
    return decode_image(_content(path), path, size, bits)


def decode_image(content: bytes, name: str | Path, size: tuple[int, int] | None = None, bits: int | None = None) -> np.ndarray:
    """Return the grey values of an image file's content, as `read_image` does for a file.

    Args:
        content: content of a PNG, JPEG, BMP, TIFF or WebP file.
        name: name of the file in error messages.
        size: required width and height, px.
        bits: as for `read_image`.

    Raises:
        MembraneError: as for `read_image`.
    """
    with _opened_single(name, content) as image:
        grey = _grey_of(image, size, bits)
        refuse_damaged(image, content)
        return grey


def read_pixels(name: str | Path, content: bytes | None = None) -> np.ndarray:
    """Return the values of an image file as stored, `[height, width]` or `[height, width, 3]`.

    Args:
        name: path of the file.
        content: content of the file; default: it is read from `name`.

    Raises:
        MembraneError: as for `read_image`.

    Example:
        >>> read_pixels("examples/rest.png").dtype
        dtype('uint8')
    """
    content = _content(name) if content is None else content
    with _opened_single(name, content) as image:
        values = stored(image).values
        refuse_damaged(image, content)
        return values


def image_size(path: str | Path) -> tuple[int, int]:
    """Return the width and height of an image file, px, without decoding its pixels.

    Args:
        path: as for `read_image`.

    Raises:
        MembraneError: the file is missing, is not an image, is too large, or has several pictures.

    Example:
        >>> image_size("examples/rest.png")
        (640, 480)
    """
    with _opened_single(path, _content(path)) as image:
        return stored_size(image)


def picture_count(path: Path, most: int = MOST_PICTURES) -> int:
    """Return the number of pictures in a file, at most `most`: pages of a TIFF, frames of an animated PNG or WebP, or pictures
    of an MPO; 0 if the file is not an image that this package reads.

    Example:
        >>> picture_count(Path("examples/rest.png")), picture_count(Path("examples/sensor.toml"))
        (1, 0)
    """
    found = 0
    try:
        with _opened_stack(path) as (image, _):
            for _ in islice(pictures(image), most):
                found += 1
    except MembraneError:  # reading them says what it is
        pass
    return found


def stack_images(path: Path, size: tuple[int, int], bits: int | None = None) -> Iterator[np.ndarray | MembraneError]:
    """Yield the pictures of a file one by one as `read_image` returns them; for an unreadable picture, yield the error instead.

    Args:
        path: a PNG, JPEG, BMP, TIFF or WebP file with one or more pictures.
        size: required width and height, px.
        bits: as for `read_image`.

    Yields:
        Grey values, or an error that does not name the file.

    Raises:
        MembraneError: the file is not an image, is too large, or is so damaged that no further picture can be found.
    """
    number = 0
    with _opened_stack(path) as (image, file):
        content = b"" if image.format == "TIFF" else _content(path)
        try:
            if image.format not in ("MPO", "TIFF"):
                refuse_damaged(image, content)
            for _ in islice(pictures(image), MOST_PICTURES):
                yield _picture(image, size, bits, file, content)
                number += 1
        except DAMAGE as error:
            if isinstance(error, MembraneError):
                raise
            raise MembraneError(f"damaged, or ends early, after {number} pictures ({in_one_line(error)})") from error


def _picture(
    image: Image.Image, size: tuple[int, int], bits: int | None, file: IO[bytes], content: bytes
) -> np.ndarray | MembraneError:
    try:
        grey = _grey_of(image, size, bits)
        if image.format == "TIFF":
            refuse_damaged_page(image.tag_v2, file)  # type: ignore[attr-defined]
        if image.format == "MPO":
            refuse_damaged(image, content[image.offset :])  # type: ignore[attr-defined]
        return grey
    except MembraneError as error:
        return error
    except DAMAGE as error:
        return MembraneError(f"not readable as an image ({in_one_line(error)})")


def _grey_of(image: Image.Image, size: tuple[int, int] | None, bits: int | None) -> np.ndarray:
    """Return the grey values of the current picture."""
    found = stored(image, size)
    if found.halved and bits is not None:
        raise ValueError(
            f"it is colour with 16 bits per channel, of which 8 are read, so bits = {bits} does not apply: save it as grey"
        )
    return to_grey(found.values, found.bits or bits)


def _content(path: str | Path) -> bytes:
    try:
        return read_bytes(Path(path), MOST_IMAGE_BYTES, "a readable image file")
    except MembraneError as error:
        raise MembraneError(str(error).replace("no such file", "no such image")) from error


@contextmanager
def _opened_single(path: str | Path, content: bytes) -> Iterator[Image.Image]:
    """Open the image of a file that must have exactly one picture."""
    with opened(path, BytesIO(content)) as image:
        places = list(islice(pictures(image), MOST_PICTURES))
        if len(places) != 1:
            raise MembraneError(
                f"it holds {len(places)} pictures; expected one: save the one that is meant as a file of its own (reconstruct "
                "and live --images take all of them, as frames)"
            )
        if image.tell() != places[0]:
            image.seek(places[0])
        yield image


@contextmanager
def _opened_stack(path: Path) -> Iterator[tuple[Image.Image, IO[bytes]]]:
    """Open an image file that is read only as far as pictures are requested; yield the image and the file."""
    expected = "a readable image file"
    try:
        regular_size(path, MOST_STACK_BYTES, expected)
        file: IO[bytes] = open(path, "rb")
    except OSError as error:
        raise MembraneError(f"{path}: not readable ({in_one_line(error)}); expected {expected}") from error
    with file, opened(path, file) as image:
        yield image, file


def mean_image(paths: Sequence[Path], bits: int | None = None) -> np.ndarray:
    """Return the mean grey values of image files of one size, float32 `[height, width]` in 0..1.

    Args:
        paths: one or more files.
        bits: as for `read_image`.

    Raises:
        MembraneError: as for `read_image`; or the images have different sizes.
    """
    first = image_size(paths[0])
    for path in paths[1:]:
        if (size := image_size(path)) != first:
            sizes = ["{} x {}".format(*each) for each in (size, first)]
            raise MembraneError(f"{path} is {sizes[0]} px; expected {sizes[1]} as in {paths[0]}: give images of one size")
    total = np.zeros(first[::-1])
    for path in paths:
        total += read_image(path, first, bits)
    return (total / len(paths)).astype(np.float32)


def to_grey(array: np.ndarray, bits: int | None = None) -> np.ndarray:
    """Convert an array to grey values, float32 `[height, width]` in 0..1.

    Args:
        array: `[height, width]` grey or `[height, width, 3]` RGB; uint8 (0..255), uint16 (0..65535) or float (0..1).
        bits: bit depth of the camera, if uint16 values use fewer than 16 bits: white is `2^bits - 1`.

    Raises:
        MembraneError: the array has another shape or type, or a value that is not finite, outside 0..1 or beyond `bits`.

    Returns:
        Grey values.

    Example:
        >>> to_grey(np.array([[[255, 0, 0], [255, 255, 255]]], dtype=np.uint8)).tolist()
        [[0.29899999499320984, 1.0]]
    """
    array = np.asarray(array)
    if array.ndim not in (2, 3) or array.size == 0 or array.shape[2:] not in ((), (3,)):
        raise MembraneError(f"to_grey: shape {list(array.shape)}; expected [height, width] or [height, width, 3]")
    if array.dtype.kind == "f":
        low, high = array.min(), array.max()
        if not (low >= 0 and high <= 1):
            raise MembraneError(f"to_grey: float values from {low} to {high}; expected finite, in 0..1: divide by white")
        white = 1.0
    elif array.dtype.kind == "u" and array.dtype.itemsize <= 2:
        white = white_of(8 * array.dtype.itemsize, bits)
        refuse_beyond(array.max(), white)
    else:
        raise MembraneError(f"to_grey: values of type {array.dtype}; expected uint8, uint16 or float in 0..1")
    if array.ndim == 3:
        red, green, blue = (array[..., c] for c in range(3))
        array = GREY[0] * red.astype(np.float64)
        array += GREY[1] * green.astype(np.float64)
        array += GREY[2] * blue.astype(np.float64)
    if array.dtype.kind == "u":  # a float32 holds them, and the quotient is the rounded one
        return array.astype(np.float32) / np.float32(white)
    return (array.astype(np.float64) / white).astype(np.float32)


def write_image(stem: str | Path, grey: np.ndarray, bits: int | None = None) -> Path:
    """Write grey values to a file from which `read_image` returns the same numbers.

    The file is a PNG of 8 or 16 bits if that holds the values exactly, otherwise a TIFF of floats. It is written atomically.

    Args:
        stem: path of the file without its extension; `.png` or `.tiff` is added.
        grey: grey values `[height, width]` in 0..1.
        bits: bit depth of the camera that will be passed to `read_image`.

    Returns:
        The path of the file.

    Example:
        >>> from tempfile import TemporaryDirectory
        >>> with TemporaryDirectory() as folder:
        ...     path = write_image(f"{folder}/ramp", np.array([[0.0, 0.2, 1.0]], np.float32))
        ...     path.name, read_image(path).round(1).tolist()
        ('ramp.png', [[0.0, 0.20000000298023224, 1.0]])
    """
    for depth in (np.uint8, np.uint16):
        white = white_of(8 * np.dtype(depth).itemsize, bits)
        levels = np.rint(grey.astype(np.float64) * white).astype(depth)
        if np.array_equal(to_grey(levels, bits), grey):
            return _written(Path(f"{stem}.png"), levels)
    return _written(Path(f"{stem}.tiff"), grey)


def write_as_taken(stem: str | Path, image: np.ndarray, bits: int | None = None) -> Path:
    """Write an image exactly as the camera delivered it: lossless, fast and atomic.

    Args:
        stem: path of the file without its extension; `.png` or `.tiff` is added.
        image: `[height, width]` uint8 or uint16, `[height, width, 3]` uint8, or grey values as for `write_image`; for
            `[height, width, 3]` uint16 the grey values are written.
        bits: bit depth of the camera that will be passed to `read_image`.

    Returns:
        The path of the file.

    Example:
        >>> from tempfile import TemporaryDirectory
        >>> with TemporaryDirectory() as folder:
        ...     path = write_as_taken(f"{folder}/red", np.array([[[255, 0, 0]]], np.uint8))
        ...     path.name, read_image(path).round(3).tolist()
        ('red.png', [[0.29899999499320984]])
    """
    if image.dtype == np.uint16 and image.ndim == 3:
        image = to_grey(image, bits)
    if image.dtype.kind == "f":
        return write_image(stem, image, bits)
    return _written(Path(f"{stem}.png"), image, compress_level=1)


def _written(path: Path, values: np.ndarray, **options: int) -> Path:
    """Write an image atomically, in the format given by the extension of the file name."""
    with whole_file(path) as partial:
        Image.fromarray(np.ascontiguousarray(values)).save(partial, "TIFF" if path.suffix == ".tiff" else "PNG", **options)
    return path
