"""Image files read as grey frames with Pillow: one frame per picture, of a file with one or several pictures."""

import io
import re
import struct
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from hashlib import blake2b
from itertools import count, zip_longest
from math import nan
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from .errors import EdgeError, in_one_line, printable
from .session import grey
from .timestamps import time_in

SUFFIXES = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".webp", ".gif", ".pgm", ".ppm")
"""File extensions of the images that are taken from a folder."""
FORMATS = ("PNG", "JPEG", "BMP", "TIFF", "WEBP", "GIF", "PPM")
MOST_BYTES = 2**28
LONGEST_NAME = 251
"""Largest length of a frame name in bytes, such that a file NAME.npz can exist."""
EXPECTED = "a whole PNG, JPEG or TIFF"
KIND, OLD_KIND, WIDTH, HEIGHT, BITS, PHOTOMETRIC = 254, 255, 256, 257, 258, 262
DESCRIPTION, ORIENTATION, SAMPLE = 270, 274, 339
"""Tag numbers of a TIFF page."""
REDUCED_OR_MASK, OLD_REDUCED, WHITE_IS_ZERO, SIGNED = 0b101, 2, 0, 2
"""Values of the first, second, sixth and last of these tags."""
UNTURNED: dict[int, Callable[[np.ndarray], np.ndarray]] = {
    2: lambda values: values[:, ::-1],
    3: lambda values: values[::-1, ::-1],
    4: lambda values: values[::-1],
    5: lambda values: values.swapaxes(0, 1),
    6: lambda values: np.rot90(values),
    7: lambda values: values[::-1, ::-1].swapaxes(0, 1),
    8: lambda values: np.rot90(values, -1),
}
"""For each TIFF orientation, the function that undoes Pillow's rotation or reflection. Sensor cameras do not rotate images."""
IMAGEJ = re.compile(r"ImageJ=.*^images=(\d+)", re.DOTALL | re.MULTILINE)


class Frame(NamedTuple):
    """A frame to compute: `image [1, height, width]`, grey in 0..1, or a list with the image of each view; or the reason why
    there is none. `origin`: provenance of its file, as stored in the results; `lacking`: reason for each missing view, by name;
    its results are NaN."""

    name: str
    path: Path
    image: np.ndarray | list[np.ndarray] | None
    reason: str = ""
    origin: Mapping[str, Any] = {}
    lacking: Mapping[str, str] = {}

    def says(self, message: str) -> str:
        """Return a line of a message about this frame."""
        picture = "" if self.name == frame_name(self.path) else f", {self.name}"
        return printable(f"{self.path}{picture}: {message}")


def frames(path: Path, size: tuple[int, int], bits: int | None = None) -> Iterator[Frame]:
    """Yield the frames of a file: NAME for a single image, and NAME_000000, NAME_000001, ... for several pictures.

    Arguments: `size`, the required width and height; `bits`, the bit depth of the camera, if 16-bit files use fewer bits. An
        error in a picture is reported as the `reason` of its frame. Reduced copies in a TIFF (thumbnails) are skipped.
    """
    name = frame_name(path)
    if len(name.encode()) > LONGEST_NAME:
        reason = f"its name has {len(name.encode())} bytes; expected {LONGEST_NAME} at most: rename it"
        yield Frame(name, path, None, reason)
        return
    try:
        with _opened(path) as (image, content):
            _refuse_size(image, size)
            numbers, cut = _numbers(image, content)
            names = [f"{name}_{place:06d}" for place in range(len(numbers) + cut)]
            origin = _origin(path, content, time_in(path.stem) if len(names) == 1 else nan)
            for number, each in zip(numbers, names if len(names) > 1 else [name], strict=False):
                try:
                    yield Frame(each, path, _grey(image, number, size, bits), origin=origin)
                except EdgeError as error:
                    yield Frame(each, path, None, str(error))
            if cut:
                yield Frame(names[-1], path, None, f"the file ends early; whole pictures: {len(numbers)}")
    except EdgeError as error:
        yield Frame(name, path, None, str(error))


def view_frames(path: Path, views: Sequence[str], sizes: Sequence[tuple[int, int]], bits: int | None) -> Iterator[Frame]:
    """Yield the frames of several views that have files of their own, NAME_VIEW; `path` is the first view's file.

    A view without an image is left out of the frame; a frame without any image has the reasons.

    Raises:
        EdgeError: the file is not named after the first view.
    """
    ending = f"_{views[0]}"
    if not path.stem.endswith(ending):
        raise EdgeError(f"{printable(path)}: expected the first view's image, NAME{ending}{path.suffix}, beside the others'")
    files = [_existing(path.with_name(f"{path.stem.removesuffix(ending)}_{view}{path.suffix}")) for view in views]
    for each in zip_longest(*(frames(file, size, bits) for file, size in zip(files, sizes, strict=True))):
        shown = [frame for frame in each if frame is not None and frame.image is not None]
        lacking = {
            view: "no picture at this moment" if frame is None else frame.reason
            for view, frame in zip(views, each, strict=True)
            if frame is None or frame.image is None
        }
        if not shown:
            failed = next(frame for frame in each if frame is not None)
            reason = "; ".join(f"view {view}: {said}" for view, said in lacking.items())
            yield failed._replace(name=_of_first(path, failed), path=path, reason=reason)
            continue
        images = [
            np.full((1, height, width), nan, np.float32) if view in lacking else frame.image
            for view, frame, (width, height) in zip(views, each, sizes, strict=True)
        ]
        origin = {**shown[0].origin, "path": printable(path), **_joined([file for file in files if file.is_file()])}
        yield Frame(_of_first(path, shown[0]), path, images, origin=origin, lacking=lacking)


def _existing(path: Path) -> Path:
    """Return the path; if there is no such file, the only image of this name with another extension."""
    others = [] if path.exists() else [other for suffix in SUFFIXES if (other := path.with_suffix(suffix)).is_file()]
    return others[0] if len(others) == 1 else path


def _of_first(path: Path, frame: Frame) -> str:
    """Return the name of a frame of several views: the name of the first view's file, with the number of the picture."""
    return frame_name(path) + frame.name.removeprefix(frame_name(frame.path))


def _joined(files: Sequence[Path]) -> dict[str, Any]:
    """Return size, time and hash of all views' files, in the form of `_origin` for one file."""
    stats, digest = [file.stat() for file in files], blake2b(b"".join(file.read_bytes() for file in files), digest_size=16)
    sizes = {"file_size": sum(stat.st_size for stat in stats), "file_modified": max(stat.st_mtime_ns for stat in stats)}
    return sizes | {"content_hash": digest.hexdigest()}


def frame_name(path: Path) -> str:
    """Return the name of a file's frame: the file name without its extension, in UTF-8."""
    return printable(path.stem)


def _origin(path: Path, content: bytes, time: float) -> dict[str, Any]:
    """Return what the results store about their source file."""
    stat, digest = path.stat(), blake2b(content, digest_size=16).hexdigest()
    known = {"path": printable(path), "file_size": stat.st_size, "file_modified": stat.st_mtime_ns}
    return known | {"content_hash": digest, "time": time}


def numbered(name: str | Path) -> tuple[list[tuple[int, str]], str]:
    """Return a sort key for names or paths in which numbers are compared by value."""
    parts = re.split("([0-9]+)", str(name))  # texts at even places, numbers at odd ones
    digits = [part.lstrip("0") for part in parts]
    return [(len(digits[k]), digits[k]) if k % 2 else (-1, part) for k, part in enumerate(parts)], str(name)


def pictures(path: Path) -> int:
    """Return the number of pictures in a file; 0 if it cannot be read."""
    try:
        with _opened(path) as (image, content):
            return len(_numbers(image, content)[0])
    except EdgeError:
        return 0


@contextmanager
def _opened(path: Path) -> Iterator[tuple[Any, bytes]]:
    """Open an image and read its header; yield it and its file's content. Pillow's errors are raised as `EdgeError`."""
    from PIL import Image

    Image.MAX_IMAGE_PIXELS = None  # sizes are compared with the sensor's before pixels are decoded
    with _refused():
        if not path.is_file():
            raise ValueError("it is not a regular file")
        if path.stat().st_size > MOST_BYTES:
            raise ValueError(f"it holds {path.stat().st_size} bytes; at most {MOST_BYTES} are read")
        content = path.read_bytes()
        with warnings.catch_warnings():  # where the list of its pictures is damaged, its first is taken for the only one
            warnings.filterwarnings("error", "Image appears to be a malformed MPO")
            opened = Image.open(io.BytesIO(content), formats=FORMATS)
        with opened as image:
            if image.format == "PNG":
                with Image.open(io.BytesIO(content), formats=FORMATS) as twin:
                    twin.verify()  # its checksums
            yield image, content


@contextmanager
def _refused() -> Iterator[None]:
    """Raise any error of Pillow on damaged files, which have no common base class, as an `EdgeError`."""
    try:
        yield
    except EdgeError:
        raise
    except Exception as error:
        unknown = type(error).__name__ == "UnidentifiedImageError"
        cause = "cannot identify image file" if unknown else getattr(error, "strerror", None) or in_one_line(error)
        raise EdgeError(f"not readable as an image ({cause}); expected {EXPECTED}") from error


def _numbers(image: Any, content: bytes) -> tuple[list[int], bool]:
    """Return the indices of the pictures, in order, and whether the file is truncated after the last one unnoticed by Pillow.

    Auxiliary pictures are skipped: previews and masks in a TIFF, and pictures of another size in an MPO.
    """
    if image.format != "TIFF":
        cut = image.format == "GIF" and not content.rstrip(b"\0").endswith(b";")
        numbers = list(_sought(image)) if cut else list(range(getattr(image, "n_frames", 1)))
        if image.format == "MPO":
            size = image.size
            numbers = [number for number in numbers if not _is_preview(image, number, size)]
        return numbers, cut
    directories, cut = _directories(content)
    whole = []
    for number in range(max(directories, 1)):
        image.seek(number)
        if not image.tag_v2.get(KIND, 0) & REDUCED_OR_MASK and image.tag_v2.get(OLD_KIND) != OLD_REDUCED:
            whole.append(number)
    image.seek(0)
    told = IMAGEJ.match(str(image.tag_v2.get(DESCRIPTION, "")))
    if told and int(told[1]) > max(len(whole), 1) and not cut:  # of large files ImageJ leaves the pages out
        raise EdgeError(
            f"holds {told[1]} images by its ImageJ description, but {len(whole)} pages; expected one page per image"
        )
    return whole or [0], cut


def _is_preview(image: Any, number: int, size: tuple[int, int]) -> bool:
    """Return whether a picture of an MPO has another size than the first; False for a truncated picture, whose size is
    unknown."""
    with suppress(Exception):
        image.seek(number)
        return image.size != size
    return False


def _sought(image: Any) -> Iterator[int]:
    """Yield the indices of the pictures that can be reached."""
    with suppress(Exception):  # Pillow raises what it likes where a file is cut
        for number in count():
            image.seek(number)
            yield number


def _directories(tiff: bytes) -> tuple[int, bool]:
    """Return how many complete directories, one per picture, a TIFF has, and whether another should follow."""
    order, big = "<" if tiff.startswith(b"II") else ">", b"+" in tiff[2:4]
    (number, entry, place), at = ("Q", 20, "Q") if big else ("H", 12, "L"), 8 if big else 4
    seen: set[int] = set()
    try:
        (offset,) = struct.unpack_from(order + place, tiff, at)
        while offset and offset not in seen:
            (entries,) = struct.unpack_from(order + number, tiff, offset)
            (following,) = struct.unpack_from(order + place, tiff, offset + struct.calcsize(order + number) + entries * entry)
            seen.add(offset)
            offset = following
    except struct.error:
        return len(seen), True
    return len(seen), False


def _refuse_size(image: Any, size: tuple[int, int]) -> None:
    tags = image.tag_v2 if image.format == "TIFF" else {}
    width, height = tags.get(WIDTH, image.width), tags.get(HEIGHT, image.height)  # Pillow turns a TIFF's by its orientation
    if (width, height) != tuple(size):
        came = f"the image is {width} x {height} px"
        raise EdgeError(f"{came}, expected {size[0]} x {size[1]}: use images of this sensor's camera")


def _grey(image: Any, number: int, size: tuple[int, int], bits: int | None) -> np.ndarray:
    """Return one picture of an opened image as grey values `[1, height, width]`."""
    with _refused():
        image.seek(number)
        _refuse_size(image, size)
        tags = dict(image.tag_v2) if image.format == "TIFF" else {}
        depth = max(tags.get(BITS, (8,)))
        if SIGNED in tags.get(SAMPLE, ()) and depth <= 16:
            raise EdgeError("its values are signed integers; expected whole numbers from 0 to white, or float in 0..1")
        if image.mode in ("F", "I") or image.mode.startswith("I;16"):
            return _as_stored(_grey_of_more_bits(image, tags, bits), tags)
        wide = "16" in _layout(image)
        if (bits and wide) or (depth > 8 and not wide):
            raise EdgeError(
                "colour or alpha with more than 8 bits per channel is not supported; expected grey with 16 bits, or 8 bits"
            )
        values = np.asarray(image.convert("L" if image.mode in ("1", "L", "LA", "La") else "RGB"))  # alpha is ignored
        return _as_stored(grey(values[None]), tags)


def _as_stored(seen: np.ndarray, tags: Mapping[int, Any]) -> np.ndarray:
    """Return grey values `[1, height, width]` as stored in the file, with any rotation by Pillow undone."""
    turn = UNTURNED.get(tags.get(ORIENTATION, 1))
    return seen if turn is None else np.ascontiguousarray(turn(seen[0])[None])


def _grey_of_more_bits(image: Any, tags: Mapping[int, Any], bits: int | None) -> np.ndarray:
    """Return the grey values of integers of more than 8 bits, or of floats."""
    if tuple(tags.get(BITS, ())) == (12,):
        bits = 12
    elif image.tile and image.tile[0][0] == "ppm":  # Pillow multiplies what a PGM says is white to 65535
        bits = None
    values = np.asarray(image)
    low, high = values.min(), values.max()
    if image.mode == "F" and not (low >= 0 and high <= 1):
        raise EdgeError(f"float values from {low} to {high}; expected finite, in 0..1: divide by white")
    if image.mode == "I":  # also grey of 16 bits, as Pillow before 10.3 opens it
        if low < 0 or high > 65535:
            raise EdgeError(
                f"values from {low} to {high}; expected whole numbers from 0 to 65535: save the image with 8 or 16 bits"
            )
        values = values.astype(np.uint16)
    seen = grey(values[None], bits)
    return 1 - seen if tags.get(PHOTOMETRIC) == WHITE_IS_ZERO else seen


def _layout(image: Any) -> str:
    """Return the layout in which Pillow unpacks a file's values, such as "RGB;16B"."""
    given = image.tile[0][3] if image.tile else ""
    return str(given if isinstance(given, str) else given[0])
