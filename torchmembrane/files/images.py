"""Image files as grey values, 0.299 R + 0.587 G + 0.114 B in floating point, computed in the same way everywhere."""

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
"""Largest file; largest TIFF of several pages, which are read one by one."""
MOST_PICTURES = 2**17
"""In a file."""
GREY = (0.299, 0.587, 0.114)


def read_image(path: str | Path, size: tuple[int, int] | None = None, bits: int | None = None) -> np.ndarray:
    """An image file's grey values, float32 `[height, width]` in 0..1.

    Grey of 8 and 16 bits and of float (TIFF), RGB, palette, CMYK; alpha is ignored. EXIF orientation is not applied: pixels are
    the camera's own. Colour of 16 bits arrives as 8 bits (Pillow's limit). Any warning of a decoder is an error, except for
    padding in a JPEG: wrong checksums of PNG, corrupt or missing data in JPEG, inconsistent lengths in WebP.

    Args:
        path: a PNG, JPEG, BMP, TIFF or WebP file with one picture.
        size: width and height that it must have, px; it is looked at before pixels are decoded.
        bits: bits of the camera, where 16-bit files hold fewer; None: as the file says, or 16.

    Returns:
        Grey values.

    Raises:
        MembraneError: the file is missing, no image, too large, of another size, truncated or damaged, or it has several
            pictures or values beyond `bits`; names the file and the cause.

    Limitations:
        TIFF, BMP, WebP and JPEG have no checksums of their pixels: damage that leaves the file well formed is not noticed here.

    Example:
        >>> image = read_image("examples/rest.png")
        >>> image.shape, str(image.dtype), float(image.max()) <= 1
        ((480, 640), 'float32', True)
    """
    return decode_image(_content(path), path, size, bits)


def decode_image(content: bytes, name: str | Path, size: tuple[int, int] | None = None, bits: int | None = None) -> np.ndarray:
    """The grey values of an image file's content, as `read_image` gives them.

    Args:
        content: content of a PNG, JPEG, BMP, TIFF or WebP file.
        name: what an error calls it.
        size: width and height that it must have, px.
        bits: as for `read_image`.

    Raises:
        MembraneError: as for `read_image`.
    """
    with _opened_single(name, content) as image:
        grey = _grey_of(image, size, bits)
        refuse_damaged(image, content)
        return grey


def read_pixels(name: str | Path, content: bytes | None = None) -> np.ndarray:
    """The values of an image file as they are stored, `[height, width]` or `[height, width, 3]`.

    Args:
        name: its path.
        content: what the file holds; default: it is read.

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
    """Width and height of an image file, px, without decoding its pixels.

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
    """How many pictures a file has, up to so many: pages of a TIFF, frames of an animated PNG or WebP, pictures of an MPO; 0
    where it is no image that is read here.

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
    """The pictures of a file one after another, as `read_image` gives one; in place of one that cannot be read, the error.

    Args:
        path: a PNG, JPEG, BMP, TIFF or WebP file of one picture or more.
        size: width and height that they must have, px.
        bits: as for `read_image`.

    Yields:
        Grey values, or an error that does not name the file.

    Raises:
        MembraneError: the file is no image, too large, or damaged so that no further picture is found.
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
    """The current picture's grey values."""
    found = stored(image, size)
    if found.halved and bits is not None:
        raise ValueError(f"its values are colour of 16 bits, of which 8 are read, so bits = {bits} is lost: save them as grey")
    return to_grey(found.values, found.bits or bits)


def _content(path: str | Path) -> bytes:
    try:
        return read_bytes(Path(path), MOST_IMAGE_BYTES, "a readable image file")
    except MembraneError as error:
        raise MembraneError(str(error).replace("no such file", "no such image")) from error


@contextmanager
def _opened_single(path: str | Path, content: bytes) -> Iterator[Image.Image]:
    """The image of a file that must have one picture."""
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
    """The image of a file, which is read only as far as pictures are asked for, and the file."""
    expected = "a readable image file"
    try:
        regular_size(path, MOST_STACK_BYTES, expected)
        file: IO[bytes] = open(path, "rb")
    except OSError as error:
        raise MembraneError(f"{path}: not readable ({in_one_line(error)}); expected {expected}") from error
    with file, opened(path, file) as image:
        yield image, file


def mean_image(paths: Sequence[Path], bits: int | None = None) -> np.ndarray:
    """The mean of the grey values of image files of one size, float32 `[height, width]` in 0..1.

    Args:
        paths: one file or more.
        bits: as for `read_image`.

    Raises:
        MembraneError: as for `read_image`; or the images differ in size.
    """
    first = image_size(paths[0])
    for path in paths[1:]:
        if (size := image_size(path)) != first:
            sizes = ["{} x {}".format(*each) for each in (size, first)]
            raise MembraneError(f"{path} is {sizes[0]} px; expected {sizes[1]} as in {paths[0]}: give images of one mode")
    total = np.zeros(first[::-1])
    for path in paths:
        total += read_image(path, first, bits)
    return (total / len(paths)).astype(np.float32)


def to_grey(array: np.ndarray, bits: int | None = None) -> np.ndarray:
    """Grey values of an array as float32 `[height, width]` in 0..1.

    Args:
        array: `[height, width]` grey or `[height, width, 3]` RGB; uint8 (0..255), uint16 (0..65535) or float (0..1).
        bits: bits of the camera, where a uint16 holds fewer: white is `2^bits - 1`.

    Raises:
        MembraneError: another shape or type, a value not finite, outside 0..1 or beyond `bits`.

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
    """Write grey values so that `read_image` gives the same numbers.

    PNG of 8 or 16 bits where that holds the values exactly, else a TIFF of floats. The file is written atomically.

    Args:
        stem: the file without its ending, `.png` or `.tiff`.
        grey: `[height, width]` in 0..1.
        bits: bits of the camera, with which it will be read.

    Returns:
        The path.

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
    """Write an image as a camera gave it, losslessly, fast and atomically.

    Args:
        stem: the file without its ending, `.png` or `.tiff`.
        image: `[height, width]` uint8 or uint16, `[height, width, 3]` uint8, or grey values as for `write_image`; of
            `[height, width, 3]` uint16 the grey values are written.
        bits: bits of the camera, with which it will be read.

    Returns:
        The path.

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
    """Write an image atomically, in the format of the file name's ending."""
    with whole_file(path) as partial:
        Image.fromarray(np.ascontiguousarray(values)).save(partial, "TIFF" if path.suffix == ".tiff" else "PNG", **options)
    return path
