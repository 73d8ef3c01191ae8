"""The rest surface as calibration moves it: dots' outlines on it, a new pose, a correction along its normals."""

from dataclasses import replace
from typing import NamedTuple

import numpy as np
import torch
from scipy.interpolate import RBFInterpolator

from ..boards import OUTLINE
from ..errors import MembraneError
from ..membrane import Membrane
from ..sensor import Markers, Sensor, Surface

FINE = 65  # vertices a side of the surface that is calibrated


class Correction(NamedTuple):
    """Offsets of a surface along its outward normals: `offsets [V]` and their standard deviations `[V]`, length unit."""

    offsets: np.ndarray
    deviations: np.ndarray


def fine_surface(sensor: Sensor) -> Membrane:
    """The sensor's rest surface on a grid fine enough to place dots on."""
    return sensor.surface.membrane(tuple(max(FINE, side) for side in sensor.membrane.grid))


def recalibrated(sensor: Sensor, surface: Membrane, vertices: np.ndarray, positions, sizes, image) -> Sensor:
    """The sensor with its rest surface at `vertices [V, 3]` (on the grid of `surface`), dots `[D, 3]` and rest image."""
    m, n = surface.grid
    shape = Surface("grid", {"vertices": vertices.reshape(m, n, 3), "fixed": surface.fixed.numpy().reshape(m, n)})
    markers = Markers("dots", sensor.markers.polarity, positions, sizes, image)
    return replace(sensor, membrane=shape.membrane(sensor.membrane.grid), surface=shape, markers=markers)


def frames_at(surface: Membrane, positions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Outward normals `[D, 3]` and two tangents `[D, 3, 2]` of the surface next to `positions [D, 3]`."""
    points = surface.closest_points(positions)
    normals = (surface.rest_normals.numpy()[points.vertices] * points.weights[..., None]).sum(1)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    first = np.cross(normals, np.eye(3)[np.abs(normals).argmin(1)])
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    return normals, np.stack([first, np.cross(normals, first)], -1)


def dot_outlines(surface: Membrane, positions: np.ndarray, radii: np.ndarray) -> np.ndarray:
    """Points around each dot on the curved surface, `[D, 8, 3]`: circles `radii [D]` in the tangent plane, dropped on it."""
    normals, tangents = frames_at(surface, positions)
    angle = 2 * np.pi * np.arange(OUTLINE) / OUTLINE
    circle = np.stack([np.cos(angle), np.sin(angle)])
    flat = positions[:, None] + radii[:, None, None] * (tangents @ circle).swapaxes(1, 2)
    heights = [feet_and_heights(surface, points.reshape(-1, 3))[1] for points in (flat, positions)]
    sag = heights[0].reshape(flat.shape[:2]) - heights[1][:, None]
    return flat - sag[..., None] * normals[:, None]


def unit_shapes(camera, outlines: np.ndarray, radii: np.ndarray) -> np.ndarray:
    """How dots of radius 1 are imaged, `[D, 2, 2]` px per length unit, from their `outlines [D, 8, 3]` of `radii [D]`."""
    p = camera.point_to_pixel(torch.from_numpy(outlines)).numpy()
    quarter = OUTLINE // 4
    columns = [(p[:, k] - p[:, k + OUTLINE // 2]) / (2 * radii[:, None]) for k in (0, quarter)]
    return np.stack(columns, -1)


def correction(surface: Membrane, feet: np.ndarray, heights: np.ndarray, variances: np.ndarray) -> Correction:
    """The smooth normal offset of the surface that has `heights [N]`, of `variances [N]`, at its points `feet [N, 3]`.

    Thin-plate spline (scipy), linear where there are no points; what moves the surface within itself is not seen. Wrong where
    the rim is far outside the points.
    """
    if len(feet) < 12:
        raise MembraneError(f"calibrate: {len(feet)} points of the rest surface; expected at least 12")
    weights = RBFInterpolator(feet, np.eye(len(feet)), kernel="thin_plate_spline", degree=1)(surface.rest.numpy())
    return Correction(weights @ heights, np.sqrt(weights**2 @ variances))


def feet_and_heights(surface: Membrane, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The closest points of the surface `[N, 3]`, and how far `points [N, 3]` are outside it (negative: inside) `[N]`."""
    near = surface.closest_points(points)
    feet, normals = (
        (values.numpy()[near.vertices] * near.weights[..., None]).sum(1) for values in (surface.rest, surface.rest_normals)
    )
    return feet, ((points - feet) * normals).sum(1) / np.linalg.norm(normals, axis=1)
