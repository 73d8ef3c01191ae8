"""Markers on the rest surface, and what locates them in an image: built once for a sensor."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from PIL import Image, ImageDraw
from torch import Tensor

from ..errors import MembraneError
from ..sensor.sensor import Sensor
from ..surface.projection import SurfacePoints
from ..surface.tangent import tangent_axes
from ..surface.topology import rim_loop
from .dots.locator import DotLocator
from .dots.pattern import DotPattern, find_dots, measure_dots
from .locator import Locator
from .spacing import in_view, partly_in_view
from .texture.locator import TextureLocator
from .texture.patches import choose_patches

LOCATORS = ("fit", "soft")
FEWEST_MARKERS = 8
SMOOTH_GRID = 33
"""Vertices per side of the surface on which markers are placed: the solver's facets are too coarse for oblique rays."""
DOT_RADIUS = (0.16, 0.27)
"""Radius of small and large dots over the dot spacing, where no rest image shows it."""


@dataclass(frozen=True)
class PlacedMarkers:
    """Markers on the rest surface, and their locator.

    Attributes:
        positions: `[D, 3]`, length unit, camera frame.
        model_pixels: `[D, 2]`, where the camera model projects them.
        points: the same as points of the membrane's triangles.
        in_view: `[D]` bool, which of them reach into the image at rest.
        locator: finds them in images.
    """

    positions: np.ndarray
    model_pixels: np.ndarray
    points: SurfacePoints
    in_view: np.ndarray
    locator: Locator


def imaged_vertices(sensor: Sensor, vertex_pixels: Tensor, whole: bool) -> Tensor:
    """Which vertices the camera can image, `[V]` bool; refused where some cannot be imaged that must.

    Args:
        sensor: with a list of dots or a rest image.
        vertex_pixels: rest pixels `[V, 2]` of the grid's vertices.
        whole: whether the estimator needs all of them.

    Raises:
        MembraneError: a vertex that is needed cannot be imaged.
    """
    imaged = torch.isfinite(vertex_pixels).all(-1)
    if not (imaged.all() if whole or sensor.markers.positions is None else imaged.any()):
        raise MembraneError(
            f"sensor {sensor.name!r}: parts of the rest surface cannot be imaged by its camera; check the poses (force "
            "balance of listed dots can do with a part)"
        )
    return imaged


def place_markers(sensor: Sensor, vertex_pixels: Tensor, locator: str = LOCATORS[0]) -> PlacedMarkers:
    """Place the sensor's markers: listed dots, dots found in the rest image, or texture patches chosen there.

    Args:
        sensor: with a list of dots or a rest image.
        vertex_pixels: rest pixels `[V, 2]` of the grid's vertices.
        locator: how they are found in images: "fit", by least squares, or "soft", by soft-argmax of responses.

    Raises:
        MembraneError: an unknown locator, or too few markers are found.
    """
    of_dots, of_texture = _locators(locator)
    anchors = vertex_pixels[sensor.membrane.fixed].numpy()
    markers, (width, height) = sensor.markers, sensor.camera.image_size
    built: Locator
    pattern: DotPattern | None = None
    if markers.kind == "dots" and markers.positions is not None:
        positions = np.asarray(markers.positions, dtype=float)
        if len(positions) < FEWEST_MARKERS:
            raise MembraneError(f"sensor {sensor.name!r}: {len(positions)} dots; expected at least {FEWEST_MARKERS}: list more")
        pattern = _listed_pattern(sensor, positions)
        anchors = anchors[np.isfinite(anchors).all(1)]
        built = of_dots(pattern, (width, height), markers.polarity, anchors)
    else:
        image, mask = markers.rest_image, rim_mask(sensor, vertex_pixels)
        assert image is not None  # or `Markers` has refused it
        if markers.kind == "texture":
            patches = choose_patches(image, mask)
            positions, placed = _place_on_surface(sensor, patches)
            built = of_texture(image, patches[placed], anchors)
        else:
            pattern = find_dots(image, markers.polarity, mask)
            positions, placed = _place_on_surface(sensor, pattern.pixels)
            pattern = DotPattern(*(field[placed] for field in pattern))
            built = of_dots(pattern, (width, height), markers.polarity, anchors)
    pixels, points = _model_pixels(sensor, positions), sensor.membrane.closest_points(positions)
    seen = in_view(pixels, (width, height)) if pattern is None else partly_in_view(pixels, pattern.shapes, (width, height))
    return PlacedMarkers(positions, pixels, points, seen, built)


def _locators(name: str) -> tuple[Callable[..., Locator], Callable[..., Locator]]:
    """What locates dots and what locates texture."""
    if name == "fit":
        return DotLocator, TextureLocator
    if name == "soft":
        from .soft import SoftLocator, SoftTextureLocator  # here: kornia takes half a second to load

        return SoftLocator, SoftTextureLocator
    raise MembraneError(f"Reconstructor: locator = {name!r}; expected one of {', '.join(LOCATORS)}")


def _model_pixels(sensor: Sensor, positions: np.ndarray) -> np.ndarray:
    """Where the camera sees `positions [D, 3]`; what it cannot image lies far outside, each point elsewhere."""
    pixels = sensor.camera.point_to_pixel(torch.from_numpy(positions)).numpy()
    outside = -float(max(sensor.camera.image_size)) * (2 + np.arange(len(pixels)))
    return np.where(np.isfinite(pixels).all(1, keepdims=True), pixels, outside[:, None])


def _place_on_surface(sensor: Sensor, pixels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Where the rays of `pixels [D, 2]` in the rest image meet the rest surface, `[M, 3]`; and which of them do, `[D]` bool."""
    rays = sensor.camera.pixel_to_ray(torch.from_numpy(pixels))
    m, n = sensor.membrane.grid
    assert sensor.surface is not None  # `Sensor` has set it
    smooth = sensor.surface.membrane((max(m, SMOOTH_GRID), max(n, SMOOTH_GRID)))
    hits = smooth.ray_points(*(r.numpy() for r in rays))
    placed = np.isfinite(hits.distance)
    if placed.sum() < FEWEST_MARKERS:
        raise MembraneError(
            f"sensor {sensor.name!r}: {placed.sum()} markers found in the rest image lie on the rest surface; expected at "
            f"least {FEWEST_MARKERS}: check the camera, the rest surface and the polarity"
        )
    return (smooth.rest.numpy()[hits.vertices] * hits.weights[..., None]).sum(1)[placed], placed


def _listed_pattern(sensor: Sensor, positions: np.ndarray) -> DotPattern:
    """The dots of the sensor's list, measured in the rest image where there is one."""
    markers, pixels = sensor.markers, _model_pixels(sensor, positions)
    sizes = np.array([int(size == "large") for size in markers.sizes or ()], dtype=int)
    shapes = _unit_dot_shapes(sensor, positions)
    seen = in_view(pixels, sensor.camera.image_size)
    if seen.any():  # what is outside, some of it behind the camera, tells nothing of how dots look
        shapes = np.where(seen[:, None, None], shapes, np.median(shapes[seen], 0))
    if markers.rest_image is None:
        pitch = (float(sensor.membrane.rest_area.sum()) / len(sizes)) ** 0.5
        return DotPattern(pixels, shapes * np.array(DOT_RADIUS)[sizes][:, None, None] * pitch, sizes)
    pattern = measure_dots(markers.rest_image, pixels, shapes, sizes, markers.polarity)
    visible = np.isfinite(pattern.pixels).all(1)
    return pattern._replace(pixels=np.where(visible[:, None], pattern.pixels, pixels))


def _unit_dot_shapes(sensor: Sensor, positions: np.ndarray) -> np.ndarray:
    """How a dot of radius 1 in the surface's tangent plane is imaged: `[D, 2, 2]`, px per length unit."""
    points = sensor.membrane.closest_points(positions)
    normals = (sensor.membrane.rest_normals.numpy()[points.vertices] * points.weights[..., None]).sum(1)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    step = 1e-4 * sensor.membrane.size
    columns = []
    for direction in tangent_axes(normals).swapaxes(0, 1):
        ahead, behind = (_model_pixels(sensor, positions + s * step * direction) for s in (1, -1))
        columns.append((ahead - behind) / (2 * step))
    return np.stack(columns, -1)


def rim_mask(sensor: Sensor, vertex_pixels: Tensor) -> np.ndarray:
    """Pixels inside the rim's outline.

    Args:
        sensor: its camera's image size and the membrane's grid are used.
        vertex_pixels: rest pixels `[V, 2]` of the grid's vertices.

    Returns:
        `[height, width]` bool.

    Example:
        >>> from torchmembrane.presets import preset
        >>> sensor = preset("bubble")
        >>> mask = rim_mask(sensor, sensor.camera.point_to_pixel(sensor.membrane.rest))
        >>> mask.shape, bool(mask[240, 320]), bool(mask[0, 0])
        ((480, 640), True, False)
    """
    loop = rim_loop(sensor.membrane.grid)
    width, height = sensor.camera.image_size
    mask = Image.new("1", (width, height))
    ImageDraw.Draw(mask).polygon([tuple(p) for p in vertex_pixels[loop].tolist()], fill=1)
    return np.asarray(mask)
