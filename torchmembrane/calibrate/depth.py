"""Rest surface and dots from a depth image that is registered to the sensor's camera, or to the camera of one view."""

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import torch

from ..errors import MembraneError, check_arguments
from ..files.grayscale import check_image
from ..markers.placement import rim_mask
from ..progress import Progress, silent, within
from ..sensor.parts import Surface
from ..sensor.sensor import Sensor
from ..torch_modes import on_cpu
from .surface import Correction, SurfaceProjection, correction, fine_surface, recalibrated, surface_projection
from .view_poses import placed_view, rest_from_view_images
from .views import placed_dots, with_dots_of_each_view

CELL = 24  # px, side of the squares over which depths are averaged
FEWEST = 8  # depths in a square
NEAR = 0.1  # over the surface's size: depths farther from the design belong to something else
FEWEST_SQUARES = 12
UNITS = (1000.0, 100.0, 10.0, 0.1, 0.01, 0.001)
"""Possible scale errors of depths in a wrong unit."""


class DepthFit(NamedTuple):
    """The sensor with the rest surface found in a depth image.

    Attributes:
        sensor: the sensor with the surface and the dots found.
        surface: the `Correction` of the designed surface.
        projection: projections of the measured depths onto the designed surface, averaged over each of N squares of the image.
        deviations: standard deviations of their signed distances, `[N]`, length unit.
    """

    sensor: Sensor
    surface: Correction
    projection: SurfaceProjection
    deviations: np.ndarray


@check_arguments
@on_cpu
def rest_from_depth(sensor: Sensor, depth: np.ndarray, image: np.ndarray, *, progress: Progress = silent) -> DepthFit:
    """Find the rest surface in a depth image, and the dots on it in the rest image.

    Depths within the rim's outline are averaged over squares of 24 px; the designed surface is moved along its normals onto
    these averages.

    Args:
        sensor: the design.
        depth: z along the camera's axis, `[H, W]`, length unit; NaN, infinity or 0 where it is unknown.
        image: grey image of the membrane at rest, `[H, W]`, in 0..1.
        progress: called with the completed share.

    Returns:
        The `DepthFit`.

    Raises:
        MembraneError: the depth image does not have the camera's size, or too few depths or dots are found.

    Limitations:
        Depths farther from the design than a tenth of the surface's size are ignored.

    Example:
        >>> from dataclasses import replace
        >>> from scipy.interpolate import griddata
        >>> from torchmembrane import Camera
        >>> sensor = Sensor.from_file("examples/sensor.toml")
        >>> image = sensor.markers.rest_image[::2, ::2]  # every other pixel, and a camera that sees them
        >>> camera = Camera("fisheye", (320, 240), (80.0, 80.0), (161.05, 121.45))
        >>> design = replace(sensor, camera=camera, markers=replace(sensor.markers, rest_image=image))
        >>> rest, (v, u) = design.membrane.rest, np.mgrid[:240, :320]
        >>> depth = griddata(design.camera.point_to_pixel(rest).numpy(), rest[:, 2].numpy(), (u, v))  # NaN beside the membrane
        >>> found = rest_from_depth(design, depth, image)
        >>> bool(np.abs(found.surface.offsets).max() < 0.1), len(found.sensor.markers.positions)
        (True, 121)
    """
    sensor.refuse_heights("calibrate depth")
    depth = check_image("calibrate depth: the depth image", depth, sensor.camera.image_size)
    image = check_image("calibrate depth: the image", image, sensor.camera.image_size)
    progress(0.0, "depths on the designed surface")
    surface = fine_surface(sensor)
    points, cells = _points(sensor, depth)
    projection = surface_projection(surface, points)
    near = np.abs(projection.signed_distance) < NEAR * surface.size
    projection = SurfaceProjection(*(values[near] for values in projection))
    square = np.unique(cells[near], return_inverse=True)[1]
    counts = np.bincount(square)
    if (counts >= FEWEST).sum() < FEWEST_SQUARES:
        raise MembraneError(_too_few(sensor, depth, int((counts >= FEWEST).sum())))

    def square_mean(values: np.ndarray) -> np.ndarray:
        return np.stack([np.bincount(square, column) for column in values.T], -1) / counts[:, None]

    closest, normals = square_mean(projection.points), square_mean(projection.normals)
    distance = square_mean(projection.signed_distance[:, None])[:, 0]
    spread = np.bincount(square, (projection.signed_distance - distance[square]) ** 2) / counts
    kept = counts >= FEWEST
    deviations = np.sqrt(spread / (counts - 1).clip(1))[kept]
    normals = normals[kept] / np.linalg.norm(normals[kept], axis=1, keepdims=True)
    projection = SurfaceProjection(closest[kept], normals, distance[kept])
    progress(0.3, "surface through the depths")
    change = correction(surface, projection, deviations**2)
    progress(0.5, "dots of the image")
    dots, sizes = placed_dots(recalibrated(sensor, surface, change.vertices, None, None, image), image)
    moved = recalibrated(sensor, surface, change.vertices, dots, sizes, image)
    return DepthFit(moved, change, projection, deviations)


@on_cpu
def rest_from_depth_of_view(
    sensor: Sensor, number: int, depth: np.ndarray, images: Sequence[np.ndarray], *, progress: Progress = silent
) -> DepthFit:
    """Find rest surface, dots and poses of a sensor with several views, from a depth image of one view.

    `rest_from_depth` finds surface and dots in that view; the poses of the other cameras are then fitted to these dots in their
    images, and dots that any view sees are added.

    Args:
        sensor: the design with several views and approximate poses.
        number: number of the view to whose camera the depth image is registered, from 0.
        depth: z along that camera's axis, `[H, W]`, length unit; NaN, infinity or 0 where it is unknown.
        images: grey image of the membrane at rest for each view, `[H, W]`, in 0..1.
        progress: called with the completed share.

    Returns:
        The `DepthFit`: the sensor with all views; surface, projection and deviations are in the frame of the given view.

    Raises:
        MembraneError: as for `rest_from_depth` and `rest_from_view_images`.

    Limitations:
        If the view is not the first one, its pose in the file must be accurate to half the dots' pitch in the first image.

    Example:
        >>> from scipy.interpolate import griddata
        >>> from torchmembrane import Camera
        >>> from torchmembrane.sensor.views import View
        >>> sensor = Sensor.from_file("examples/sensor.toml")
        >>> image = sensor.markers.rest_image[::2, ::2]  # every other pixel, and a camera that sees them
        >>> camera = Camera("fisheye", (320, 240), (80.0, 80.0), (161.05, 121.45))
        >>> views = View("one", camera), View("two", camera)  # which stand at one place
        >>> pair = replace(sensor, camera=camera, markers=replace(sensor.markers, rest_image=image), views=views)
        >>> rest, (v, u) = pair.membrane.rest, np.mgrid[:240, :320]
        >>> depth = griddata(camera.point_to_pixel(rest).numpy(), rest[:, 2].numpy(), (u, v))  # NaN beside the membrane
        >>> found = rest_from_depth_of_view(pair, 0, depth, [image, image]).sensor
        >>> bool(np.abs(found.views[1].pose.matrix - np.eye(4)).max() < 0.05), len(found.markers.positions)
        (True, 121)
    """
    found = rest_from_depth(sensor.in_view(number), depth, images[number], progress=within(progress, 0.0, 0.6))
    view, markers, values = sensor.views[number], found.sensor.markers, found.sensor.surface.values
    shape = Surface("grid", {**values, "vertices": view.pose.points(values["vertices"])})
    positions = view.pose.points(np.asarray(markers.positions))
    views = tuple(replace(each, rest_image=image.astype(np.float32)) for each, image in zip(sensor.views, images, strict=True))
    whole = replace(
        sensor,
        membrane=shape.membrane(sensor.membrane.grid),
        surface=shape,
        markers=replace(markers, positions=positions, rest_image=views[0].rest_image),
        views=views,
    )
    progress(0.6, "where each view stands")
    if number:
        whole = rest_from_view_images(whole, images, progress=within(progress, 0.6, 0.9)).sensor
    else:  # the depths determine the surface in the first view
        for further in range(1, len(views)):
            whole, _ = placed_view(whole, further, images[further])
    return found._replace(sensor=with_dots_of_each_view(whole, images))


def _too_few(sensor: Sensor, depth: np.ndarray, squares: int) -> str:
    """Return the error message if too few squares of depths are near the designed surface."""
    within, designed = depth[_measured(sensor, depth)], float(sensor.membrane.rest[:, 2].median())
    said = (
        f"calibrate depth: {squares} squares of {CELL} px have depths near the designed surface; expected {FEWEST_SQUARES} or "
        f"more, registered to the camera and within {NEAR:g} of the surface's size"
    )
    if not len(within):
        return f"{said}: there is none within the rim"
    found = float(np.median(within))
    factor = next((factor for factor in UNITS if 0.5 < factor * found / designed < 2), None)
    remedy = "" if factor is None else f"; --unit {factor:g} times as large brings them there"
    return f"{said}: the median within the rim is {found:.4g} {sensor.length_unit}, the design's {designed:.4g}{remedy}"


def _measured(sensor: Sensor, depth: np.ndarray) -> np.ndarray:
    """Return the mask `[H, W]` of pixels within the rim's outline that have a depth."""
    mask: np.ndarray = rim_mask(sensor, sensor.camera.point_to_pixel(sensor.membrane.rest)) & np.isfinite(depth) & (depth > 0)
    return mask


def _points(sensor: Sensor, depth: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the points `[N, 3]` for every other row and column of pixels within the rim's outline, and for each point the
    number of the `CELL` x `CELL` px square of the image that contains its pixel, `[N]`."""
    mask = _measured(sensor, depth)
    mask[1::2] = mask[:, 1::2] = False
    v, u = np.nonzero(mask)
    origin, direction = (a.numpy() for a in sensor.camera.pixel_to_ray(torch.from_numpy(np.stack([u, v], -1).astype(float))))
    distance = (depth[v, u] - origin[:, 2]) / direction[:, 2]
    return origin + distance[:, None] * direction, (v // CELL) * 10_000 + u // CELL
