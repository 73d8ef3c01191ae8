"""Pose of the rest surface relative to the camera, and the dots on it, from one rest image (section 5.2)."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.func import jacfwd, vmap

from ..camera.model import Camera
from ..errors import MembraneError, check_arguments
from ..files.grayscale import check_image
from ..markers.dots.pattern import measure_dots
from ..markers.spacing import neighbours
from ..progress import Progress, silent
from ..sensor.inflated import InflatedSurface
from ..sensor.sensor import Sensor
from ..surface.membrane import Membrane
from ..torch_modes import on_cpu
from ..user_warnings import warn_user
from .fit import Fit, fit, outliers, outline_centres, rotations, with_common_errors
from .known_modulus import refuse_overpressure
from .surface import dot_outlines, fine_surface, frames_at, recalibrated, unit_shapes

NAMES = ["tilt_x", "tilt_y", "tilt_z", "offset_x", "offset_y", "offset_z"]
BIAS = 0.03  # px, common outward shift of located dots on a shaded surface (up to 0.026 px, docs/calibration.md)
PRESSED = 4e-4  # largest rms of the residuals that neighbouring dots share, over the image's diagonal
NEIGHBOURS = 6
GUESS = 0.02  # radius of a dot before it is measured, over the surface's size


class RestFit(NamedTuple):
    """The sensor with surface and dots found in one image.

    Attributes:
        sensor: the sensor with the pose and dots found.
        names: names of the fitted parameters: the six of the pose and, if the surface is inflated, its height and prestretch.
        fit: fit of the pose relative to the design: rotation vector about the rim's centre (degrees), and offset (length
            unit); if the surface is inflated, also of its height and prestretch.
        pixels: measured centres of the dots' outlines, `[D, 2]`, px; NaN where a dot is not visible.
        residuals: measured minus modelled pixels after the fit of the pose, `[D, 2]`.
        shifts: subsequent shifts of the dots along the surface that null the residuals, `[D, 3]`, length unit.
    """

    sensor: Sensor
    names: list[str]
    fit: Fit
    pixels: np.ndarray
    residuals: np.ndarray
    shifts: np.ndarray


@check_arguments
@on_cpu
def rest_from_image(
    sensor: Sensor, image: np.ndarray, overpressure: float | None = None, *, progress: Progress = silent
) -> RestFit:
    """Find the pose of the rest surface, then each dot's position on it, in a rest image of listed dots.

    The pose minimises the distances of the listed dots from their measured pixels. The remaining residuals are attributed to
    errors of the dots' positions and are nulled by moving the dots within the surface.

    Args:
        sensor: the design, with a list of dots.
        image: grey image of the membrane at rest, `[H, W]`, in 0..1.
        overpressure: gauge reading at rest, hPa; for inflated surfaces only.
        progress: called with the completed share.

    Returns:
        The `RestFit`; for an inflated surface, height and prestretch are fitted as well.

    Raises:
        MembraneError: the sensor lists no dots, fewer than 8 of them are found, or the gauge reading contradicts the gas in the
            cavity or the modulus.

    Limitations:
        The surface must have the designed shape. If it has another shape or is in contact, a warning is issued, except if the
        common shift of neighbouring dots is below `PRESSED` of the image's diagonal; use several views or a depth image then.

    Example:
        >>> from dataclasses import replace
        >>> from torchmembrane import Camera
        >>> sensor = Sensor.from_file("examples/sensor.toml")
        >>> image = sensor.markers.rest_image[::2, ::2]  # every other pixel, and a camera that sees them
        >>> camera = Camera("fisheye", (320, 240), (80.0, 80.0), (161.05, 121.45))
        >>> design = replace(sensor, camera=camera, markers=replace(sensor.markers, rest_image=image))
        >>> found = rest_from_image(design, image)
        >>> bool(np.abs(found.fit.values[3:]).max() < 0.1)  # mm: the sensor stands where its file says
        True
    """
    if sensor.markers.positions is None:
        raise MembraneError("calibrate rest: the sensor lists no dots; expected [markers] file, or use views or depth")
    sensor.refuse_heights("calibrate rest")
    refuse_overpressure("calibrate rest", overpressure, sensor)
    if isinstance(sensor.surface, InflatedSurface):
        from .rest_of_sheet import rest_of_sheet  # here: it builds on this module

        return rest_of_sheet(sensor, image, overpressure, progress)
    _refuse_gauge(sensor, overpressure)
    image = check_image("calibrate rest: the image", image, sensor.camera.image_size)
    progress(0.0, "dots of the image")
    surface, X = fine_surface(sensor), sensor.markers.positions
    sizes = np.array([int(size == "large") for size in sensor.markers.sizes or ()])
    outlines, pixels = measured_outlines(sensor, surface, X, sizes, image)
    progress(0.3, "pose of the rest surface")
    pivot = surface.rest[surface.fixed].mean(0)
    visible = np.isfinite(pixels).all(1)
    used = visible.copy()

    def modelled(theta: Tensor, outlines: Tensor) -> Tensor:
        return outline_centres(sensor.camera.point_to_pixel((outlines - pivot) @ rotations(theta[:3]).mT + pivot + theta[3:]))

    def residuals(theta: np.ndarray) -> np.ndarray:
        return modelled(torch.from_numpy(theta), torch.from_numpy(outlines[used])).numpy().ravel() - pixels[used].ravel()

    def jacobian(theta: np.ndarray) -> np.ndarray:
        return jacfwd(modelled)(torch.from_numpy(theta), torch.from_numpy(outlines[used])).flatten(0, 1).numpy()

    result = fit(residuals, jacobian, np.zeros(6), "calibrate rest")
    used[used] = ~outliers(result.residuals.reshape(-1, 2))
    result = fit(residuals, jacobian, result.values, "calibrate rest")
    found = result.values
    result = with_common_errors(result, jacobian(found), shading_bias(sensor.camera, pixels[used]).reshape(-1, 1))
    rotation, offset = rotations(torch.from_numpy(found[:3])).numpy(), found[3:]

    def move(x: np.ndarray) -> np.ndarray:
        return (x - pivot.numpy()) @ rotation.T + pivot.numpy() + offset

    left = pixels - modelled(torch.from_numpy(found), torch.from_numpy(outlines)).numpy()
    warn_of_press(sensor, pixels[visible], left[visible])
    progress(0.75, "dots on the rest surface")
    _, tangents = frames_at(surface, X)
    shifts = nulling(sensor, move(outlines), rotation @ tangents, pixels, visible)
    progress(0.77, "rest surface where it was found")
    moved = recalibrated(sensor, surface, move(surface.rest.numpy()), move(X) + shifts, sensor.markers.sizes, image)
    return RestFit(moved, NAMES, result.in_degrees(1), pixels, left, shifts)


def _refuse_gauge(sensor: Sensor, overpressure: float | None) -> None:
    if overpressure is not None:
        raise MembraneError(
            f"calibrate rest: an overpressure, of a {sensor.surface.shape!r}; expected an inflated surface: only its shape "
            "follows from a pressure"
        )


def common_residual(pixels: np.ndarray, residuals: np.ndarray) -> float:
    """Return the rms of the residuals that neighbouring dots share, px: `sqrt(mean_d r_d . mean_n r_n)`, 0 if uncorrelated.

    Args:
        pixels: pixels of the dots, `[D, 2]`.
        residuals: their residuals, `[D, 2]`, px.

    Example:
        >>> pixels = np.stack(np.meshgrid(np.arange(5.0), np.arange(5.0)), -1).reshape(-1, 2)
        >>> common_residual(pixels, np.full((25, 2), 3.0)), common_residual(pixels, np.eye(25)[:, :2])
        (4.242640687119285, 0.0)
    """
    around = residuals[neighbours(pixels, NEIGHBOURS)].mean(1)
    return float(np.sqrt(max((residuals * around).sum(1).mean(), 0.0)))


def warn_of_press(sensor: Sensor, pixels: np.ndarray, residuals: np.ndarray) -> None:
    """Warn if `residuals [D, 2]` at `pixels [D, 2]` are due to a displacement of the surface, not to errors of single dots."""
    common, limit = common_residual(pixels, residuals), PRESSED * float(np.hypot(*sensor.camera.image_size))
    if common > limit:
        warn_user(
            f"calibrate rest: neighbouring dots lie off the model together, {common:.2f} px rms; expected at most {limit:.2f}: "
            "something presses the membrane in this image, or its shape is not the designed: give an image without contact, "
            "or use views or depth",
        )


def shading_bias(camera: Camera, pixels: np.ndarray) -> np.ndarray:
    """Return one standard deviation of the error that dots located at `pixels [..., 2]` share, `[..., 2]` px."""
    outwards = pixels - camera.centre.numpy()
    return BIAS * outwards / np.linalg.norm(outwards, axis=-1, keepdims=True).clip(1)


def measured_outlines(
    sensor: Sensor,
    surface: Membrane,
    X: np.ndarray,
    sizes: np.ndarray,
    image: np.ndarray,
    camera_points: Callable[[np.ndarray], np.ndarray] = np.asarray,
) -> tuple[np.ndarray, np.ndarray]:
    """Measure sizes and positions of dots in an image.

    Args:
        sensor: the sensor with the camera and the polarity of the dots.
        surface: the surface on which the dots lie.
        X: centres of the dots on the surface, `[D, 3]`.
        sizes: 1 for a large dot, 0 for a small one, `[D]`.
        image: grey image, `[H, W]`, in 0..1.
        camera_points: function that maps points of the surface's frame to the frame of the image's camera, if they differ.

    Returns:
        Outlines `[D, 8, 3]` in the surface's frame, and measured centres `[D, 2]`, px; NaN where a dot is not visible.

    Raises:
        MembraneError: fewer than 8 dots are found.
    """
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


def nulling(sensor: Sensor, outlines: np.ndarray, tangents: np.ndarray, pixels: np.ndarray, visible: np.ndarray) -> np.ndarray:
    """Return the tangential shifts `[D, 3]` that make the modelled pixel of each visible dot equal the measured one; else 0."""
    outline, tangent, target = (torch.from_numpy(np.ascontiguousarray(a[visible])) for a in (outlines, tangents, pixels))

    def modelled(step: Tensor, outline: Tensor, tangent: Tensor) -> Tensor:
        return outline_centres(sensor.camera.point_to_pixel(outline + tangent @ step))

    step = torch.zeros(len(target), 2, dtype=torch.float64)
    for _ in range(3):
        left = target - vmap(modelled)(step, outline, tangent)
        step = step + torch.linalg.solve(vmap(jacfwd(modelled))(step, outline, tangent), left)
    shifts = np.zeros((len(visible), 3))
    shifts[visible] = (tangent @ step[..., None]).squeeze(-1).numpy()
    return shifts
