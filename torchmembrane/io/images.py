"""Images as grey values: 0.299 R + 0.587 G + 0.114 B in floating point, the same on every path."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from PIL import Image

from ..errors import MembraneError

GREY = (0.299, 0.587, 0.114)


def read_image(path: str | Path) -> np.ndarray:
    """An image file's grey values, float32 `[height, width]` in 0..1.

    Grey of 8 and 16 bits and of float (TIFF), RGB, palette, CMYK; alpha is ignored, of several frames the first is taken.
    EXIF orientation is not applied: pixels are the camera's own. Colour of 16 bits arrives as 8 bits (Pillow's limit).

    Args:
        path: the file.

    Returns:
        Grey values.

    Raises:
        MembraneError: the file is missing, no image, truncated or damaged; names the file and the cause.

    Example:
        >>> image = read_image("examples/rest.png")
        >>> image.shape, str(image.dtype), float(image.max()) <= 1
        ((480, 640), 'float32', True)
    """
    try:
        with Image.open(path) as image:
            image.load()
            return to_grey(_array(image))
    except FileNotFoundError as error:
        raise MembraneError(f"{path}: no such image; expected a readable image file, check the path") from error
    except (OSError, SyntaxError, ValueError, Image.DecompressionBombError) as error:
        raise MembraneError(f"{path}: not readable as an image ({error}); expected a whole PNG, JPEG or TIFF") from error


def mean_image(paths: Sequence[Path]) -> np.ndarray:
    """The mean of the grey values of image files of one size, float32 `[height, width]` in 0..1.

    Args:
        paths: one file or more.

    Raises:
        MembraneError: as `read_image`; or the images differ in size.
    """
    images = [read_image(path) for path in paths]
    for path, image in zip(paths, images, strict=True):
        if image.shape != images[0].shape:
            sizes = ["{1} x {0}".format(*shape) for shape in (image.shape, images[0].shape)]
            raise MembraneError(f"{path} is {sizes[0]} px; expected {sizes[1]} as {paths[0]}: give images of one camera mode")
    return np.asarray(np.mean(images, 0, dtype=np.float64)).astype(np.float32)


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
        array = array.astype(np.float64)
        array = GREY[0] * array[..., 0] + GREY[1] * array[..., 1] + GREY[2] * array[..., 2]
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
            path = stem.with_name(stem.name + ".png")
            Image.fromarray(levels).save(path)
            return path
    path = stem.with_name(stem.name + ".tiff")
    Image.fromarray(grey).save(path)
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
