"""Pixels to viewing rays and back: pinhole and fisheye lenses, optionally behind flat refractive layers.

Camera frame: origin at the centre of projection, +z the optical axis towards the membrane, pixels (u right, v down)
with centres at integers. What a camera cannot see (behind it, where its lens folds, before a port's far face) is NaN.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor, nn

from ..errors import MembraneError
from .distortion import fisheye_direction, fisheye_image, pinhole_direction, pinhole_image

COEFFICIENTS = {"pinhole": 5, "fisheye": 4}  # k1 k2 p1 p2 k3 | k1 k2 k3 k4
PORT_STEPS = 10  # Newton steps to the refracted ray of a point


class Rays(NamedTuple):
    """Half lines `x = origin + t direction`, t > 0: both `[..., 3]`, directions of length one."""

    origin: Tensor
    direction: Tensor


class Port(NamedTuple):
    """A flat layer normal to the axis: distance of its near face and thickness (length unit), refractive index."""

    distance: float
    thickness: float
    index: float


class Camera(nn.Module):
    """A pinhole or fisheye camera, central in air or looking through flat layers into a medium.

    The parameters are float64 buffers that enter the arithmetic directly, so `torch.func.functional_call` can
    differentiate with respect to any of them: `focal [2]`, `centre [2]`, `distortion [0, 4 or 5]`,
    `port_distance [P]`, `port_thickness [P]`, `port_index [P]`, `medium_index []`.

    Args:
        model: "pinhole" (OpenCV's k1 k2 p1 p2 k3) or "fisheye" (OpenCV's, Kannala-Brandt, k1 k2 k3 k4).
        image_size: width and height, px.
        focal: along u and v, px (fisheye: px / rad).
        centre: the principal point, px.
        distortion: coefficients; what is left off is zero, an empty list leaves the distortion out of the computation.
        ports: layers (distance, thickness, index) in order from the camera; what lies before and between them is air.
        medium_index: refractive index of all that follows the last port; without ports it plays no part.

    Wrong when a port is curved or tilted. The last 0.4 degrees before a distortion folds back count as not seen.

    Raises:
        MembraneError: a value is not finite, of the wrong count or sign, or ports overlap.

    >>> camera = Camera("pinhole", (640, 480), (400, 400), (320, 240), ports=[(2, 3, 1.49)], medium_index=1.33)
    >>> origin, direction = camera.pixel_to_ray(torch.tensor([420.0, 240.0]))
    >>> camera.point_to_pixel(origin + 20 * direction).round(decimals=6).tolist()
    [420.0, 240.0]
    """

    def __init__(
        self,
        model: str,
        image_size: Sequence[int],
        focal: Sequence[float],
        centre: Sequence[float],
        distortion: Sequence[float] = (),
        ports: Sequence[Sequence[float]] = (),
        medium_index: float = 1.0,
    ):
        super().__init__()
        _check(model, image_size, focal, centre, distortion, ports, medium_index)
        self.model = model
        self.image_size = (int(image_size[0]), int(image_size[1]))
        padding = [0.0] * (COEFFICIENTS[model] - len(distortion)) if len(distortion) else []
        self._parameter("focal", list(focal))
        self._parameter("centre", list(centre))
        self._parameter("distortion", [*distortion, *padding])
        self._parameter("port_distance", [port[0] for port in ports])
        self._parameter("port_thickness", [port[1] for port in ports])
        self._parameter("port_index", [port[2] for port in ports])
        self._parameter("medium_index", medium_index)

    def _parameter(self, name: str, value: float | list[float]) -> None:
        self.register_buffer(name, torch.tensor(value, dtype=torch.float64))

    @property
    def ports(self) -> list[Port]:
        """The flat layers in order from the camera, as numbers."""
        rows = torch.stack([self.port_distance, self.port_thickness, self.port_index], -1)
        return [Port(*row) for row in rows.tolist()]

    def pixel_to_ray(self, pixels: Tensor) -> Rays:
        """The ray on which a pixel's light travels in the medium.

        Without ports origins are zero. Behind ports the refracted ray, prolonged backwards, meets the optical axis at
        its origin `(0, 0, z)`. Snell's law along layers of height h_i and index n_i, with `s = (s_x, s_y)` the ray's
        transverse direction in air and n the medium's index, gives `z = sum_i h_i (1 - sqrt((n^2 - s^2) /
        (n_i^2 - s^2)))` and the direction `(s_x, s_y, sqrt(n^2 - s^2)) / n`, smooth on the axis.

        Args:
            pixels: `[..., 2]`, px.

        Returns:
            `Rays` of `[..., 3]`; directions (behind ports origins too) NaN where the lens does not image anything.
        """
        image = (pixels - self.centre) / self.focal
        lens = pinhole_direction if self.model == "pinhole" else fisheye_direction
        direction = lens(image, self.distortion)
        if not len(self.port_index):
            return Rays(torch.zeros_like(direction), direction)
        return self._refract(direction)

    def point_to_pixel(self, points: Tensor) -> Tensor:
        """The pixel at which a point is seen.

        Args:
            points: `[..., 3]`, length unit, camera frame.

        Returns:
            `[..., 2]`, px; NaN behind the camera (fisheye without ports: only at the axis' far half and where the lens
            folds), and behind ports NaN for all that is not beyond the last layer's far face.
        """
        if len(self.port_index):
            points = self._apparent(points)
        lens = pinhole_image if self.model == "pinhole" else fisheye_image
        return lens(points, self.distortion) * self.focal + self.centre

    def forward(self, points: Tensor) -> Tensor:
        """The same as `point_to_pixel`."""
        return self.point_to_pixel(points)

    def _layers(self) -> tuple[Tensor, Tensor, Tensor]:
        """Heights and indices of gaps and ports, `[2 P]`, and the depth of the last far face."""
        far = self.port_distance + self.port_thickness
        gaps = self.port_distance - torch.cat([torch.zeros_like(far[:1]), far[:-1]])
        heights = torch.cat([gaps, self.port_thickness])
        return heights, torch.cat([torch.ones_like(gaps), self.port_index]), far[-1]

    def _refract(self, direction: Tensor) -> Rays:
        heights, index, _ = self._layers()
        ahead = direction[..., 2:] > 0
        cosine_squared = torch.where(ahead, direction[..., 2:], 1.0) ** 2
        n = self.medium_index
        inside = (n**2 - 1 + cosine_squared).sqrt()  # n cos of the angle in the medium
        slant = inside / (index**2 - 1 + cosine_squared).sqrt()
        axis_depth = (heights * (1 - slant)).sum(-1, keepdim=True)
        origin = torch.cat([torch.zeros_like(direction[..., :2]), axis_depth], -1)
        refracted = torch.cat([direction[..., :2], inside], -1) / n
        return Rays(torch.where(ahead, origin, math.nan), torch.where(ahead, refracted, math.nan))

    def _apparent(self, points: Tensor) -> Tensor:
        """A point at z = 1 in the direction, in air, from which the light of `points` enters the lens.

        With rho the distance from the axis and w = tan(angle in air) / rho, Snell's law is `g(w) = 0`,
        `g(w) = sum_i h_i w / sqrt(n_i^2 + (n_i^2 - 1) rho^2 w^2) - 1`, concave and increasing for n_i >= 1, and
        g(1 / z) <= 0: Newton from 1 / z is monotone. Only rho^2 appears, so that nothing happens on the axis.
        """
        heights, index, far = self._layers()
        xy, z = points[..., :2], points[..., 2:]
        beyond = z > far
        depth = torch.where(beyond, z - far, 1.0)
        heights = torch.cat([heights.expand(*depth.shape[:-1], -1), depth], -1)
        squared = torch.cat([index, self.medium_index[None]]) ** 2
        rho_squared = (xy * xy).sum(-1, keepdim=True)
        w = 1 / torch.where(beyond, z, 1.0)
        for _ in range(PORT_STEPS):
            optical = (squared + (squared - 1) * rho_squared * w * w).rsqrt()
            value = (heights * optical).sum(-1, keepdim=True) * w - 1
            slope = (heights * squared * optical**3).sum(-1, keepdim=True)
            w = w - value / slope
        return torch.where(beyond, torch.cat([xy * w, torch.ones_like(w)], -1), math.nan)


def paper_image_point(points: Tensor, focal: Tensor | float) -> Tensor:
    """The paper's eq. 1, `u = -f x / z, v = -f y / z`, points `[..., 3]` to `[..., 2]` in the unit of the focal length.

    The paper looks at the inverted image behind the lens. Everything else here uses the computer-vision convention,
    `u = f x / z + c`, so that `pixel = centre - paper_image_point(points, focal)` for an undistorted pinhole in air.
    """
    return -focal * points[..., :2] / points[..., 2:]


def _check(model, image_size, focal, centre, distortion, ports, medium_index) -> None:
    _expect(model in COEFFICIENTS, "model", model, "'pinhole' or 'fisheye'")
    _expect(len(focal) == 2, "focal", focal, "two values, along u and v (repeat it for square pixels)")
    _expect(len(centre) == 2, "centre", centre, "two values, u and v")
    whole = len(image_size) == 2 and all(int(side) == side >= 1 for side in image_size)
    _expect(whole, "image_size", image_size, "width and height, whole pixels, 1 or more")
    most = "k1 k2 p1 p2 k3" if model == "pinhole" else "k1 k2 k3 k4"
    _expect(len(distortion) <= COEFFICIENTS[model], "distortion", distortion, f"for a {model} at most {most}")
    for name, values in (("focal", focal), ("centre", centre), ("distortion", distortion)):
        _expect(all(map(math.isfinite, values)), name, values, "finite numbers")
    _expect(min(focal) > 0, "focal", focal, "positive values (without eq. 1's sign)")
    _expect(1 <= medium_index < math.inf, "medium_index", medium_index, "1 (air) or more; water has 1.33")
    face = 0.0
    for i, port in enumerate(ports):
        finite = len(port) == 3 and all(map(math.isfinite, port))
        _expect(finite, f"ports[{i}]", port, "distance, thickness, index, all finite")
        distance, thickness, index = port
        _expect(thickness > 0, f"ports[{i}].thickness", thickness, "a positive length")
        _expect(index >= 1, f"ports[{i}].index", index, "1 (air) or more; Plexiglas has 1.49")
        order = f"more than 0 and at least {face}, where the layer before it ends: list ports in order from the camera"
        _expect(distance > 0 and distance >= face * (1 - 1e-12), f"ports[{i}].distance", distance, order)
        face = distance + thickness


def _expect(right: bool, name: str, value: object, expected: str) -> None:
    if not right:
        shown = value if isinstance(value, str | int | float) else list(value)
        raise MembraneError(f"Camera: {name} is {shown!r}; expected {expected}")
