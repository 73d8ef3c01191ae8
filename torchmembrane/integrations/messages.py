"""ROS 2 camera messages: conversion of images to grey values, and comparison of lenses.

A message is any object with the fields of its type, from a bag (rosbags) or a live system (rclpy).
"""

from typing import Any

import numpy as np
import torch
from numpy.polynomial.polynomial import polyval

from ..camera.mode import Mode
from ..camera.model import Camera
from ..errors import MembraneError
from ..files.bayer import PATTERNS, demosaiced
from ..files.images import decode_image, read_pixels, to_grey

CHANNELS: dict[str, tuple[type[np.unsignedinteger[Any]], int, list[int]]] = {
    **{"mono8": (np.uint8, 1, [0]), "8UC1": (np.uint8, 1, [0]), "mono16": (np.uint16, 1, [0]), "16UC1": (np.uint16, 1, [0])},
    **{"rgb8": (np.uint8, 3, [0, 1, 2]), "bgr8": (np.uint8, 3, [2, 1, 0]), "8UC3": (np.uint8, 3, [2, 1, 0])},
    **{"rgba8": (np.uint8, 4, [0, 1, 2]), "bgra8": (np.uint8, 4, [2, 1, 0]), "8UC4": (np.uint8, 4, [2, 1, 0])},
    **{"rgb16": (np.uint16, 3, [0, 1, 2]), "bgr16": (np.uint16, 3, [2, 1, 0]), "16UC3": (np.uint16, 3, [2, 1, 0])},
    **{"rgba16": (np.uint16, 4, [0, 1, 2]), "bgra16": (np.uint16, 4, [2, 1, 0]), "16UC4": (np.uint16, 4, [2, 1, 0])},
    **{"yuv422_yuy2": (np.uint8, 2, [0]), "yuyv": (np.uint8, 2, [0])},
    **{"yuv422": (np.uint8, 2, [1]), "uyvy": (np.uint8, 2, [1])},
}
"""For each encoding: the type of a value, the number of values per pixel, and the indices of grey, or of red, green and
blue."""
PLANES = {"nv12": 1.5, "nv21": 1.5, "nv24": 3.0}
"""Encodings that store the grey values of all pixels first, then the colours: bytes per pixel."""
MOSAICS = {f"bayer_{pattern}{bits}": pattern for pattern in PATTERNS for bits in (8, 16)}
"""Bayer encodings, whose pixels measure one colour each: the colours of 2 x 2 pixels."""
SAME = 1.0
"""Largest rms difference over the image, px, between a CameraInfo and the sensor file that is not reported."""
SAMPLES = 32
"""Number of sample pixels in each direction for this comparison."""
LENSES = {"plumb_bob": "pinhole", "rational_polynomial": "pinhole", "equidistant": "fisheye", "fisheye": "fisheye"}


def grey_of(message: Any, size: tuple[int, int], bits: int | None = None) -> np.ndarray:
    """Return the grey values `[height, width]` in 0..1 of a `sensor_msgs/Image` or `CompressedImage`.

    For YUV the grey value is Y, as in `cv_bridge`; for a Bayer pattern the colours are interpolated first.

    Args:
        message: the message.
        size: required width and height, px.
        bits: bit depth of the camera, if 16-bit values use fewer bits.

    Raises:
        MembraneError: the image has another size, values beyond `bits`, an encoding without a grey or colour value for every
            pixel, or is damaged.
    """
    if not hasattr(message, "encoding"):
        return _grey_of_file(bytes(message.data), message.format, size, bits)
    encoding = message.encoding
    if not (encoding in CHANNELS or encoding in PLANES or encoding in MOSAICS):
        raise MembraneError(f"image of encoding {encoding!r}; expected one of {', '.join([*CHANNELS, *PLANES, *MOSAICS])}")
    if (message.width, message.height) != size:
        raise MembraneError(f"the image is {message.width} x {message.height} px, the sensor's {size[0]} x {size[1]}")
    kind, values, colours = CHANNELS.get(encoding, CHANNELS["mono16" if encoding.endswith("16") else "mono8"])
    pixels = _pixels(message, kind, values)
    grey = to_grey(pixels[..., colours[0] if len(colours) == 1 else colours], bits)
    return _grey_of_mosaic(grey, encoding) if encoding in MOSAICS else grey


def _pixels(message: Any, kind: type[np.unsignedinteger[Any]], values: int) -> np.ndarray:
    """Return the values `[height, width, values]` of an Image."""
    content, height, step = np.frombuffer(bytes(message.data), np.uint8), message.height, message.step
    item = np.dtype(kind).newbyteorder(">" if message.is_bigendian else "<")
    line, planes = message.width * values * item.itemsize, PLANES.get(message.encoding, 1.0)
    if planes > 1 and step > line and len(content) == planes * height * line:
        step = line  # of lines whose colours lie elsewhere, drivers count these or not
    if step < line or len(content) < planes * height * step:
        more = "" if planes == 1 else f", {planes} times that with the colours"
        raise MembraneError(f"the image has {len(content)} bytes in lines of {step}; expected {height} of {line}{more}")
    lines = content[: step * height].reshape(height, step)[:, :line]
    return np.ascontiguousarray(lines).view(item).reshape(height, message.width, values).astype(kind)


def _grey_of_file(content: bytes, form: str, size: tuple[int, int], bits: int | None) -> np.ndarray:
    """Return the grey values of a CompressedImage, whose format is "jpeg", "png", or "ENCODING; jpeg compressed ENCODING"."""
    encoding, _, packing = form.partition(";")
    if "compresseddepth" in form.lower():
        raise MembraneError(f"format {form!r} holds depths; expected an image: name the topic of the camera's images")
    grey = decode_image(content, f"an image of format {form!r}", size, bits)
    is_mosaic = encoding in MOSAICS and "bgr" not in packing and "rgb" not in packing
    return _grey_of_mosaic(grey, encoding) if is_mosaic else grey


def _grey_of_mosaic(mosaic: np.ndarray, encoding: str) -> np.ndarray:
    return to_grey(demosaiced(mosaic, MOSAICS[encoding]))


def size_of(message: Any) -> tuple[int, int]:
    """Return the width and height of a `sensor_msgs/Image` or `CompressedImage`, px.

    Raises:
        MembraneError: the image is damaged.
    """
    if hasattr(message, "encoding"):
        return message.width, message.height
    height, width = read_pixels(f"an image of format {message.format!r}", bytes(message.data)).shape[:2]
    return width, height


def info_topic(topic: str) -> str:
    """Return the CameraInfo topic that belongs to an image topic.

    Example:
        >>> info_topic("/finger/image_raw/compressed")
        '/finger/camera_info'
    """
    return f"{topic.removesuffix('/compressed').rpartition('/')[0]}/camera_info"


def mode_of(info: Any) -> Mode:
    """Return the camera mode that a `sensor_msgs/CameraInfo` describes.

    The calibrated image is cropped to `roi`, unless that is all 0, and then binned. The message's `width`, `height` and `k`
    refer to the calibrated image, before both (REP 104).
    """
    roi, binning = getattr(info, "roi", None), (getattr(info, "binning_x", 0) or 1, getattr(info, "binning_y", 0) or 1)
    left, top, width, height = (roi.x_offset, roi.y_offset, roi.width, roi.height) if roi is not None else (0, 0, 0, 0)
    crop = left, top, width or info.width - left, height or info.height - top
    (f, _, u), (_, g, v) = np.asarray(info.k, float).reshape(3, 3)[:2]
    return Mode((info.width, info.height), (f, g), (u, v), crop, binning)


def camera_mismatch(info: Any, camera: Camera) -> str | None:
    """Return in words by how many pixels the lens of a `sensor_msgs/CameraInfo` differs from the sensor file's.

    Return None if the difference is at most `SAME`, or if the CameraInfo is not calibrated. Distortion is included; ports are
    not, as a CameraInfo does not describe them.

    Raises:
        MembraneError: the CameraInfo is for images of another size.
    """
    width, height = camera.image_size
    mode = mode_of(info)
    if mode.size != (width, height):
        said = "{} x {} px images".format(*mode.size)
        if mode.size != mode.image_size:
            said += " (roi and binning of {} x {})".format(*mode.image_size)
        raise MembraneError(
            f"CameraInfo is of {said}, the sensor file of {width} x {height}: use the file of this camera; where its mode "
            "crops or bins, say so in the file's [camera]"
        )
    if info.k[0] == 0:
        return None
    if info.distortion_model not in LENSES:
        return f"CameraInfo: distortion_model {info.distortion_model!r} is not compared; expected one of {', '.join(LENSES)}"
    known = {"pinhole": 8, "fisheye": 4}[LENSES[info.distortion_model]]
    if any(info.d[known:]):
        return (
            f"CameraInfo: {info.distortion_model} with coefficients after the first {known} (thin prisms, tilt) is not compared"
        )
    pixels = np.stack(np.meshgrid(np.linspace(0, width - 1, SAMPLES), np.linspace(0, height - 1, SAMPLES)), -1)
    focal, centre, distortion = (each.tolist() for each in (camera.focal, camera.centre, camera.distortion))
    lens = Camera(camera.model, camera.image_size, focal, centre, distortion)
    rays = lens.pixel_to_ray(torch.from_numpy(pixels)).direction.numpy()
    apart = np.linalg.norm(projected(info, rays) - pixels, axis=-1)[np.isfinite(rays).all(-1)]
    apart = np.nan_to_num(apart, nan=np.inf).clip(max=np.hypot(width, height))
    rms = np.sqrt((apart**2).mean())
    if rms <= SAME:
        return None
    return (
        f"CameraInfo ({info.distortion_model}) sees what the sensor file ({camera.model}) does {rms:.1f} px off (rms over the "
        f"image, at most {apart.max():.1f}); used is the sensor file"
    )


def projected(info: Any, rays: np.ndarray) -> np.ndarray:
    """Project `rays [..., 3]` with the lens of a CameraInfo; return pixels `[..., 2]` of its mode.

    For a pinhole lens, rays with z <= 0 give NaN.
    """
    mode = mode_of(info)
    (f, g), (u, v) = mode.binned_focal, mode.binned_centre
    k = np.concatenate([np.asarray(info.d, float), np.zeros(8)])[:8]
    x, y, z = np.moveaxis(rays, -1, 0)
    if LENSES[info.distortion_model] == "fisheye":
        off_axis = np.hypot(x, y)
        angle = np.arctan2(off_axis, z)
        radius = angle * polyval(angle**2, [1, *k[:4]])
        along = radius / np.maximum(off_axis, np.finfo(float).tiny)
        x, y = x * along, y * along
    else:
        x, y = x / np.where(z > 0, z, np.nan), y / np.where(z > 0, z, np.nan)
        k1, k2, p1, p2, k3, k4, k5, k6 = k
        square = x * x + y * y
        radial = polyval(square, [1, k1, k2, k3]) / polyval(square, [1, k4, k5, k6])
        x, y = (
            x * radial + 2 * p1 * x * y + p2 * (square + 2 * x * x),
            y * radial + p1 * (square + 2 * y * y) + 2 * p2 * x * y,
        )
    return np.stack([f * x + u, g * y + v], -1)
