"""How a sensor's markers are seen, by one camera or by several views; a `Reconstructor` is built from this."""

import copy
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from ..camera.model import Camera
from ..camera.rig import Rig
from ..sensor.sensor import Sensor
from ..sensor.views import SurfaceInView
from ..surface.projection import SurfacePoints
from .observer import MarkerObserver
from .placement import PlacedMarkers, imaged_vertices, place_markers, refuse_blind
from .views import ViewsObserver


class Sightings(NamedTuple):
    """All views of a sensor's markers: D markers in each of W views give `N = W D` sightings, the first view's first.

    Attributes:
        observer: finds the markers in images.
        camera: the `Camera`, or a `Rig` of several views.
        markers: the D markers on the rest surface, with the first view's locator.
        positions: `[N, 3]` at rest, length unit.
        points: the same N markers as points of the membrane's triangles.
        rest_pixels: `[N, 2]`, the model's pixels of the markers at rest; the principal point for a view that does not see one.
        vertex_pixels: `[V, 2]`, pixels of the grid's vertices in the first view.
        levers: `[N, 3]`, vectors from the positions to the visible tips; None: all markers lie on the surface.
    """

    observer: MarkerObserver | ViewsObserver
    camera: Camera | Rig
    markers: PlacedMarkers
    positions: Tensor
    points: SurfacePoints
    rest_pixels: Tensor
    vertex_pixels: Tensor
    levers: Tensor | None = None


def sightings(sensor: Sensor, locator: str, dtype: torch.dtype, whole: bool, check_rest: bool) -> Sightings:
    """Return the sightings of a sensor's markers.

    Args:
        sensor: the sensor.
        locator: how markers are found in images, "fit" or "soft".
        dtype: precision of the pixels.
        whole: whether every vertex must be imaged.
        check_rest: whether to refuse a rest image that disagrees with the model.

    Raises:
        MembraneError: too few markers are seen, or they lie far from their pixels in the model.
    """
    observer, markers, vertex_pixels = _of_one_view(sensor.in_view(0), sensor.name, locator, dtype, whole, check_rest)
    positions, rest_pixels = torch.from_numpy(markers.positions), torch.from_numpy(markers.model_pixels)
    levers = None if markers.levers is None else torch.from_numpy(markers.levers)
    if not sensor.views:
        camera = copy.deepcopy(sensor.camera)
        return Sightings(observer, camera, markers, positions, markers.points, rest_pixels, vertex_pixels, levers)
    observers, pixels = [observer], [rest_pixels]
    for number, view in enumerate(sensor.views[1:], 1):
        name = f"{sensor.name}, view {view.name}"
        observer, of_view, _ = _of_one_view(sensor.in_view(number), name, locator, dtype, whole, check_rest)
        observers.append(observer)
        pixels.append(torch.from_numpy(of_view.model_pixels))
    regions = [view.region for view in sensor.views if view.region is not None]
    outside = [view.side == "outside" for view in sensor.views]
    rig = Rig([view.camera for view in sensor.views], [view.pose for view in sensor.views], outside)
    together = ViewsObserver(observers, [view.name for view in sensor.views], regions or None, rig)
    rays = together.with_rays(torch.cat(pixels)[None], together.seen_at_rest.double()[None])[0]
    points = SurfacePoints(*(np.concatenate([field] * len(observers)) for field in markers.points))
    repeated = positions.repeat(len(observers), 1)
    levers = None if levers is None else levers.repeat(len(observers), 1)
    return Sightings(together, rig, markers, repeated, points, rays, vertex_pixels, levers)


def _of_one_view(
    sensor: Sensor, name: str, locator: str, dtype: torch.dtype, whole: bool, check_rest: bool
) -> tuple[MarkerObserver, PlacedMarkers, Tensor]:
    """Return the observer and markers of a sensor with one view, and the pixels of the vertices at rest."""
    vertex_pixels = sensor.camera.point_to_pixel(sensor.membrane.rest)
    imaged = imaged_vertices(sensor, vertex_pixels, whole)
    if isinstance(sensor.surface, SurfaceInView):
        refuse_blind(sensor, name)
    markers = place_markers(sensor, vertex_pixels, locator)
    rim, rest_image = vertex_pixels[sensor.membrane.fixed & imaged].numpy(), sensor.markers.rest_image
    observer = MarkerObserver(markers, rim, name, dtype, rest_image, sensor.camera.image_size, check_rest)
    return observer, markers, vertex_pixels
