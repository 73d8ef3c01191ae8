"""Images as grey values: 0.299 R + 0.587 G + 0.114 B in floating point, the same on every path."""

import io
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import numpy as np
from PIL import Image, UnidentifiedImageError

from ..errors import MembraneError
from .atomic import whole_file
from .safe_read import DAMAGE, in_one_line, read_bytes

FORMATS = ("PNG", "JPEG", "BMP", "TIFF", "WEBP")
WRITTEN = {".png": "PNG", ".tiff": "TIFF"}
MOST_PIXELS, MOST_IMAGE_BYTES = 2**25, 2**28
GREY = (0.299, 0.587, 0.114)


def read_image(path: str | Path, size: tuple[int, int] | None = None) -> np.ndarray:
    """An image file's grey values, float32 `[height, width]` in 0..1.

    Grey of 8 and 16 bits and of float (TIFF), RGB, palette, CMYK; alpha is ignored, of several frames the first is taken.
    EXIF orientation is not applied: pixels are the camera's own. Colour of 16 bits arrives as 8 bits (Pillow's limit). Whatever
    the decoders remark is an error: checksums of PNG, corrupt or missing data in JPEG, lengths that do not add up in WebP.

    Args:
        path: a PNG, JPEG, BMP, TIFF or WebP file.
        size: width and height that it must have, px; it is looked at before pixels are decoded.

    Returns:
        Grey values.

    Raises:
        MembraneError: the file is missing, no image, too large, of another size, truncated or damaged; names the file and the
            cause.

    Limitations:
        TIFF, BMP and WebP have no checksums, JPEG has none for what decodes without remark: damage that leaves the file well
        formed is not seen here.

    Example:
        >>> image = read_image("examples/rest.png")
        >>> image.shape, str(image.dtype), float(image.max()) <= 1
        ((480, 640), 'float32', True)
    """
    return decode_image(_content(path), path, size)


def decode_image(content: bytes, name: str | Path, size: tuple[int, int] | None = None) -> np.ndarray:
    """The grey values of an image file's content, as `read_image` gives them.

    Args:
        content: of a PNG, JPEG, BMP, TIFF or WebP file.
        name: what an error calls it.
        size: width and height that it must have, px.

    Raises:
        MembraneError: as `read_image`.
    """
    with _opened(name, content) as image:
        if size is not None and image.size != size:
            raise MembraneError(
                f"{name}: the image is {image.width} x {image.height} px, expected {size[0]} x {size[1]}: use images of this "
                "sensor's camera; where its mode crops or bins them, say so in the file's [camera]"
            )
        image.load()
        _refuse_damaged(image, content)
        return to_grey(_array(image))


def read_pixels(name: str | Path, content: bytes | None = None) -> np.ndarray:
    """The values of an image file as they are stored, `[height, width]` or `[height, width, 3]`.

    Args:
        name: its path.
        content: what the file holds; default: it is read.

    Raises:
        MembraneError: as `read_image`.

    Example:
        >>> read_pixels("examples/rest.png").dtype
        dtype('uint8')
    """
    content = _content(name) if content is None else content
    with _opened(name, content) as image:
        image.load()
        _refuse_damaged(image, content)
        return _array(image)


def image_size(path: str | Path) -> tuple[int, int]:
    """Width and height of an image file, px, without decoding its pixels.

    Args:
        path: as `read_image`.

    Raises:
        MembraneError: the file is missing, no image, or too large.

    Example:
        >>> image_size("examples/rest.png")
        (640, 480)
    """
    with _opened(path, _content(path)) as image:
        return image.size


def _content(path: str | Path) -> bytes:
    try:
        return read_bytes(Path(path), MOST_IMAGE_BYTES, "a readable image file")
    except MembraneError as error:
        raise MembraneError(str(error).replace("no such file", "no such image")) from error


@contextmanager
def _opened(path: str | Path, content: bytes) -> Iterator[Image.Image]:
    """An image whose header is read, from its file's content; whatever fails inside is an error that names the file."""
    expected = "a whole PNG, JPEG or TIFF"
    try:
        with Image.open(io.BytesIO(content), formats=FORMATS) as image:
            if image.width * image.height > MOST_PIXELS:
                raise ValueError(f"{image.width} x {image.height} px; at most {MOST_PIXELS} px are read")
            yield image
    except MembraneError as error:
        raise MembraneError(f"{path}: {str(error).removeprefix(f'{path}: ')}") from error
    except (*DAMAGE, Image.DecompressionBombError) as error:
        cause = "cannot identify image file" if isinstance(error, UnidentifiedImageError) else in_one_line(error)
        raise MembraneError(f"{path}: not readable as an image ({cause}); expected {expected}") from error


def _refuse_damaged(image: Image.Image, content: bytes) -> None:
    """Refuse what decoding passes over: wrong checksums of a PNG, what libjpeg only remarks of a JPEG."""
    if image.format == "PNG":
        with Image.open(io.BytesIO(content), formats=FORMATS) as twin:
            twin.verify()
    if image.format == "WEBP" and not _fills_its_file(content):
        raise ValueError("its chunks do not fill the file")
    if image.format in ("JPEG", "MPO") and image.mode in ("L", "RGB"):
        from kornia_rs.io import ImageDecoder

        try:
            ImageDecoder().decode_gray8(content)
        except Exception as error:  # it raises nothing narrower
            raise ValueError("corrupt JPEG data") from error


def _fills_its_file(riff: bytes) -> bool:
    """Whether the chunks of a RIFF file, one behind the other, are as long as they say together."""
    at, end = 12, 8 + int.from_bytes(riff[4:8], "little")
    while at < end:
        size = int.from_bytes(riff[at + 4 : at + 8], "little")
        at += 8 + size + size % 2
    return at == end == len(riff)


def mean_image(paths: Sequence[Path]) -> np.ndarray:
    """The mean of the grey values of image files of one size, float32 `[height, width]` in 0..1.

    Args:
        paths: one file or more.

    Raises:
        MembraneError: as `read_image`; or the images differ in size.
    """
    first = image_size(paths[0])
    for path in paths[1:]:
        if (size := image_size(path)) != first:
            sizes = ["{} x {}".format(*each) for each in (size, first)]
            raise MembraneError(f"{path} is {sizes[0]} px; expected {sizes[1]} as {paths[0]}: give images of one camera mode")
    total = np.zeros(first[::-1])
    for path in paths:
        total += read_image(path, first)
    return (total / len(paths)).astype(np.float32)


def to_grey(array: np.ndarray) -> np.ndarray:
    """Grey values of an array as float32 `[height, width]` in 0..1.

    Args:
        array: `[height, width]` grey or `[height, width, 3]` RGB; uint8 (0..255), uint16 (0..65535) or float (0..1).

    Raises:
        MembraneError: another shape or type, a value not finite or outside 0..1.

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
        white = np.iinfo(array.dtype).max
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


def write_image(stem: str | Path, grey: np.ndarray) -> Path:
    """Write grey values so that `read_image` gives the same bits.

    PNG of 8 or 16 bits where that holds the values exactly, else a TIFF of floats.

    Args:
        stem: the file without its ending, `.png` or `.tiff`.
        grey: `[height, width]` in 0..1.

    Returns:
        The path.

    Example:
        >>> from tempfile import TemporaryDirectory
        >>> with TemporaryDirectory() as folder:
        ...     path = write_image(f"{folder}/ramp", np.array([[0.0, 0.2, 1.0]], np.float32))
        ...     path.name, read_image(path).round(1).tolist()
        ('ramp.png', [[0.0, 0.20000000298023224, 1.0]])
    """
    stem = Path(stem)
    for depth in (np.uint8, np.uint16):
        levels = np.rint(grey.astype(np.float64) * np.iinfo(depth).max).astype(depth)
        if np.array_equal(to_grey(levels), grey):
            return _save(stem.with_name(stem.name + ".png"), levels)
    return _save(stem.with_name(stem.name + ".tiff"), grey)


def write_as_taken(stem: str | Path, image: np.ndarray) -> Path:
    """Write an image as a camera gave it, losslessly and fast.

    Args:
        stem: the file without its ending, `.png` or `.tiff`.
        image: `[height, width]` uint8 or uint16, `[height, width, 3]` uint8, or grey values as for `write_image`; of
            `[height, width, 3]` uint16 the grey values are written.

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
        image = to_grey(image)
    if image.dtype.kind == "f":
        return write_image(stem, image)
    return _save(Path(f"{stem}.png"), image, compress_level=1)


def _save(path: Path, image: np.ndarray, **options: int) -> Path:
    """Write an image, whole or not at all, in the format that the ending says."""
    with whole_file(path) as partial:
        Image.fromarray(np.ascontiguousarray(image)).save(partial, format=WRITTEN[path.suffix], **options)
    return path


def _array(image: Image.Image) -> np.ndarray:
    if image.mode == "I":  # 16-bit grey as Pillow of some versions opens it
        values = np.asarray(image)
        if values.min() < 0 or values.max() > 65535:
            raise ValueError(f"32-bit values from {values.min()} to {values.max()}; 8 or 16 bits are read")
        return values.astype(np.uint16)
    if image.mode == "F" or image.mode.startswith("I;16"):
        return np.asarray(image)
    grey = image.mode in ("1", "L", "LA", "La")
    return np.asarray(image.convert("L" if grey else "RGB"))
