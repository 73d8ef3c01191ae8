"""Image files as cameras write them, where Pillow writes none."""

import io
import struct

import numpy as np
from PIL import Image


def levels(count: int, shape=(24, 32), seed: int = 0) -> list[np.ndarray]:
    """Random images of 8 bits."""
    return list(np.random.default_rng(seed).integers(0, 256, (count, *shape), dtype=np.uint8))


def saved(path, images: list[Image.Image], **options):
    """A file of several pictures; returns its path."""
    first, *others = (image.copy() for image in images)  # Pillow's encoders leave their settings in images
    first.save(path, save_all=True, append_images=others, **options)
    return path


def tiff(pages: list[tuple[np.ndarray, dict[int, int | str]]]) -> bytes:
    """A TIFF of uncompressed grey pages, each with further tags; 16 bits or 32-bit float, or whatever tag 258 says."""
    out = bytearray(b"II*\0\0\0\0\0")
    link = 4
    for array, more in pages:
        data = array.tobytes()
        at = len(out)
        out += data
        kind = 3 if array.dtype.kind == "f" else 1
        tags: dict[int, int | str] = {256: array.shape[1], 257: array.shape[0], 258: 8 * array.dtype.itemsize, 259: 1, 262: 1}
        tags |= {273: at, 277: 1, 278: array.shape[0], 279: len(data), 339: kind} | more
        entries = b""
        for tag, value in sorted(tags.items()):
            if isinstance(value, str):
                text = value.encode() + b"\0"
                entries += struct.pack("<HHII", tag, 2, len(text), len(out))
                out += text + b"\0" * (len(text) % 2)
            else:
                entries += struct.pack("<HHII", tag, 4, 1, value)
        out[link : link + 4] = struct.pack("<I", len(out))
        out += struct.pack("<H", len(tags)) + entries
        link = len(out)
        out += bytes(4)
    return bytes(out)


def packed_12_bits(array: np.ndarray) -> np.ndarray:
    """Values of 12 bits, two in three bytes, `[height, 1.5 width]`."""
    first, second = array[:, ::2].astype(int), array[:, 1::2].astype(int)
    parts = [first >> 4, (first & 15) << 4 | second >> 8, second & 255]
    return np.stack(parts, -1).astype(np.uint8).reshape(len(array), -1)


def jpeg(image: Image.Image, **options) -> bytes:
    """Its JPEG file's content."""
    file = io.BytesIO()
    image.save(file, "JPEG", quality=90, **options)
    return file.getvalue()
