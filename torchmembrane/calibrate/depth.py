"""The rest surface from a depth image that is registered to the sensor's camera; dots placed on it."""

from typing import NamedTuple

import numpy as np
import torch

from ..errors import MembraneError
from ..markers.placement import rim_mask
from ..sensor.model import Sensor
from .surface import Correction, Feet, correction, feet_of, fine_surface, recalibrated
from .views import placed_dots

CELL = 24  # px: over such squares depths are averaged
FEWEST = 8  # depths in a square
NEAR = 0.1  # of the surface's size: depths farther from the design are of something else


class DepthFit(NamedTuple):
    """The sensor with the surface of a depth image: `Correction` of the design, and what it rests on: `Feet [N]` of squares of
    depths on the designed surface, and the standard deviations of their heights `[N]`, length unit."""

    sensor: Sensor
    surface: Correction
    feet: Feet
    deviations: np.ndarray


def rest_from_depth(sensor: Sensor, depth: np.ndarray, image: np.ndarray) -> DepthFit:
    """Rest surface from `depth [H, W]` (z along the axis, length unit; NaN or 0: none), dots from the rest image `[H, W]`.

    Within the rim's outline, averaged over squares of 24 px, the designed surface is moved along its normals onto the depths.
    """
    width, height = sensor.camera.image_size
    if depth.shape != (height, width):
        raise MembraneError(
            f"calibrate depth: the depth image is {list(depth.shape)}; expected [{height}, {width}], the camera's"
        )
    surface = fine_surface(sensor)
    points, cells = _points(sensor, depth)
    feet = feet_of(surface, points)
    near = np.abs(feet.heights) < NEAR * surface.size
    feet = Feet(*(values[near] for values in feet))
    square = np.unique(cells[near], return_inverse=True)[1]
    counts = np.bincount(square)
    mean = lambda values: np.stack([np.bincount(square, column) for column in values.T], -1) / counts[:, None]  # noqa: E731
    places, normals, heights = mean(feet.places), mean(feet.normals), mean(feet.heights[:, None])[:, 0]
    spread = np.bincount(square, (feet.heights - heights[square]) ** 2) / counts
    kept = counts >= FEWEST
    deviations = np.sqrt(spread / (counts - 1).clip(1))[kept]
    normals = normals[kept] / np.linalg.norm(normals[kept], axis=1, keepdims=True)
    feet = Feet(places[kept], normals, heights[kept])
    change = correction(surface, feet, deviations**2)
    dots, sizes = placed_dots(recalibrated(sensor, surface, change.vertices, None, None, image), image)
    moved = recalibrated(sensor, surface, change.vertices, dots, sizes, image)
    return DepthFit(moved, change, feet, deviations)


def _points(sensor: Sensor, depth: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Points `[N, 3]` of every other pixel within the rim's outline, and the square that each is in `[N]`."""
    mask = rim_mask(sensor, sensor.camera.point_to_pixel(sensor.membrane.rest)) & np.isfinite(depth) & (depth > 0)
    mask[1::2] = mask[:, 1::2] = False
    v, u = np.nonzero(mask)
    origin, direction = (a.numpy() for a in sensor.camera.pixel_to_ray(torch.from_numpy(np.stack([u, v], -1).astype(float))))
    reach = (depth[v, u] - origin[:, 2]) / direction[:, 2]
    return origin + reach[:, None] * direction, (v // CELL) * 10_000 + u // CELL
