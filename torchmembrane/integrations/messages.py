"""ROS 2 messages and what they say here: images to grey values, results to fields in N, N m, m and Pa.

A message is whatever has the fields of its type, of a bag (rosbags) or of a live system (rclpy). Frames are the camera's: its
optical frame, x right, y down, z forward.
"""

from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.polynomial.polynomial import polyval

from ..camera.model import Camera
from ..errors import MembraneError
from ..files.images import decode_image, to_grey
from ..results.reconstruction import Frame
from ..results.status import Status
from ..results.store import Mesh
from ..sensor.parts import METRE

CHANNELS = {
    **{"mono8": (np.uint8, 1, [0]), "8UC1": (np.uint8, 1, [0]), "mono16": (np.uint16, 1, [0]), "16UC1": (np.uint16, 1, [0])},
    **{"rgb8": (np.uint8, 3, [0, 1, 2]), "bgr8": (np.uint8, 3, [2, 1, 0]), "8UC3": (np.uint8, 3, [2, 1, 0])},
    **{"rgba8": (np.uint8, 4, [0, 1, 2]), "bgra8": (np.uint8, 4, [2, 1, 0]), "rgb16": (np.uint16, 3, [0, 1, 2])},
    **{"bgr16": (np.uint16, 3, [2, 1, 0])},
}
"""Of an image's encoding: the type of a value, values of a pixel, and which of them are grey, or red, green and blue."""
POINT_FIELDS = ("x", "y", "z", "normal_traction", "shear_x", "shear_y", "shear_z")
"""Of a vertex, each float32: place, m; compressive normal traction and shear traction on the membrane, Pa."""
SAME = 1.0
"""Pixels, rms over the image: by how much a CameraInfo may see the same ray elsewhere before it is said."""
SAMPLES = 32
"""Pixels of the image, in each direction, at which that is worked out."""
LENSES = {"plumb_bob": "pinhole", "rational_polynomial": "pinhole", "equidistant": "fisheye", "fisheye": "fisheye"}


def grey_of(message: Any, size: tuple[int, int]) -> np.ndarray:
    """Grey values `[height, width]` in 0..1 of a `sensor_msgs/Image` or `CompressedImage`.

    Args:
        message: the message.
        size: width and height that it must have, px.

    Raises:
        MembraneError: another size, an encoding without a grey or colour value for every pixel, or a damaged image.
    """
    if not hasattr(message, "encoding"):
        return decode_image(bytes(message.data), f"an image of format {message.format!r}", size)
    if message.encoding not in CHANNELS:
        raise MembraneError(f"image of encoding {message.encoding!r}; expected one of {', '.join(CHANNELS)}")
    kind, values, colours = CHANNELS[message.encoding]
    if (message.width, message.height) != size:
        raise MembraneError(f"the image is {message.width} x {message.height} px, the sensor's {size[0]} x {size[1]}")
    item = np.dtype(kind).newbyteorder(">" if message.is_bigendian else "<")
    rows, line = np.frombuffer(bytes(message.data), np.uint8), message.width * values * item.itemsize
    if message.step < line or len(rows) < message.step * message.height:
        raise MembraneError(f"the image has {len(rows)} bytes in lines of {message.step}; expected {message.height} of {line}")
    lines = rows[: message.step * message.height].reshape(message.height, message.step)[:, :line]
    pixels = np.ascontiguousarray(lines).view(item).reshape(message.height, message.width, values).astype(kind)
    return to_grey(pixels[..., 0] if len(colours) == 1 else pixels[..., colours])


def unlike(info: Any, camera: Camera) -> str | None:
    """By how many pixels the lens of a `sensor_msgs/CameraInfo` is off the sensor file's, in words.

    None: by no more than `SAME`, or it is not calibrated. Distortion counts, ports do not: a CameraInfo knows none.

    Raises:
        MembraneError: it is of images of another size.
    """
    width, height = camera.image_size
    if (info.width, info.height) != (width, height):
        raise MembraneError(f"CameraInfo is of {info.width} x {info.height} px images, the sensor file of {width} x {height}")
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
    """Where the lens of a CameraInfo sees `rays [..., 3]`, `[..., 2]` px; NaN behind a pinhole."""
    (f, _, u), (_, g, v) = np.asarray(info.k, float).reshape(3, 3)[:2]
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


class Wrench(NamedTuple):
    """Fields of a `geometry_msgs/Wrench`: `force [3]`, N, and `torque [3]` about the camera's centre of projection, N m."""

    force: np.ndarray
    torque: np.ndarray


class SiUnits:
    """A sensor's results in N, N m, m and Pa.

    Args:
        mesh: of the results.
        gas_pressure: `Sensor.gas_pressure`.

    Raises:
        MembraneError: its forces are relative.
    """

    def __init__(self, mesh: Mesh, gas_pressure: float | None = None):
        if mesh.force_unit != "N":
            raise MembraneError(
                f"forces of {mesh.name} are relative, messages are in newtons: add shear_modulus and thickness to the sensor "
                "file, or find them by `torchmembrane calibrate material --weight`"
            )
        self.metre = METRE[mesh.length_unit]
        self.gas_pressure = gas_pressure

    def wrench(self, frame: Frame) -> Wrench:
        """Of what touches the membrane, on it; from the frame's `wrench [6]`, N and N x length unit."""
        return Wrench(frame["wrench"][:3].astype(float), frame["wrench"][3:].astype(float) / self.metre)

    def points(self, frame: Frame) -> np.ndarray:
        """`[V, 7]` float32: `POINT_FIELDS` of every vertex; from its `vertices`, `normals` and `traction`, `[V, 3]` each."""
        traction, normals = frame["traction"] * self.metre**2, frame["normals"]
        along = (traction * normals).sum(-1, keepdims=True)
        return np.hstack([frame["vertices"] / self.metre, -along, traction - along * normals]).astype(np.float32)

    def pressure(self, frame: Frame) -> float | None:
        """Of the gas, absolute, Pa; from the frame's `pressure_change []`; None of a sensor without one."""
        if self.gas_pressure is None:
            return None
        return (self.gas_pressure + float(frame["pressure_change"])) * self.metre**2


def cloud_layout(points: np.ndarray) -> dict[str, Any]:
    """Fields of a `sensor_msgs/PointCloud2` with `points [V, 7]`, as `SiUnits.points` gives them, but for header and fields."""
    content, step = points.astype("<f4").tobytes(), 4 * len(POINT_FIELDS)
    shape = {"height": 1, "width": len(points), "is_bigendian": False, "point_step": step, "row_step": len(content)}
    return {**shape, "data": content, "is_dense": bool(np.isfinite(points).all())}


def has_wrench(frame: Frame) -> bool:
    """Whether a frame has a surface, and so messages."""
    return Status(int(frame["status"])).has_surface
