"""Pose, height and prestretch of an inflated sheet from one rest image of listed dots, and a gauge reading at rest."""

from dataclasses import replace
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.func import jacfwd

from ..errors import MembraneError
from ..files.grayscale import check_image
from ..progress import Progress
from ..sensor.inflated import InflatedSurface
from ..sensor.parts import Markers
from ..sensor.sensor import Sensor
from ..sensor.units import hectopascal
from .fit import Fit, fit, outliers, outline_centres, rotations, with_common_errors
from .rest import NAMES, RestFit, measured_outlines, nulling, shading_bias, warn_of_press
from .surface import fine_surface, frames_at

SHEET_NAMES = [*NAMES, "height", "prestretch"]
STRETCH_ERROR = 0.1  # standard deviation of the file's prestretch; dots alone determine it less accurately
HELD_ERROR = 0.02  # relative standard deviation of gauge reading over modulus
STEP = 0.01  # relative step of height and prestretch for finite differences
LARGEST_RATIO = 1.25  # of the gauge reading and the pressure that the sheet holds with the file's modulus
ROUNDS = 2
CENTRED = 0.5  # px, initial guess of the dots' noise


class _Linear(NamedTuple):
    """Linearisation of the sheet about a height and prestretch `at`: its material `points [D, 3]` with derivatives
    `slopes [D, 3, 2]`, and the logarithm of its pressure with derivatives `[2]`."""

    at: np.ndarray
    points: np.ndarray
    slopes: np.ndarray
    pressure: float
    pressure_slopes: np.ndarray

    def moved(self, change: Tensor) -> Tensor:
        """Return the displacements of the points for a change of height and prestretch `[2]`, `[D, 3]`."""
        return torch.from_numpy(self.slopes) @ change


class _Material:
    """The listed dots as material points of the sheet, with their positions at any height and prestretch."""

    def __init__(self, sensor: Sensor, surface: InflatedSurface, positions: np.ndarray) -> None:
        fine = fine_surface(sensor)
        self.surface, self.grid, near = surface, fine.grid, fine.closest_points(positions)
        self.vertices, self.weights = near.vertices, near.weights
        self.off = positions - self._on(fine.rest.numpy())

    def _on(self, vertices: np.ndarray) -> np.ndarray:
        points: np.ndarray = (vertices[self.vertices] * self.weights[..., None]).sum(1)
        return points

    def sheet_with(self, height: float, prestretch: float) -> InflatedSurface:
        """Return the sheet with this height and prestretch."""
        material = replace(self.surface.material, prestretch=max(1.0, prestretch))
        return replace(self.surface.of_height(height), material=material)

    def positions(self, sheet: InflatedSurface) -> np.ndarray:
        """Return the positions of the dots on a sheet, `[D, 3]`."""
        return self._on(sheet.formed.resampled_to(self.grid)[0].reshape(-1, 3)) + self.off

    def linear(self, at: np.ndarray) -> _Linear:
        """Linearise the sheet about a height and prestretch."""
        here, *others = (self.sheet_with(*(at * factor)) for factor in ((1.0, 1.0), (1 + STEP, 1.0), (1.0, 1 + STEP)))
        points, p = self.positions(here), float(np.log(here.formed.pressure))
        slopes = [(self.positions(other) - points) / (STEP * value) for other, value in zip(others, at, strict=True)]
        rises = [(np.log(other.formed.pressure) - p) / (STEP * value) for other, value in zip(others, at, strict=True)]
        return _Linear(at, points, np.stack(slopes, -1), p, np.array(rises))


def rest_of_sheet(sensor: Sensor, image: np.ndarray, overpressure: float | None, progress: Progress) -> RestFit:
    """Fit pose, height and prestretch of an inflated surface to a rest image; `rest_from_image` calls this function.

    The dots are material points of the sheet. The file's prestretch is a prior with standard deviation `STRETCH_ERROR`. The
    gauge reading at rest is a further datum if the modulus is known; otherwise the modulus follows from it.

    Args:
        sensor: the design, whose surface is an `InflatedSurface`, with a list of dots.
        image: grey image of the membrane at rest, `[H, W]`, in 0..1.
        overpressure: gauge reading at rest, hPa.
        progress: called with the completed share.

    Returns:
        The `RestFit` of pose, height and prestretch; the rim of its sensor is given as points in the camera's frame.

    Raises:
        MembraneError: as for `rest_from_image`; or no equilibrium exists at a height and prestretch.
    """
    sheet, X, sizes = sensor.surface, sensor.markers.positions, sensor.markers.sizes
    assert isinstance(sheet, InflatedSurface) and X is not None  # checked by `rest_from_image`
    image = check_image("calibrate rest: the image", image, sensor.camera.image_size)
    progress(0.0, "dots of the image")
    fine = fine_surface(sensor)
    large = np.array([int(size == "large") for size in sizes or ()])
    outlines, pixels = measured_outlines(sensor, fine, X, large, image)
    dots, pivot, visible = _Material(sensor, sheet, X), torch.from_numpy(sheet.rim.mean(0)), np.isfinite(pixels).all(1)
    stated = np.array([sheet.formed.height, sensor.material.prestretch])
    theta, noise, used = np.concatenate([np.zeros(6), stated]), CENTRED, visible.copy()
    for k in range(ROUNDS):
        progress(0.3 + 0.2 * k, "pose, height and prestretch")
        linear = dots.linear(theta[6:])
        seen = _Seen(sensor, torch.from_numpy(outlines - X[:, None] + linear.points[:, None]), pixels, pivot, linear)
        known = _known(sensor, linear, stated, overpressure)
        result = seen.fit(theta, used, known, noise)
        if k == 0:
            used[used] = ~outliers(result.residuals[: 2 * used.sum()].reshape(-1, 2))
        theta, noise = result.values, float(np.sqrt((result.residuals[: 2 * used.sum()] ** 2).mean()))
    jacobian = seen.jacobian(theta, used)
    bias = np.concatenate([shading_bias(sensor.camera, pixels[used]).ravel(), np.zeros(len(result.residuals) - 2 * used.sum())])
    whole = np.concatenate([jacobian, noise * known[1]])
    result = with_common_errors(result, whole, bias[:, None])
    left = pixels - seen.modelled(torch.from_numpy(theta), np.ones(len(X), bool)).numpy()
    warn_of_press(sensor, pixels[visible], left[visible])
    progress(0.8, "dots on the rest surface")
    return _moved(sensor, dots, seen, result, left, visible, image, overpressure)


class _Seen:
    """Projection of the dots into the image as a function of the eight parameters."""

    def __init__(self, sensor: Sensor, outlines: Tensor, pixels: np.ndarray, pivot: Tensor, linear: _Linear) -> None:
        self.sensor, self.outlines, self.pixels, self.pivot, self.linear = sensor, outlines, pixels, pivot, linear

    def placed(self, theta: Tensor) -> Tensor:
        """Return the dots' outlines in the camera's frame, `[D, 8, 3]`."""
        moved = self.outlines + self.linear.moved(theta[6:] - torch.from_numpy(self.linear.at))[:, None]
        return (moved - self.pivot) @ rotations(theta[:3]).mT + self.pivot + theta[3:6]

    def modelled(self, theta: Tensor, used: np.ndarray) -> Tensor:
        """Return the modelled pixels of the used dots, `[used, 2]`."""
        return outline_centres(self.sensor.camera.point_to_pixel(self.placed(theta)[torch.from_numpy(used)]))

    def jacobian(self, theta: np.ndarray, used: np.ndarray) -> np.ndarray:
        """Return the Jacobian of `modelled`, `[2 used, 8]`."""
        found: np.ndarray = jacfwd(self.modelled)(torch.from_numpy(theta), used).flatten(0, 1).numpy()
        return found

    def fit(self, start: np.ndarray, used: np.ndarray, known: tuple[np.ndarray, np.ndarray], noise: float) -> Fit:
        """Fit the eight parameters; `known` are the values and rows of further linear data, in standard deviations."""

        def residuals(theta: np.ndarray) -> np.ndarray:
            seen = self.modelled(torch.from_numpy(theta), used).numpy() - self.pixels[used]
            return np.concatenate([seen.ravel(), noise * (known[1] @ theta - known[0])])

        return fit(
            residuals, lambda theta: np.concatenate([self.jacobian(theta, used), noise * known[1]]), start, "calibrate rest"
        )


def _known(sensor: Sensor, linear: _Linear, stated: np.ndarray, overpressure: float | None) -> tuple[np.ndarray, np.ndarray]:
    """Return values and rows for `theta [8]` of the data on prestretch and pressure, in standard deviations."""
    rows, values = [np.eye(8)[7] / STRETCH_ERROR], [stated[1] / STRETCH_ERROR]
    surface = sensor.surface
    if overpressure is not None and sensor.force_unit == "N" and isinstance(surface, InflatedSurface):
        wanted = np.log(overpressure * hectopascal(sensor.length_unit) / sensor.material.modulus)
        row = np.concatenate([np.zeros(6), linear.pressure_slopes]) / HELD_ERROR
        rows.append(row)
        values.append((wanted - linear.pressure + linear.pressure_slopes @ linear.at) / HELD_ERROR)
    return np.array(values), np.array(rows)


def _refuse_other_pressure(held: float, overpressure: float) -> None:
    """Refuse a gauge reading that the fitted sheet does not hold; both in hPa."""
    if not 1 / LARGEST_RATIO < overpressure / held < LARGEST_RATIO:
        raise MembraneError(
            f"calibrate rest: the gauge reads {overpressure:g} hPa, but the sheet that fits the image holds {held:.4g} hPa "
            "with the file's shear modulus and thickness; expected the same to a few per cent: give inside minus outside, or "
            "correct modulus or prestretch in the file"
        )


def _moved(
    sensor: Sensor,
    dots: _Material,
    seen: _Seen,
    result: Fit,
    left: np.ndarray,
    visible: np.ndarray,
    image: np.ndarray,
    overpressure: float | None,
) -> RestFit:
    """Return the fit with the fitted sensor, whose dots are moved along the surface to their measured pixels."""
    theta = torch.from_numpy(result.values)
    rotation, pivot, offset = rotations(theta[:3]).numpy(), seen.pivot.numpy(), result.values[3:6]
    flat = dots.sheet_with(*result.values[6:])
    rim = (flat.rim - pivot) @ rotation.T + pivot + offset
    values = {"outline": rim, "height": float(result.values[6])}
    material = flat.material
    if overpressure is not None and sensor.force_unit == "N":
        _refuse_other_pressure(flat.formed.pressure * material.modulus / hectopascal(sensor.length_unit), overpressure)
    if overpressure is not None and sensor.force_unit == "relative":
        product = overpressure * hectopascal(sensor.length_unit) / flat.formed.pressure
        thickness = material.thickness or 1.0
        material = replace(material, shear_modulus=product / thickness, thickness=thickness)
    surface = InflatedSurface(flat.shape, values, material, flat.length_unit)
    X = (dots.positions(flat) - pivot) @ rotation.T + pivot + offset
    membrane = surface.membrane(sensor.membrane.grid)
    fitted = replace(sensor, membrane=membrane, material=material, surface=surface, markers=Markers("dots", positions=X))
    _, tangents = frames_at(fine_surface(fitted), X)
    shifts = nulling(sensor, seen.placed(theta).numpy(), tangents, seen.pixels, visible)
    markers = Markers("dots", sensor.markers.polarity, X + shifts, sensor.markers.sizes, image)
    moved = replace(fitted, markers=markers)
    return RestFit(moved, SHEET_NAMES, result.in_degrees(1), seen.pixels, left, shifts)
