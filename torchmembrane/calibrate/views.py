"""Positions of unlisted dots from several views, and the rest surface through them.

The views are those of one camera that was moved, or those of a sensor with several views.
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
from ..torch_modes import on_cpu
from .bundle import Bundle, bundle_adjusted
from .fit import LARGEST_NOISE, Fit, rotations, with_common_errors
from .rest import measured_outlines, shading_bias
from .surface import Correction, correction, fine_surface, recalibrated, surface_projection

TRAVEL_ERROR = 0.01  # mm
OBSERVED = 0.1  # largest standard deviation of the travel over the travel, so that the scale is determined
MOST_MOVED = 0.1  # largest rms correction over the surface's size: beyond, the scale differs from the design's
NUMBERS = ("turn_x", "turn_y", "turn_z", "place_x", "place_y", "place_z")
SIDEWAYS = 0.015  # px, common shift of located dots by one-sided shading in a rotated view (0.024 px at 4 degrees)


class ViewsFit(NamedTuple):
    """The sensor with surface and dots found in several views.

    Attributes:
        sensor: the sensor with the surface and dots found.
        names: names of the 6 numbers of each camera pose but the first: `turn_x[1]` for an image, `right.turn_x` for a view.
        first_guess: first guess of these numbers.
        fit: fit of these numbers (degrees, length unit), followed by the dots (length unit, first camera's frame).
        dots: positions of the dots, `[D, 3]`.
        deviations: standard deviations of the dots' coordinates, `[D, 3]`.
        surface: the `Correction` of the designed surface.
        residuals: measured minus modelled pixels, `[P, D, 2]`; NaN where not used.
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
    """Find dots in a rest image and place them where their rays meet the designed surface; return positions `[D, 3]` and sizes.

    Raises:
        MembraneError: fewer than 12 dots are found.
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
@on_cpu
def rest_from_views(
    sensor: Sensor,
    images: Sequence[np.ndarray],
    motions: np.ndarray | None = None,
    travel_error: float | None = None,
    *,
    progress: Progress = silent,
) -> ViewsFit:
    """Find dots and rest surface in P views; the first view's frame is the sensor's.

    Bundle adjustment fits all dots and all poses but the first. Then the designed surface is moved along its normals onto the
    dots.

    Args:
        sensor: the design.
        images: P grey images of the membrane at rest, `[H, W]`, in 0..1: from one camera that was moved, or one from each view
            of a sensor with several views.
        motions: approximate poses of the moved camera, `[P, 6]`: position (length unit) and rotation vector (degrees) in the
            first image's frame; the first row is zero. They must predict dots to half their pitch. None for a sensor with
            several views, whose poses are the first guess.
        travel_error: standard deviation of the distance between the first and the second view, length unit; default:
            `TRAVEL_ERROR`, 0.01 mm. Images do not show the scale; this distance sets it.
        progress: called with the completed share.

    Returns:
        The `ViewsFit`; the poses of a sensor with several views are fitted as well.

    Raises:
        MembraneError: there are fewer than two views; motions have the wrong shape; there is no travel, or it is too inaccurate
            to set the scale; too few dots are found; no motions near these fit the images; or the surface is so far from the
            design that its scale must be wrong.

    Limitations:
        Tangential displacements of the surface, and the rim outside the dots, are not observed. At least two views must differ.
        With one moved camera, a dot seen in a single image is ignored; with several views, it is placed on the surface found
        from the others.
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
    """The camera and approximate pose of one image.

    Attributes:
        sensor: the sensor with the image's camera and dots; with several views, the sensor of that view.
        rotation: rotation vector of the image's frame in the first frame, `[3]`, rad; for a mirror, the rotation after `flip`.
        position: position of the centre of projection in the first frame, `[3]`.
        flip: factors of x, y and z, `[3]`, applied first: a mirror reflects x.
    """

    sensor: Sensor
    rotation: np.ndarray
    position: np.ndarray
    flip: np.ndarray

    def points(self, points: np.ndarray) -> np.ndarray:
        """Transform points `[..., 3]` from the first frame to this one."""
        seen: np.ndarray = (points - self.position) @ rotations(torch.from_numpy(self.rotation)).numpy() * self.flip
        return seen

    def project(self, points: Tensor) -> Tensor:
        """Return the pixels of points `[..., 3]` in this image's frame, to which `flip` has not been applied."""
        pixels: Tensor = self.sensor.camera.point_to_pixel(points * torch.from_numpy(self.flip))
        return pixels

    def pose(self, motion: np.ndarray) -> ViewPose:
        """Return the view's pose for a motion `[6]` as in `Bundle`."""
        return ViewPose(rotations(torch.from_numpy(motion[:3])).numpy() * self.flip, motion[3:])


def _stations(sensor: Sensor, images: Sequence[np.ndarray], motions: np.ndarray | None) -> list[_Station]:
    """Return camera and approximate pose of each image.

    Raises:
        MembraneError: the number of images is wrong, or motions are missing (one camera) or given (several views).
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
    """Return the sensor with these poses and rest images of its further views."""
    first, *others = sensor.views
    placed = [
        replace(view, pose=pose, rest_image=image.astype(np.float32))
        for view, pose, image in zip(others, poses, images[1:], strict=True)
    ]
    return replace(sensor, views=(first, *placed))


def with_dots_of_each_view(sensor: Sensor, images: Sequence[np.ndarray]) -> Sensor:
    """Add the dots that only one view shows, placed where their rays meet the rest surface.

    Args:
        sensor: the sensor with several views, whose poses, surface and other dots are known.
        images: rest image of each view, grey, `[H, W]`, in 0..1.

    Limitations:
        A dot found within half the pitch of a known one is taken for the known one.
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
    """Return the bundle of initially placed dots and their measured pixels in every view, and the dots' sizes."""
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
    """Return the errors that the used dots of each view share, `[residuals, 3 P]`, px: outward, along u, and along v."""
    sideways = np.broadcast_to(SIDEWAYS * np.eye(2)[:, None], (2, used.sum(), 2))
    outwards = [shading_bias(camera, of_view[row]) for camera, of_view, row in zip(cameras, pixels, used, strict=True)]
    biases = np.concatenate([np.concatenate(outwards)[None], sideways])
    of_view = np.nonzero(used)[0][:, None] == np.arange(len(used))
    errors = np.einsum("knc,np->nckp", biases, of_view).reshape(-1, 3 * len(used))
    return np.pad(errors, ((0, 1), (0, 0)))
