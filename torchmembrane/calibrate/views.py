"""Dots that nobody listed: their positions from several views, and the rest surface through them.

The views are those of one camera that moved, or those of a sensor with several.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import torch
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation
from torch import Tensor

from ..camera.model import Camera
from ..errors import MembraneError, check_arguments
from ..files.grayscale import check_image
from ..markers.dots.pattern import find_dots
from ..markers.placement import rim_mask
from ..pose import ViewPose
from ..progress import Progress, silent, within
from ..sensor.parts import Markers
from ..sensor.sensor import Sensor
from ..sensor.units import millimetre
from .bundle import Bundle, bundle_adjusted
from .fit import Fit, rotations, with_common_errors
from .rest import measured_outlines, shading_bias
from .surface import Correction, correction, fine_surface, recalibrated, surface_projection

TRAVEL_ERROR = 0.01  # mm
OBSERVED = 0.1  # of the travel, that its standard deviation is at most: beyond, nothing tells the scale
MOST_MOVED = 0.1  # of the surface's size, rms: a surface that is moved farther is of another scale than the design
LARGEST_NOISE = 1e-3  # of the image's diagonal: noise of located dots is a tenth of it, and less
NUMBERS = ("turn_x", "turn_y", "turn_z", "place_x", "place_y", "place_z")
SIDEWAYS = 0.015  # px: a turned view is shaded to one side, and its located dots share a shift (0.024 px at 4 degrees)


class ViewsFit(NamedTuple):
    """The sensor with the surface and dots that several views show.

    Attributes:
        sensor: the sensor with the surface and dots found.
        names: names of the 6 numbers of each camera pose but the first, `turn_x[1]` of an image, `right.turn_x` of a view.
        first_guess: these numbers as they were told.
        fit: fit of these numbers (degrees, length unit), and then of the dots (length unit, first camera's frame).
        dots: `[D, 3]`.
        deviations: `[D, 3]` standard deviations of the dots.
        surface: `Correction` of the designed surface.
        residuals: `[P, D, 2]` px, measured less modelled, NaN where not used.
    """

    sensor: Sensor
    names: list[str]
    first_guess: np.ndarray
    fit: Fit
    dots: np.ndarray
    deviations: np.ndarray
    surface: Correction
    residuals: np.ndarray


def placed_dots(sensor: Sensor, image: np.ndarray) -> tuple[np.ndarray, list[str]]:
    """The dots found in a rest image, where their rays meet the designed surface: `[D, 3]` and sizes.

    Raises:
        MembraneError: fewer than 12.
    """
    positions, sizes = _dots_on_surface(sensor, image)
    if len(positions) < 12:
        raise MembraneError(f"calibrate: {len(positions)} dots found on the rest surface; expected at least 12")
    return positions, sizes


def _dots_on_surface(sensor: Sensor, image: np.ndarray) -> tuple[np.ndarray, list[str]]:
    mask = rim_mask(sensor, sensor.camera.point_to_pixel(sensor.membrane.rest))
    pattern = find_dots(image, sensor.markers.polarity, mask)
    origin, direction = (ray.numpy() for ray in sensor.camera.pixel_to_ray(torch.from_numpy(pattern.pixels)))
    distance = fine_surface(sensor).ray_points(origin, direction).distance
    met = np.isfinite(distance)
    positions = origin + distance[:, None] * direction
    return positions[met], ["large" if size else "small" for size in pattern.sizes[met]]


@check_arguments
def rest_from_views(
    sensor: Sensor,
    images: Sequence[np.ndarray],
    motions: np.ndarray | None = None,
    travel_error: float | None = None,
    *,
    progress: Progress = silent,
) -> ViewsFit:
    """Dots and rest surface from P views; the first view is the sensor's own, or its first one.

    Bundle adjustment: all dots, all poses but the first. Then the designed surface is moved along its normals onto the dots.

    Args:
        sensor: the design.
        images: P views `[H, W]` of the membrane at rest, grey in 0..1: by one camera that moved, or one of each view of a
            sensor with several.
        motions: `[P, 6]` where one camera was, roughly: its position (length unit) and rotation (rotation vector, degrees) in
            the first image's frame, the first row zeros. None of a sensor with several views, whose poses are the first guess.
            Dots must be predicted to half their pitch.
        travel_error: standard deviation of the distance from the first view to the second one, length unit; default:
            `TRAVEL_ERROR`, 0.01 mm. Images do not show the scale; this length sets it.
        progress: is told how far it is.

    Returns:
        The sensor with surface and dots found, of several views with their poses, and the fit.

    Raises:
        MembraneError: fewer than two views, motions of another shape, no travel or one that is known too badly to set the
            scale, too few dots, images that no motions near these explain, or a surface so far from the design that its scale
            is wrong.

    Limitations:
        What moves the surface within itself, and its rim outside the dots, is not observed. At least two views must differ.
        Of one camera that moved, a dot that a single image shows is left out; of a sensor with several views, it is placed on
        the surface that the others show.
    """
    sensor.refuse_heights("calibrate views")
    stations = _stations(sensor, images, motions)
    images = [
        check_image("calibrate views: an image", image, station.sensor.camera.image_size)
        for image, station in zip(images, stations, strict=True)
    ]
    if travel_error is None:
        travel_error = TRAVEL_ERROR * millimetre(sensor.length_unit)
    _refuse_unknown_scale(float(np.linalg.norm(stations[1].position)), travel_error, sensor.length_unit)
    bundle, sizes = _measured(sensor, stations, images, within(progress, 0.0, 0.6))
    progress(0.6, "bundle adjustment")
    bundle, kept = bundle.in_two_views()
    sizes = [size for size, keep in zip(sizes, kept, strict=True) if keep]
    problem, found = bundle_adjusted(bundle, travel_error)
    _refuse_misfit(sensor, found.noise)
    shared = _shared_errors([station.sensor.camera for station in stations], bundle.pixels, problem.used)
    found = with_common_errors(found, problem.jacobian(found.values), shared)
    dots, residuals = found.values[problem.own :].reshape(-1, 3), problem.pixel_residuals(found.values)
    progress(0.8, "rest surface through the dots")
    surface = fine_surface(sensor)
    projection, n = surface_projection(surface, dots), problem.own
    blocks = np.stack([found.covariance[d : d + 3, d : d + 3] for d in range(n, len(found.values), 3)])
    change = correction(surface, projection, np.einsum("di,dij,dj->d", projection.normals, blocks, projection.normals))
    _refuse_other_scale(change, surface.size, sensor.length_unit)
    moved = recalibrated(sensor, surface, change.vertices, dots, sizes, images[0])
    if sensor.views:
        poses = [station.pose(motion) for station, motion in zip(stations[1:], found.values[:n].reshape(-1, 6), strict=True)]
        moved = with_dots_of_each_view(_placed(moved, poses, images), images)
    of_views = [f"{view.name}.{number}" for view in sensor.views[1:] for number in NUMBERS]
    names = of_views or [f"{number}[{p}]" for p in range(1, len(images)) for number in NUMBERS]
    guess = np.concatenate([[*np.rad2deg(station.rotation), *station.position] for station in stations[1:]])
    found = found.in_degrees(len(images) - 1)
    return ViewsFit(moved, names, guess, found, dots, found.deviations[n:].reshape(-1, 3), change, residuals)


def _refuse_unknown_scale(travel: float, error: float, unit: str) -> None:
    if not error <= OBSERVED * travel:
        raise MembraneError(
            f"calibrate views: the second view travelled by {travel:.4g} {unit}, known to {error:.4g} {unit}; expected to a "
            "tenth at least, as nothing else tells the scale: move the camera farther, or measure its travel (--travel-error)"
        )


def _refuse_misfit(sensor: Sensor, noise: float) -> None:
    limit = LARGEST_NOISE * float(np.hypot(*sensor.camera.image_size))
    if not noise <= limit:
        raise MembraneError(
            f"calibrate views: the dots lie {noise:.2f} px (rms) off the best motions found; expected at most {limit:.2f}: "
            f"check that the motions are in the order of the images and in {sensor.length_unit} and degrees, and the lens"
        )


def _refuse_other_scale(change: Correction, size: float, unit: str) -> None:
    moved = float(np.sqrt((change.offsets**2).mean()))
    if not moved <= MOST_MOVED * size:
        raise MembraneError(
            f"calibrate views: the surface would be moved by {moved:.4g} {unit} rms, its size is {size:.4g} {unit}; expected "
            f"at most {MOST_MOVED * size:.4g} {unit}: check that the motions are in {unit}, as the sensor file is, and the "
            "travel of the second view, which sets the scale"
        )


class _Station(NamedTuple):
    """From where an image was taken.

    Attributes:
        sensor: camera and dots, of a sensor with several views those of the view.
        rotation: rotation vector `[3]` (rad) of its frame in the first one's; of a mirror the rotation after `flip`.
        position: `[3]` of its centre of projection there.
        flip: `[3]`, which a mirror does first: a reflection of x.
    """

    sensor: Sensor
    rotation: np.ndarray
    position: np.ndarray
    flip: np.ndarray

    def points(self, points: np.ndarray) -> np.ndarray:
        """Points `[..., 3]` of the first frame in this one."""
        seen: np.ndarray = (points - self.position) @ rotations(torch.from_numpy(self.rotation)).numpy() * self.flip
        return seen

    def project(self, points: Tensor) -> Tensor:
        """Pixels of points `[..., 3]` of this frame before `flip`."""
        pixels: Tensor = self.sensor.camera.point_to_pixel(points * torch.from_numpy(self.flip))
        return pixels

    def pose(self, motion: np.ndarray) -> ViewPose:
        """The view's pose after a motion `[6]`, as of `Bundle`."""
        return ViewPose(rotations(torch.from_numpy(motion[:3])).numpy() * self.flip, motion[3:])


def _stations(sensor: Sensor, images: Sequence[np.ndarray], motions: np.ndarray | None) -> list[_Station]:
    """From where each image was taken, as told.

    Raises:
        MembraneError: too few images or another number of them, no motions of one camera, or motions of several views.
    """
    count = len(images)
    if sensor.views:
        if motions is not None or count != len(sensor.views):
            given = f"{count} images" if motions is None else f"{count} images and motions"
            raise MembraneError(
                f"calibrate views: {given}; expected one image of each of {len(sensor.views)} views, no motions"
            )
        return [_station_of_view(sensor, number) for number in range(count)]
    where = np.zeros((0, 6)) if motions is None else np.asarray(motions, float)
    if count < 2 or where.shape != (count, 6) or np.abs(where[0]).max() > 0:
        raise MembraneError(
            f"calibrate views: {count} images, motions {list(where.shape)}; expected 2 or more, [P, 6], first zeros"
        )
    return [_Station(sensor, np.deg2rad(row[3:]), row[:3], np.ones(3)) for row in where]


def _station_of_view(sensor: Sensor, number: int) -> _Station:
    pose = sensor.views[number].pose
    flip = np.array([pose.determinant, 1.0, 1.0])
    vector = Rotation.from_matrix(pose.rotation * flip).as_rotvec()
    return _Station(sensor.in_view(number), vector, pose.translation, flip)


def _placed(sensor: Sensor, poses: Sequence[ViewPose], images: Sequence[np.ndarray]) -> Sensor:
    """The sensor with these poses of its further views, and all views' rest images."""
    first, *others = sensor.views
    placed = [
        replace(view, pose=pose, rest_image=image.astype(np.float32))
        for view, pose, image in zip(others, poses, images[1:], strict=True)
    ]
    return replace(sensor, views=(first, *placed))


def with_dots_of_each_view(sensor: Sensor, images: Sequence[np.ndarray]) -> Sensor:
    """The sensor with the dots that one view alone shows, too, where their rays meet the rest surface.

    Args:
        sensor: with several views, its poses, surface and other dots as they are.
        images: of each view, `[H, W]` at rest, grey in 0..1.

    Limitations:
        A dot that is found at less than half the pitch from a known one is taken for that one.
    """
    positions = np.asarray(sensor.markers.positions)
    sizes = list(sensor.markers.sizes or ["small"] * len(positions))
    pitch = np.median(np.asarray(cKDTree(positions).query(positions, k=2)[0])[:, 1])
    for number, (view, image) in enumerate(zip(sensor.views, images, strict=True)):
        found, their_sizes = _dots_on_surface(sensor.in_view(number), image)
        found = view.pose.points(found)
        is_new = np.asarray(cKDTree(positions).query(found)[0]) > 0.5 * pitch
        positions = np.concatenate([positions, found[is_new]])
        sizes += [size for size, new in zip(their_sizes, is_new, strict=True) if new]
    markers = Markers("dots", sensor.markers.polarity, positions, sizes, sensor.markers.rest_image)
    return replace(sensor, markers=markers)


def _measured(
    sensor: Sensor, stations: Sequence[_Station], images: Sequence[np.ndarray], progress: Progress
) -> tuple[Bundle, list[str]]:
    """The dots as first placed and as measured in every view, and their sizes."""
    progress(0.0, "dots of the first view")
    surface = fine_surface(sensor)
    dots, sizes = placed_dots(stations[0].sensor, images[0])
    large = np.array([size == "large" for size in sizes], dtype=int)
    outlines, pixels = [], []
    for p, (image, station) in enumerate(zip(images, stations, strict=True)):
        progress((1 + p) / (1 + len(images)), f"dots of view {p + 1} of {len(images)}")
        found = measured_outlines(station.sensor, surface, dots, large, image, station.points)
        outlines.append(found[0])
        pixels.append(found[1])
    around = np.median(outlines, 0) - dots[:, None]
    motions = np.stack([np.concatenate([station.rotation, station.position]) for station in stations[1:]])
    projections = [station.project for station in stations]
    return Bundle(projections, motions, dots, around, np.stack(pixels)), sizes


def _shared_errors(cameras: Sequence[Camera], pixels: np.ndarray, used: np.ndarray) -> np.ndarray:
    """Errors that the used dots of each view share, `[residuals, 3 P]` px: outwards, and to either side."""
    sideways = np.broadcast_to(SIDEWAYS * np.eye(2)[:, None], (2, used.sum(), 2))
    outwards = [shading_bias(camera, of_view[row]) for camera, of_view, row in zip(cameras, pixels, used, strict=True)]
    biases = np.concatenate([np.concatenate(outwards)[None], sideways])
    of_view = np.nonzero(used)[0][:, None] == np.arange(len(used))
    errors = np.einsum("knc,np->nckp", biases, of_view).reshape(-1, 3 * len(used))
    return np.pad(errors, ((0, 1), (0, 0)))
