"""Where the rest surface stands before the camera, and where its dots are, from one rest image (section 5.2)."""

from typing import NamedTuple

import numpy as np
import torch
from torch.func import jacfwd, vmap

from ..errors import MembraneError
from ..markers.dots import measure_dots
from ..sensor.model import Sensor
from .fit import Fit, fit, outline_centres, rotations, strays, with_common_errors
from .surface import dot_outlines, fine_surface, frames_at, recalibrated, unit_shapes

NAMES = ["tilt_x", "tilt_y", "tilt_z", "offset_x", "offset_y", "offset_z"]
BIAS = 0.03  # px, outwards: of located dots on a shaded surface, the same for all of them (up to 0.026 px, docs/calibration.md)
GUESS = 0.02  # radius of a dot before it is measured, over the surface's size


class RestFit(NamedTuple):
    """The sensor with its surface and dots where one image shows them.

    fit: of `NAMES`: the turn about the rim's centre as a rotation vector (degrees) and its offset (length unit), from the
    design; pixels: `[D, 2]` measured centres of outlines, NaN where not seen; residuals: `[D, 2]` px, measured less modelled
    by the pose alone; shifts: `[D, 3]` by which the dots were then moved along the surface to null them.
    """

    sensor: Sensor
    names: list[str]
    fit: Fit
    pixels: np.ndarray
    residuals: np.ndarray
    shifts: np.ndarray


def rest_from_image(sensor: Sensor, image: np.ndarray) -> RestFit:
    """Pose of the rest surface, then the dots' own places on it, from a rest image `[H, W]` of listed dots.

    The pose is the one from which the camera sees the listed dots where they are measured; what is left is taken for errors of
    the dots' places and nulled by moving them within the surface. Wrong where the surface has another shape than designed: then
    use several views or a depth image.
    """
    if sensor.markers.positions is None:
        raise MembraneError("calibrate rest: the sensor lists no dots; expected [markers] file, or use views or depth")
    surface, X = fine_surface(sensor), sensor.markers.positions
    sizes = np.array([size == "large" for size in sensor.markers.sizes], dtype=int)
    outlines, pixels = measured_outlines(sensor, surface, X, sizes, image)
    pivot = surface.rest[surface.fixed].mean(0)
    visible = np.isfinite(pixels).all(1)
    used = visible.copy()

    def modelled(theta, outlines):
        return outline_centres(sensor.camera.point_to_pixel((outlines - pivot) @ rotations(theta[:3]).mT + pivot + theta[3:]))

    def residuals(theta):
        return modelled(torch.from_numpy(theta), torch.from_numpy(outlines[used])).numpy().ravel() - pixels[used].ravel()

    def jacobian(theta):
        return jacfwd(modelled)(torch.from_numpy(theta), torch.from_numpy(outlines[used])).flatten(0, 1).numpy()

    result = fit(residuals, jacobian, np.zeros(6), "calibrate rest")
    used[used] = ~strays(result.residuals.reshape(-1, 2))
    result = fit(residuals, jacobian, result.values, "calibrate rest")
    found = result.values
    result = with_common_errors(result, jacobian(found), shading_bias(sensor, pixels[used]).reshape(-1, 1))
    turn, shift = rotations(torch.from_numpy(found[:3])).numpy(), found[3:]
    move = lambda x: (x - pivot.numpy()) @ turn.T + pivot.numpy() + shift  # noqa: E731
    residuals = pixels - modelled(torch.from_numpy(found), torch.from_numpy(outlines)).numpy()
    _, tangents = frames_at(surface, X)
    shifts = _nulling(sensor, move(outlines), turn @ tangents, pixels, visible)
    moved = recalibrated(sensor, surface, move(surface.rest.numpy()), move(X) + shifts, sensor.markers.sizes, image)
    return RestFit(moved, NAMES, _in_degrees(result), pixels, residuals, shifts)


def shading_bias(sensor: Sensor, pixels: np.ndarray) -> np.ndarray:
    """One standard deviation of the error that dots located at `pixels [..., 2]` share, `[..., 2]` px."""
    outwards = pixels - sensor.camera.centre.numpy()
    return BIAS * outwards / np.linalg.norm(outwards, axis=-1, keepdims=True).clip(1)


def measured_outlines(sensor: Sensor, surface, X: np.ndarray, sizes: np.ndarray, image: np.ndarray, camera_points=None):
    """Outlines `[D, 8, 3]` of dots at `X [D, 3]` on the surface, as large as `image` shows them, and their pixels `[D, 2]`.

    `camera_points`: from the surface's frame to that of the image's camera, where it is another.
    """
    camera_points = camera_points or (lambda x: x)
    guess = np.full(len(X), GUESS * surface.size)
    rough = dot_outlines(surface, X, guess)
    shapes = unit_shapes(sensor.camera, camera_points(rough), guess)
    expected = sensor.camera.point_to_pixel(torch.from_numpy(camera_points(X))).numpy()
    pattern = measure_dots(image, expected, shapes, sizes, sensor.markers.polarity)
    visible = np.isfinite(pattern.pixels).all(1)
    if visible.sum() < 8:
        raise MembraneError(f"calibrate: {visible.sum()} of {len(X)} dots found in the image; expected at least 8")
    radii = np.sqrt(np.abs(np.linalg.det(pattern.shapes) / np.linalg.det(shapes)))
    return dot_outlines(surface, X, radii), pattern.pixels


def _nulling(sensor: Sensor, outlines: np.ndarray, tangents: np.ndarray, pixels: np.ndarray, visible: np.ndarray) -> np.ndarray:
    """Shifts `[D, 3]` within the tangent plane after which each seen dot is modelled where it is measured; else 0."""
    outlines, tangents, target = (torch.from_numpy(np.ascontiguousarray(a[visible])) for a in (outlines, tangents, pixels))

    def modelled(step, outline, tangent):
        return outline_centres(sensor.camera.point_to_pixel(outline + tangent @ step))

    step = torch.zeros(len(target), 2, dtype=torch.float64)
    for _ in range(3):
        left = target - vmap(modelled)(step, outlines, tangents)
        step = step + torch.linalg.solve(vmap(jacfwd(modelled))(step, outlines, tangents), left)
    shifts = np.zeros((len(visible), 3))
    shifts[visible] = (tangents @ step[..., None]).squeeze(-1).numpy()
    return shifts


def _in_degrees(found: Fit) -> Fit:
    scale = np.array([180 / np.pi] * 3 + [1.0] * 3)
    return found._replace(values=scale * found.values, covariance=scale[:, None] * found.covariance * scale)
