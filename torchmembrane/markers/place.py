"""Markers on the rest surface, and what locates them in an image: built once for a sensor."""

import numpy as np
import torch
from PIL import Image, ImageDraw
from torch import Tensor, nn

from ..errors import MembraneError
from ..sensor.model import Sensor
from ..surface.membrane import SurfacePoints
from .dots import DotPattern, find_dots, measure_dots
from .locate import DotLocator
from .texture import TextureLocator, choose_patches

FEWEST_MARKERS = 8
SMOOTH_GRID = 33
"""Vertices a side of the surface on which markers are placed: the solver's facets are too coarse for oblique rays."""
DOT_RADIUS = (0.16, 0.27)
"""Radius of small and large dots over the dot spacing, where no rest image shows it."""


class PlacedMarkers:
    """Markers on the rest surface: `positions [D, 3]`, `model_pixels [D, 2]`, `points`, and their `locator`."""

    def __init__(self, sensor: Sensor, positions: np.ndarray, points: SurfacePoints):
        self.positions, self.points = positions, points
        self.model_pixels = sensor.camera.point_to_pixel(torch.from_numpy(positions)).numpy()
        self.locator: nn.Module | None = None


def place_markers(sensor: Sensor, vertex_pixels: Tensor) -> PlacedMarkers:
    """The sensor's markers: listed dots, dots found in the rest image, or texture patches chosen there.

    `vertex_pixels [V, 2]` are the grid vertices' rest pixels. Raises `MembraneError` where too few markers are found.
    """
    anchors = vertex_pixels[sensor.membrane.fixed].numpy()
    listed, image = sensor.markers.positions, sensor.markers.rest_image
    if sensor.markers.kind == "texture":
        centres = choose_patches(image, rim_mask(sensor, vertex_pixels))
        placed, hit = _place_on_surface(sensor, centres)
        placed.locator = TextureLocator(image, centres[hit], anchors)
    elif listed is None:
        pattern = find_dots(image, sensor.markers.polarity, rim_mask(sensor, vertex_pixels))
        placed, hit = _place_on_surface(sensor, pattern.pixels)
        pattern = DotPattern(*(field[hit] for field in pattern))
        placed.locator = DotLocator(pattern, sensor.camera.image_size, sensor.markers.polarity, anchors)
    else:
        positions = np.asarray(listed, dtype=float)
        placed = PlacedMarkers(sensor, positions, sensor.membrane.closest_points(positions))
        pattern = _listed_pattern(sensor, placed, image)
        placed.locator = DotLocator(pattern, sensor.camera.image_size, sensor.markers.polarity, anchors)
    return placed


def _place_on_surface(sensor: Sensor, pixels: np.ndarray) -> tuple[PlacedMarkers, np.ndarray]:
    """Markers seen at `pixels` in the rest image, placed where their rays meet the rest surface; and which of them do."""
    rays = sensor.camera.pixel_to_ray(torch.from_numpy(pixels))
    m, n = sensor.membrane.grid
    smooth = sensor.surface.membrane((max(m, SMOOTH_GRID), max(n, SMOOTH_GRID)))
    hits = smooth.ray_points(*(r.numpy() for r in rays))
    hit = np.isfinite(hits.distance)
    if hit.sum() < FEWEST_MARKERS:
        raise MembraneError(
            f"sensor {sensor.name!r}: {hit.sum()} markers found in the rest image lie on the rest surface; expected at least "
            f"{FEWEST_MARKERS}: check the camera, the rest surface and the polarity"
        )
    positions = (smooth.rest.numpy()[hits.vertices] * hits.weights[..., None]).sum(1)[hit]
    return PlacedMarkers(sensor, positions, sensor.membrane.closest_points(positions)), hit


def _listed_pattern(sensor: Sensor, placed: PlacedMarkers, image: np.ndarray | None) -> DotPattern:
    sizes = np.array([size == "large" for size in sensor.markers.sizes], dtype=int)
    shapes = _unit_dot_shapes(sensor, placed)
    if image is None:
        spacing = (float(sensor.membrane.rest_area.sum()) / len(sizes)) ** 0.5
        return DotPattern(placed.model_pixels, shapes * np.array(DOT_RADIUS)[sizes][:, None, None] * spacing, sizes)
    pattern = measure_dots(image, placed.model_pixels, shapes, sizes, sensor.markers.polarity)
    lost = ~np.isfinite(pattern.pixels).all(1)
    return pattern._replace(pixels=np.where(lost[:, None], placed.model_pixels, pattern.pixels))


def _unit_dot_shapes(sensor: Sensor, placed: PlacedMarkers) -> np.ndarray:
    """How a dot of radius 1 in the surface's tangent plane is imaged: `[D, 2, 2]`, px per length unit."""
    normals = (sensor.membrane.rest_normals.numpy()[placed.points.vertices] * placed.points.weights[..., None]).sum(1)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    least = np.eye(3)[np.abs(normals).argmin(1)]
    tangent = np.cross(normals, least)
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    step = 1e-4 * sensor.membrane.size
    columns = []
    for direction in (tangent, np.cross(normals, tangent)):
        ends = [sensor.camera.point_to_pixel(torch.from_numpy(placed.positions + s * step * direction)) for s in (1, -1)]
        columns.append(((ends[0] - ends[1]) / (2 * step)).numpy())
    return np.stack(columns, -1)


def rim_mask(sensor: Sensor, vertex_pixels: Tensor) -> np.ndarray:
    """Pixels inside the rim's outline, `[height, width]` bool."""
    m, n = sensor.membrane.grid
    index = np.arange(m * n).reshape(m, n)
    loop = np.concatenate([index[:-1, 0], index[-1, :-1], index[:0:-1, -1], index[0, :0:-1]])
    mask = Image.new("1", tuple(sensor.camera.image_size))
    ImageDraw.Draw(mask).polygon([tuple(p) for p in vertex_pixels[loop].tolist()], fill=1)
    return np.asarray(mask)
