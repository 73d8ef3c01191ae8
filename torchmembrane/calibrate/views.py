"""Dots that nobody listed: their positions from several views, and the rest surface through them."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch

from ..errors import MembraneError, check_arguments
from ..files.grayscale import check_image
from ..markers.dots.pattern import find_dots
from ..markers.placement import rim_mask
from ..progress import Progress, silent, within
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
SIDEWAYS = 0.015  # px: a turned view is shaded to one side, and its located dots share a shift (0.024 px at 4 degrees)


class ViewsFit(NamedTuple):
    """The sensor with the surface and dots that several views show.

    Attributes:
        sensor: the sensor with the surface and dots found.
        names: names of the 6 numbers of each camera pose but the first.
        fit: fit of these numbers (degrees, length unit), and then of the dots (length unit, first camera's frame).
        dots: `[D, 3]`.
        deviations: `[D, 3]` standard deviations of the dots.
        surface: `Correction` of the designed surface.
        residuals: `[P, D, 2]` px, measured less modelled, NaN where not used.
    """

    sensor: Sensor
    names: list[str]
    fit: Fit
    dots: np.ndarray
    deviations: np.ndarray
    surface: Correction
    residuals: np.ndarray


def placed_dots(sensor: Sensor, image: np.ndarray) -> tuple[np.ndarray, list[str]]:
    """The dots found in a rest image, where their rays meet the designed surface: `[D, 3]` and sizes."""
    mask = rim_mask(sensor, sensor.camera.point_to_pixel(sensor.membrane.rest))
    pattern = find_dots(image, sensor.markers.polarity, mask)
    origin, direction = (ray.numpy() for ray in sensor.camera.pixel_to_ray(torch.from_numpy(pattern.pixels)))
    distance = fine_surface(sensor).ray_points(origin, direction).distance
    met = np.isfinite(distance)
    if met.sum() < 12:
        raise MembraneError(f"calibrate: {met.sum()} dots found on the rest surface; expected at least 12")
    positions = origin + distance[:, None] * direction
    return positions[met], ["large" if size else "small" for size in pattern.sizes[met]]


@check_arguments
def rest_from_views(
    sensor: Sensor,
    images: Sequence[np.ndarray],
    motions: np.ndarray,
    travel_error: float | None = None,
    *,
    progress: Progress = silent,
) -> ViewsFit:
    """Dots and rest surface from P views by a camera that moved; the first view is the sensor's own.

    Bundle adjustment: all dots, all poses but the first. Then the designed surface is moved along its normals onto the dots.

    Args:
        sensor: the design.
        images: P views `[H, W]` of the membrane at rest, grey in 0..1.
        motions: `[P, 6]` where the camera was, roughly: its position (length unit) and rotation (rotation vector, degrees) in
            the first camera's frame, the first row zeros. Dots must be predicted to half their pitch.
        travel_error: standard deviation of the second view's travel, length unit; default: `TRAVEL_ERROR`, 0.01 mm. Images do
            not show the scale; this length sets it.
        progress: is told how far it is.

    Returns:
        The sensor with surface and dots found, and the fit.

    Raises:
        MembraneError: fewer than two views, motions of another shape, no travel or one that is known too badly to set the
            scale, too few dots, images that no motions near these explain, or a surface so far from the design that its scale
            is wrong.

    Limitations:
        What moves the surface within itself, and its rim outside the dots, is not observed. At least two views must differ.
    """
    sensor.refuse_heights("calibrate views")
    motions = np.asarray(motions, float)
    images = [check_image("calibrate views: an image", image, sensor.camera.image_size) for image in images]
    if len(images) < 2 or motions.shape != (len(images), 6) or np.abs(motions[0]).max() > 0:
        raise MembraneError(
            f"calibrate views: {len(images)} images, motions {list(motions.shape)}; expected 2 or more, [P, 6], first zeros"
        )
    if travel_error is None:
        travel_error = TRAVEL_ERROR * millimetre(sensor.length_unit)
    _refuse_unknown_scale(float(np.linalg.norm(motions[1, :3])), travel_error, sensor.length_unit)
    bundle, sizes = _measured(sensor, images, motions, within(progress, 0.0, 0.6))
    progress(0.6, "bundle adjustment")
    bundle, kept = bundle.in_two_views()
    sizes = [size for size, keep in zip(sizes, kept, strict=True) if keep]
    problem, found = bundle_adjusted(sensor.camera, bundle, travel_error)
    _refuse_misfit(sensor, found.noise)
    found = with_common_errors(found, problem.jacobian(found.values), _shared_errors(sensor, bundle.pixels, problem.used))
    dots, residuals = found.values[problem.own :].reshape(-1, 3), problem.pixel_residuals(found.values)
    progress(0.8, "rest surface through the dots")
    surface = fine_surface(sensor)
    projection, n = surface_projection(surface, dots), problem.own
    blocks = np.stack([found.covariance[d : d + 3, d : d + 3] for d in range(n, len(found.values), 3)])
    change = correction(surface, projection, np.einsum("di,dij,dj->d", projection.normals, blocks, projection.normals))
    _refuse_other_scale(change, surface.size, sensor.length_unit)
    moved = recalibrated(sensor, surface, change.vertices, dots, sizes, images[0])
    numbers = ("turn_x", "turn_y", "turn_z", "place_x", "place_y", "place_z")
    names = [f"{name}[{p}]" for p in range(1, len(images)) for name in numbers]
    found = found.in_degrees(len(images) - 1)
    return ViewsFit(moved, names, found, dots, found.deviations[n:].reshape(-1, 3), change, residuals)


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


def _measured(
    sensor: Sensor, images: Sequence[np.ndarray], motions: np.ndarray, progress: Progress
) -> tuple[Bundle, list[str]]:
    """The dots as first placed and as measured in every view, and their sizes."""
    progress(0.0, "dots of the first view")
    surface = fine_surface(sensor)
    dots, sizes = placed_dots(sensor, images[0])
    large = np.array([size == "large" for size in sizes], dtype=int)
    rotation_vectors, positions = np.deg2rad(motions[:, 3:]), motions[:, :3]
    outlines, pixels = [], []
    for p, (image, vector, position) in enumerate(zip(images, rotation_vectors, positions, strict=True)):
        progress((1 + p) / (1 + len(images)), f"dots of view {p + 1} of {len(images)}")
        R = rotations(torch.from_numpy(vector)).numpy()

        def camera_points(x: np.ndarray, R: np.ndarray = R, position: np.ndarray = position) -> np.ndarray:
            return (x - position) @ R

        found = measured_outlines(sensor, surface, dots, large, image, camera_points)
        outlines.append(found[0])
        pixels.append(found[1])
    around = np.median(outlines, 0) - dots[:, None]
    return Bundle(np.concatenate([rotation_vectors, positions], 1)[1:], dots, around, np.stack(pixels)), sizes


def _shared_errors(sensor: Sensor, pixels: np.ndarray, used: np.ndarray) -> np.ndarray:
    """Errors that the used dots of each view share, `[residuals, 3 P]` px: outwards, and to either side."""
    sideways = np.broadcast_to(SIDEWAYS * np.eye(2)[:, None], (2, used.sum(), 2))
    biases = np.concatenate([shading_bias(sensor, pixels[used])[None], sideways])
    of_view = np.nonzero(used)[0][:, None] == np.arange(len(used))
    errors = np.einsum("knc,np->nckp", biases, of_view).reshape(-1, 3 * len(used))
    return np.pad(errors, ((0, 1), (0, 0)))
