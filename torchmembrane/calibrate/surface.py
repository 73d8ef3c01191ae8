"""The rest surface as calibration moves it: dots' outlines on it, a new pose, a correction along its normals."""

from dataclasses import replace
from typing import NamedTuple

import numpy as np
import torch
from scipy.interpolate import RBFInterpolator

from ..camera.model import Camera
from ..camera.targets import OUTLINE
from ..errors import MembraneError
from ..sensor.parts import Markers, Surface
from ..sensor.sensor import Sensor
from ..surface.membrane import Membrane
from ..surface.tangent import tangent_axes

FINE = 65  # vertices per side of the surface that is calibrated


class SurfaceProjection(NamedTuple):
    """Points projected onto a surface.

    Attributes:
        points: `[N, 3]` the closest points of the surface, length unit.
        normals: `[N, 3]` its outward unit normals there.
        signed_distance: `[N]` from there to the points that were projected, along the normals: positive outside.
    """

    points: np.ndarray
    normals: np.ndarray
    signed_distance: np.ndarray


class Correction(NamedTuple):
    """A surface moved.

    Attributes:
        vertices: `[V, 3]` where it is now.
        offsets: `[V]` by how much it was moved along its outward normals, length unit.
        deviations: `[V]` standard deviations of the offsets.
    """

    vertices: np.ndarray
    offsets: np.ndarray
    deviations: np.ndarray


def fine_surface(sensor: Sensor) -> Membrane:
    """The sensor's rest surface on a grid fine enough to place dots on."""
    return sensor.surface.membrane(tuple(max(FINE, side) for side in sensor.membrane.grid))


def recalibrated(
    sensor: Sensor,
    surface: Membrane,
    vertices: np.ndarray,
    positions: np.ndarray | None,
    sizes: list[str] | None,
    image: np.ndarray,
) -> Sensor:
    """The sensor with its rest surface at `vertices [V, 3]` (on the grid of `surface`), dots `[D, 3]` and rest image."""
    m, n = surface.grid
    shape = Surface("grid", {"vertices": vertices.reshape(m, n, 3), "fixed": surface.fixed.numpy().reshape(m, n)})
    markers = Markers("dots", sensor.markers.polarity, positions, sizes, image)
    return replace(sensor, membrane=shape.membrane(sensor.membrane.grid), surface=shape, markers=markers)


def frames_at(surface: Membrane, positions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Outward normals `[D, 3]` and two tangents `[D, 3, 2]` of the surface next to `positions [D, 3]`."""
    normals = surface_projection(surface, positions).normals
    return normals, tangent_axes(normals).swapaxes(1, 2)


def dot_outlines(surface: Membrane, positions: np.ndarray, radii: np.ndarray) -> np.ndarray:
    """Points around each dot on the curved surface, `[D, 8, 3]`: circles `radii [D]` in the tangent plane, dropped on it."""
    normals, tangents = frames_at(surface, positions)
    angle = 2 * np.pi * np.arange(OUTLINE) / OUTLINE
    circle = np.stack([np.cos(angle), np.sin(angle)])
    flat = positions[:, None] + radii[:, None, None] * (tangents @ circle).swapaxes(1, 2)
    at_circle, at_centre = (surface_projection(surface, points.reshape(-1, 3)).signed_distance for points in (flat, positions))
    sag = at_circle.reshape(flat.shape[:2]) - at_centre[:, None]
    return flat - sag[..., None] * normals[:, None]


def unit_shapes(camera: Camera, outlines: np.ndarray, radii: np.ndarray) -> np.ndarray:
    """How dots of radius 1 are imaged, `[D, 2, 2]` px per length unit, from their `outlines [D, 8, 3]` of `radii [D]`."""
    p = camera.point_to_pixel(torch.from_numpy(outlines)).numpy()
    quarter = OUTLINE // 4
    columns = [(p[:, k] - p[:, k + OUTLINE // 2]) / (2 * radii[:, None]) for k in (0, quarter)]
    return np.stack(columns, -1)


def correction(surface: Membrane, projection: SurfaceProjection, variances: np.ndarray) -> Correction:
    """The smooth displacement that brings the surface onto N points.

    Thin-plate splines (scipy) of the signed distances as vectors, linear where there are no points.

    Args:
        surface: the surface to move.
        projection: the points, projected onto it.
        variances: `[N]` of their signed distances.

    Raises:
        MembraneError: fewer than 12 points.

    Limitations:
        What moves the surface within itself is not observed. Where the rim is far outside the points, it is extrapolated.
    """
    if len(projection.points) < 12:
        raise MembraneError(f"calibrate: {len(projection.points)} points of the rest surface were given; expected at least 12")
    unit = np.eye(len(projection.points))
    weights = RBFInterpolator(projection.points, unit, kernel="thin_plate_spline", degree=1)(surface.rest.numpy())
    shift = weights @ (projection.signed_distance[:, None] * projection.normals)
    offsets = (shift * surface.rest_normals.numpy()).sum(1)
    return Correction(surface.rest.numpy() + shift, offsets, np.sqrt(weights**2 @ variances))


def surface_projection(surface: Membrane, points: np.ndarray) -> SurfaceProjection:
    """The projection of `points [N, 3]` onto the surface."""
    near = surface.closest_points(points)
    closest, normals = (
        (values.numpy()[near.vertices] * near.weights[..., None]).sum(1) for values in (surface.rest, surface.rest_normals)
    )
    normals = normals / np.linalg.norm(normals, axis=1, keepdims=True)
    return SurfaceProjection(closest, normals, ((points - closest) * normals).sum(1))
