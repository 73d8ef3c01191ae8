"""Placement of markers on the rest surface, and choice of their locator; done once for each sensor."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from PIL import Image, ImageDraw
from torch import Tensor

from ..errors import MembraneError
from ..sensor.sensor import Sensor
from ..sensor.views import SurfaceInView
from ..surface.levers import inward_levers
from ..surface.membrane import Membrane
from ..surface.projection import SurfacePoints, ray_points
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
GRAZING = 0.1
"""Cosine between a line of sight and the normal below which a marker is not visible."""
BEHIND = 0.02
"""Depth behind the surface, over its size, up to which a listed marker counts as on the surface."""
SMOOTH_GRID = 33
"""Vertices per side of the surface for marker placement: the solver's facets are too coarse for oblique rays."""
DOT_RADIUS = (0.16, 0.27)
"""Radius of small and large dots over their spacing, if there is no rest image to measure them in."""


@dataclass(frozen=True)
class PlacedMarkers:
    """Markers on the rest surface, and their locator.

    Attributes:
        positions: `[D, 3]`, length unit, camera frame.
        model_pixels: `[D, 2]`, pixels of the markers, or of their tips if they stand off the surface, in the camera model.
        points: the same markers as points of the membrane's triangles.
        in_view: `[D]` bool, whether at least a part of each lies in the image at rest.
        locator: locator of the markers in images.
        levers: `[D, 3]`, vectors from the positions to the tips; None: all markers lie on the surface.
    """

    positions: np.ndarray
    model_pixels: np.ndarray
    points: SurfacePoints
    in_view: np.ndarray
    locator: Locator
    levers: np.ndarray | None = None


def imaged_vertices(sensor: Sensor, vertex_pixels: Tensor, whole: bool) -> Tensor:
    """Return which vertices the camera can image, `[V]` bool; raise an error if a required one is not among them.

    Args:
        sensor: a sensor with a list of dots or a rest image.
        vertex_pixels: pixels of the grid's vertices at rest, `[V, 2]`.
        whole: whether the estimator requires all vertices.

    Raises:
        MembraneError: a required vertex cannot be projected.
    """
    imaged = torch.isfinite(vertex_pixels).all(-1)
    if not (imaged.all() if whole or sensor.markers.positions is None else imaged.any()):
        raise MembraneError(
            f"sensor {sensor.name!r}: parts of the rest surface cannot be projected by its camera; check the poses of camera "
            "and surface, or, if the camera sees only a part, list the dots and use the estimator force-balance"
        )
    return imaged


def place_markers(sensor: Sensor, vertex_pixels: Tensor, locator: str = LOCATORS[0]) -> PlacedMarkers:
    """Place the sensor's markers: listed dots, dots found in the rest image, or texture patches chosen there.

    Args:
        sensor: a sensor with a list of dots or a rest image.
        vertex_pixels: pixels of the grid's vertices at rest, `[V, 2]`.
        locator: how markers are found in images: "fit", by least squares, or "soft", by soft-argmax of filter responses.

    Raises:
        MembraneError: the locator is unknown, or too few markers are found.
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
        levers = listed_levers(sensor)
        pattern = _listed_pattern(sensor, _tips(positions, levers))
        anchors = anchors[np.isfinite(anchors).all(1)]
        built = of_dots(pattern, (width, height), markers.polarity, anchors)
    else:
        image, mask = markers.rest_image, rim_mask(sensor, vertex_pixels)
        assert image is not None  # or `Markers` has refused it
        if markers.kind == "texture":
            patches = choose_patches(image, mask)
            positions, levers, placed = _place_on_surface(sensor, patches)
            built = of_texture(image, patches[placed], anchors)
        else:
            pattern = find_dots(image, markers.polarity, mask)
            positions, levers, placed = _place_on_surface(sensor, pattern.pixels)
            pattern = DotPattern(*(field[placed] for field in pattern))
            built = of_dots(pattern, (width, height), markers.polarity, anchors)
    pixels, points = _model_pixels(sensor, _tips(positions, levers)), sensor.membrane.closest_points(positions)
    seen = in_view(pixels, (width, height)) if pattern is None else partly_in_view(pixels, pattern.shapes, (width, height))
    return PlacedMarkers(positions, pixels, points, seen, built, levers)


def listed_levers(sensor: Sensor) -> np.ndarray | None:
    """Return the vectors from a sensor's listed dots to their tips at rest, `[D, 3]`; None if all dots lie on the surface."""
    markers = sensor.markers
    if markers.positions is None or not markers.stand_off:
        return None
    smooth = _smooth_surface(sensor)
    return inward_levers(smooth, smooth.closest_points(markers.positions), markers.heights(len(markers.positions)))


def _smooth_surface(sensor: Sensor) -> Membrane:
    m, n = sensor.membrane.grid
    assert sensor.surface is not None  # `Sensor` has set it
    return sensor.surface.membrane((max(m, SMOOTH_GRID), max(n, SMOOTH_GRID)))


def _tips(positions: np.ndarray, levers: np.ndarray | None) -> np.ndarray:
    """Return the points of the markers that the camera sees, `[D, 3]`."""
    return positions if levers is None else positions + levers


def _locators(name: str) -> tuple[Callable[..., Locator], Callable[..., Locator]]:
    """Return the locators of dots and of texture."""
    if name == "fit":
        return DotLocator, TextureLocator
    if name == "soft":
        from .soft import SoftLocator, SoftTextureLocator  # here: kornia takes half a second to load

        return SoftLocator, SoftTextureLocator
    raise MembraneError(f"Reconstructor: locator = {name!r}; expected one of {', '.join(LOCATORS)}")


def _model_pixels(sensor: Sensor, positions: np.ndarray) -> np.ndarray:
    """Return the pixels of `positions [D, 3]`; points that cannot be projected get distinct pixels far outside the image."""
    pixels = sensor.camera.point_to_pixel(torch.from_numpy(positions)).numpy()
    outside = -float(max(sensor.camera.image_size)) * (2 + np.arange(len(pixels)))
    seen = np.isfinite(pixels).all(1) & visible(sensor, positions)
    return np.where(seen[:, None], pixels, outside[:, None])


def visible(sensor: Sensor, positions: np.ndarray) -> np.ndarray:
    """Return which of `positions [D, 3]` on the rest surface face the camera and are not occluded by another part of the
    surface, `[D]` bool. For a sensor with one view these are all, because its camera sees the whole membrane."""
    if not isinstance(sensor.surface, SurfaceInView):
        return np.ones(len(positions), bool)
    membrane, distance = sensor.membrane, np.linalg.norm(positions, axis=1)
    sight = positions / distance[:, None]
    nearest = membrane.ray_points(np.zeros_like(positions), sight).distance
    points = membrane.closest_points(positions)
    normals = (membrane.rest_normals.numpy()[points.vertices] * points.weights[..., None]).sum(1)
    turned = (normals * sight).sum(1) > GRAZING * np.linalg.norm(normals, axis=1)
    return turned & ~(nearest < distance - BEHIND * membrane.size)


def _place_on_surface(sensor: Sensor, pixels: np.ndarray) -> tuple[np.ndarray, np.ndarray | None, np.ndarray]:
    """Return the markers `[M, 3]` whose tips lie where the rays of `pixels [D, 2]` in the rest image first meet the surface of
    all tips; their levers `[M, 3]`, or None if that is the rest surface; and which rays meet it, `[D]` bool."""
    rays = sensor.camera.pixel_to_ray(torch.from_numpy(pixels))
    smooth = _smooth_surface(sensor)
    X, height = smooth.rest.numpy(), float(sensor.markers.height)
    levers = -height * smooth.rest_normals.numpy()
    hits = ray_points(X + levers, smooth.triangles.numpy(), *(r.numpy() for r in rays))
    placed = np.isfinite(hits.distance)
    if placed.sum() < FEWEST_MARKERS:
        raise MembraneError(
            f"sensor {sensor.name!r}: of {len(pixels)} markers found in the rest image, the rays of {placed.sum()} meet the "
            f"rest surface; expected at least {FEWEST_MARKERS}: check the camera, the rest surface and the polarity"
        )
    feet, to_tips = ((each[hits.vertices] * hits.weights[..., None]).sum(1)[placed] for each in (X, levers))
    return feet, to_tips if height else None, placed


def markers_in_view(sensor: Sensor) -> np.ndarray:
    """Return which of a sensor's listed dots its camera sees at rest, `[D]` bool.

    Args:
        sensor: a sensor with listed dots; one of several views is selected by `Sensor.in_view`.

    Example:
        >>> from torchmembrane.presets import preset
        >>> bool(markers_in_view(preset("bubble")).all())
        True
    """
    positions = np.asarray(sensor.markers.positions, dtype=float)
    return in_view(_model_pixels(sensor, _tips(positions, listed_levers(sensor))), sensor.camera.image_size)


def refuse_blind(sensor: Sensor, name: str) -> None:
    """Raise an error if a view sees too few of the listed dots at rest.

    Args:
        sensor: the sensor in this view, as returned by `Sensor.in_view`.
        name: name of sensor and view, for the message.

    Raises:
        MembraneError: too few dots are visible; the message says how many.
    """
    seen = markers_in_view(sensor)
    if seen.sum() < FEWEST_MARKERS:
        raise MembraneError(
            f"sensor {name!r}: {seen.sum()} of {len(seen)} markers are seen; expected at least {FEWEST_MARKERS}: check the "
            "view's pose, which is of its frame in the first view's, its focal length, and its side"
        )


def _listed_pattern(sensor: Sensor, positions: np.ndarray) -> DotPattern:
    """Return the pattern of the listed dots, measured in the rest image if there is one."""
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
    """Return the image of a dot of radius 1 in the surface's tangent plane: `[D, 2, 2]`, px per length unit."""
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
    """Return which pixels lie inside the outline of the rim.

    Args:
        sensor: sensor whose image size and grid are used.
        vertex_pixels: pixels of the grid's vertices at rest, `[V, 2]`.

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
