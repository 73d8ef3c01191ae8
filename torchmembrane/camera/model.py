"""From pixels to viewing rays and back: pinhole and fisheye lenses, optionally behind flat refractive layers.

Camera frame: origin at the centre of projection, +z along the optical axis towards the membrane, pixels (u right, v down) with
centres at integers. Points that a camera cannot see (behind it, where its lens folds back, or before the far face of its ports)
are NaN.
"""

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

from ..errors import MembraneError, check_arguments, expect, is_number
from ..files.decoder import MOST_PIXELS
from ..files.levels import check_bits
from ..torch_modes import on_cpu
from .distortion import fisheye_direction, fisheye_image, pinhole_direction, pinhole_image
from .mode import Mode
from .motion import ImageMotion
from .ports import MOST_INDEX, Layers, Port, apparent_points, check_ports, layers_of, refract

COEFFICIENTS = {"pinhole": 5, "fisheye": 4}  # k1 k2 p1 p2 k3 | k1 k2 k3 k4
RATIONAL = 8  # of a pinhole: k1 k2 p1 p2 k3 k4 k5 k6
FURTHER = (12, 14)  # OpenCV's, with thin prisms s1 to s4 and a tilted chip, which are not modelled
LONGEST_SIDE = 16384
"""Longest side of an image, px."""
FOCAL = (1.0, 1e6)
"""Least and greatest, px."""
MOST_ASPECT = 20.0
"""Largest ratio of the two focal lengths."""
FARTHEST_CENTRE, MOST_DISTORTION = 1e6, 1e6


class Rays(NamedTuple):
    """Half lines `x = origin + t direction`, t > 0.

    Attributes:
        origin: `[..., 3]`, length unit, camera frame.
        direction: `[..., 3]`, of length one.

    Example:
        >>> camera = Camera("pinhole", (640, 480), (400, 400), (320, 240))
        >>> camera.pixel_to_ray(torch.tensor([320.0, 240.0])).direction.tolist()
        [0.0, 0.0, 1.0]
    """

    origin: Tensor
    direction: Tensor


@check_arguments
@on_cpu
class Camera(ImageMotion, nn.Module):
    """A pinhole or fisheye camera, in air or looking through flat layers into a medium.

    The parameters are float64 buffers that enter the arithmetic directly, so `torch.func.functional_call` can
    differentiate with respect to any of them.

    Args:
        model: "pinhole" (OpenCV's k1 k2 p1 p2 k3, or eight, with k4 k5 k6) or "fisheye" (OpenCV's, Kannala-Brandt, k1 k2 k3
            k4; ROS calls it equidistant).
        image_size: width and height, px.
        focal: along u and v, px (fisheye: px / rad).
        centre: the principal point, px.
        distortion: coefficients; what is left off is zero, an empty list leaves the distortion out of the computation.
        ports: layers (distance, thickness, index) in order from the camera; the space before and between them is air.
        medium_index: refractive index of the medium behind the last port; ignored without ports.
        bits: significant bits of the pixel values, 8 to 16, for images stored in 16 bits with fewer; None: all stored bits.

    Attributes:
        focal: `[2]`, a float64 tensor, as all others.
        centre: `[2]`.
        distortion: `[0, 4, 5 or 8]`.
        port_distance: `[P]`.
        port_thickness: `[P]`.
        port_index: `[P]`.
        medium_index: `[]`.
        mode: the `Mode` that derived this camera from the calibrated one, else None; set by `in_mode`.

    Raises:
        MembraneError: a value is not finite or has the wrong sign, a count is wrong, or ports overlap.

    Limitations:
        Ports cannot be curved or tilted. The last 0.4 degrees before a distortion folds back count as not visible.

    Example:
        >>> camera = Camera("pinhole", (640, 480), (400, 400), (320, 240), ports=[(2, 3, 1.49)], medium_index=1.33)
        >>> origin, direction = camera.pixel_to_ray(torch.tensor([420.0, 240.0]))
        >>> camera.point_to_pixel(origin + 20 * direction).round(decimals=6).tolist()
        [420.0, 240.0]
    """

    focal: Tensor
    centre: Tensor
    distortion: Tensor
    port_distance: Tensor
    port_thickness: Tensor
    port_index: Tensor
    medium_index: Tensor

    def __init__(
        self,
        model: str,
        image_size: Sequence[int],
        focal: Sequence[float],
        centre: Sequence[float],
        distortion: Sequence[float] = (),
        ports: Sequence[Sequence[float]] = (),
        medium_index: float = 1.0,
        bits: int | None = None,
    ) -> None:
        super().__init__()
        _check_lens(model, image_size, focal, centre, distortion)
        expect(
            1 <= medium_index <= MOST_INDEX, "Camera: medium_index", medium_index, "1 (air) or more, at most 5; water has 1.33"
        )
        check_ports("Camera", ports)
        check_bits(bits)
        self.model = model
        self.image_size = (int(image_size[0]), int(image_size[1]))
        modelled = list(distortion[:RATIONAL])
        padding = [0.0] * (COEFFICIENTS[model] - len(modelled)) if modelled else []
        self._parameter("focal", list(focal))
        self._parameter("centre", list(centre))
        self._parameter("distortion", [*modelled, *padding])
        self._parameter("port_distance", [port[0] for port in ports])
        self._parameter("port_thickness", [port[1] for port in ports])
        self._parameter("port_index", [port[2] for port in ports])
        self._parameter("medium_index", medium_index)
        self.mode: Mode | None = None
        self.bits = None if bits is None else int(bits)

    def _parameter(self, name: str, value: float | list[float]) -> None:
        self.register_buffer(name, torch.tensor(value, dtype=torch.float64))

    @property
    def image_sizes(self) -> list[tuple[int, int]]:  # type: ignore[override]
        """Return the size of its image, in a list of one."""
        return [self.image_size]

    @property
    def ports(self) -> list[Port]:
        """Return the flat layers in order from the camera, as numbers."""
        rows = torch.stack([self.port_distance, self.port_thickness, self.port_index], -1)
        return [Port(*row) for row in rows.tolist()]

    @check_arguments
    def in_mode(self, crop: Sequence[float] | None = None, binning: float | Sequence[float] = 1) -> "Camera":
        """Return the camera whose images are cropped, then binned: it has the same rays at the mode's pixels.

        Args:
            crop: left, top, width and height of the part that is kept, px of this camera; None: the whole image.
            binning: size along u and v of a block whose mean becomes one pixel, px; one number for both.

        Returns:
            A camera with image size, focal lengths and centre of the mode, which is stored as its `mode`.

        Raises:
            MembraneError: the crop exceeds the image, or the blocks do not fill it.

        Example:
            >>> camera = Camera("pinhole", (640, 480), (400, 400), (320, 240)).in_mode((80, 0, 480, 480), 2)
            >>> camera.image_size, camera.focal.tolist(), camera.centre.tolist()
            ((240, 240), [200.0, 200.0], [119.75, 119.75])
        """
        part = (0, 0, *self.image_size) if crop is None else crop
        blocks: Any = (binning, binning) if is_number(binning) else binning
        mode = Mode.from_camera(self.image_size, self.focal.tolist(), self.centre.tolist(), part, blocks)
        lens = mode.size, mode.binned_focal, mode.binned_centre, self.distortion.tolist()
        made = Camera(self.model, *lens, ports=self.ports, medium_index=self.medium_index.item(), bits=self.bits)
        made.mode = mode
        return made

    def pixel_to_ray(self, pixels: Tensor) -> Rays:
        """Return the ray along which a pixel's light travels in the medium (section 2, eq. 2; section 5.2 through ports).

        Without ports the origins are zero. Behind ports, the refracted ray extended backwards meets the optical axis at its
        origin `(0, 0, z)`: see `ports.refract`. The result is smooth on the axis.

        Args:
            pixels: `[..., 2]`, px.

        Returns:
            `Rays` of `[..., 3]`; directions (behind ports also origins) are NaN where the lens does not image anything.

        Example:
            >>> camera = Camera("fisheye", (640, 480), (180, 180), (320, 240))
            >>> camera.pixel_to_ray(torch.tensor([320.0, 240.0])).direction.tolist()
            [0.0, 0.0, 1.0]
        """
        _check_vectors("Camera.pixel_to_ray: pixels", pixels, 2)
        image = (pixels - self.centre) / self.focal
        lens = pinhole_direction if self.model == "pinhole" else fisheye_direction
        direction = lens(image, self.distortion)
        if not len(self.port_index):
            return Rays(torch.zeros_like(direction), direction)
        return Rays(*refract(direction, self._layers(), self.medium_index))

    def point_to_pixel(self, points: Tensor) -> Tensor:
        """Return the pixel at which a point is seen.

        Args:
            points: `[..., 3]`, length unit, camera frame.

        Returns:
            `[..., 2]`, px; NaN behind the camera (fisheye without ports: only on the axis behind the camera, and where the lens
            folds back) and, with ports, for all points that are not beyond the far face of the last layer.

        Example:
            >>> camera = Camera("pinhole", (640, 480), (400, 400), (320, 240))
            >>> camera.point_to_pixel(torch.tensor([[1.0, -2.0, 8.0], [1.0, -2.0, -8.0]])).tolist()
            [[370.0, 140.0], [nan, nan]]
        """
        _check_vectors("Camera.point_to_pixel: points", points, 3)
        if len(self.port_index):
            points = apparent_points(points, self._layers(), self.medium_index)
        lens = pinhole_image if self.model == "pinhole" else fisheye_image
        return lens(points, self.distortion) * self.focal + self.centre

    def lines_of_sight(self, points: Tensor) -> Tensor:
        """Return the vectors from the centre of projection to points `[..., 3]`, without refraction: the points themselves."""
        return points

    def can_image(self, points: Tensor) -> Tensor:
        """Return whether points lie where the lens can image: in front of a pinhole, beyond the last port, around a fisheye.

        Args:
            points: `[..., 3]`, length unit, camera frame.

        Returns:
            `[...]` bool; points for which it is true may still be outside the image, or beyond the angle where the lens folds
            back.

        Example:
            >>> point = torch.tensor([9.0, 0.0, -1.0])
            >>> [Camera(model, (640, 480), (125, 125), (320, 240)).can_image(point).item() for model in COEFFICIENTS]
            [False, True]
        """
        if len(self.port_index):
            return points[..., 2] > self._layers().far
        if self.model == "pinhole":
            return points[..., 2] > 0
        return (points != 0).any(-1)

    def forward(self, points: Tensor) -> Tensor:
        """Return the same as `point_to_pixel`.

        Args:
            points: `[..., 3]`, length unit, camera frame.

        Returns:
            `[..., 2]`, px.
        """
        return self.point_to_pixel(points)

    def _layers(self) -> Layers:
        return layers_of(self.port_distance, self.port_thickness, self.port_index)


def _check_vectors(name: str, vectors: Tensor, count: int) -> None:
    if not isinstance(vectors, Tensor) or vectors.shape[-1:] != (count,):
        came = f"[{', '.join(map(str, vectors.shape))}]" if isinstance(vectors, Tensor) else f"a {type(vectors).__name__}"
        raise MembraneError(f"{name}: {came}; expected a tensor [..., {count}]")


def _check_lens(
    model: str, image_size: Sequence[int], focal: Sequence[float], centre: Sequence[float], distortion: Sequence[float]
) -> None:
    expect(model in COEFFICIENTS, "Camera: model", model, "'pinhole' or 'fisheye'")
    expect(len(focal) == 2, "Camera: focal", list(focal), "two values, along u and v (repeat it for square pixels)")
    expect(len(centre) == 2, "Camera: centre", list(centre), "two values, u and v")
    whole = len(image_size) == 2 and all(int(side) == side >= 1 for side in image_size)
    small = whole and max(image_size) <= LONGEST_SIDE and image_size[0] * image_size[1] <= MOST_PIXELS
    expected = f"width and height, whole pixels, 1 or more, each at most {LONGEST_SIDE}, together at most {MOST_PIXELS} px"
    expect(small, "Camera: image_size", list(image_size), expected)
    _check_count(model, list(distortion))
    for name, values in (("focal", focal), ("centre", centre), ("distortion", distortion)):
        expect(all(map(math.isfinite, values)), f"Camera: {name}", list(values), "finite numbers")
    least, most_focal = FOCAL
    expected = f"positive values (without eq. 1's sign), from {least:g} to {most_focal:g} px"
    expect(min(focal) >= least and max(focal) <= most_focal, "Camera: focal", list(focal), expected)
    alike = max(focal) <= MOST_ASPECT * min(focal)
    expect(alike, "Camera: focal", list(focal), f"two values, the larger at most {MOST_ASPECT:g} times the smaller")
    for name, values, limit in (("centre", centre, FARTHEST_CENTRE), ("distortion", distortion, MOST_DISTORTION)):
        expect(max(map(abs, values), default=0) <= limit, f"Camera: {name}", list(values), f"values up to {limit:g}")


def _check_count(model: str, distortion: list[float]) -> None:
    most, count = "k1 k2 k3 k4", len(distortion)
    if model == "pinhole":
        most = "k1 k2 p1 p2 k3, or these and k4 k5 k6"
        expected = "zeros after the eighth coefficient: thin prisms and tilt are not modelled, calibrate without them"
        expect(count not in FURTHER or not any(distortion[RATIONAL:]), "Camera: distortion", distortion, expected)
    fits = count <= COEFFICIENTS[model] or (model == "pinhole" and count in (RATIONAL, *FURTHER))
    expect(fits, "Camera: distortion", distortion, f"for a {model} at most {most}")
