"""Operations on the rest surface in calibration: outlines of dots, the recalibrated sensor, a correction along normals."""

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
    """Projections of N points onto a surface.

    Attributes:
        points: the closest points of the surface, `[N, 3]`, length unit.
        normals: outward unit normals of the surface there, `[N, 3]`.
        signed_distance: distance of the projected points along the normals, `[N]`, positive outside.
    """

    points: np.ndarray
    normals: np.ndarray
    signed_distance: np.ndarray


class Correction(NamedTuple):
    """A corrected surface.

    Attributes:
        vertices: corrected vertices, `[V, 3]`.
        offsets: displacements of the vertices along the outward normals, `[V]`, length unit.
        deviations: standard deviations of the offsets, `[V]`.
    """

    vertices: np.ndarray
    offsets: np.ndarray
    deviations: np.ndarray


def fine_surface(sensor: Sensor) -> Membrane:
    """Return the sensor's rest surface on a grid that is fine enough for placing dots."""
    return sensor.surface.membrane(tuple(max(FINE, side) for side in sensor.membrane.grid))


def recalibrated(
    sensor: Sensor,
    surface: Membrane,
    vertices: np.ndarray,
    positions: np.ndarray | None,
    sizes: list[str] | None,
    image: np.ndarray,
) -> Sensor:
    """Return the sensor with the rest surface `vertices [V, 3]` (on the grid of `surface`), dots `[D, 3]` and rest image."""
    m, n = surface.grid
    shape = Surface("grid", {"vertices": vertices.reshape(m, n, 3), "fixed": surface.fixed.numpy().reshape(m, n)})
    markers = Markers("dots", sensor.markers.polarity, positions, sizes, image)
    return replace(sensor, membrane=shape.membrane(sensor.membrane.grid), surface=shape, markers=markers)


def frames_at(surface: Membrane, positions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return outward normals `[D, 3]` and two tangents `[D, 3, 2]` of the surface at the points closest to `positions`."""
    normals = surface_projection(surface, positions).normals
    return normals, tangent_axes(normals).swapaxes(1, 2)


def dot_outlines(surface: Membrane, positions: np.ndarray, radii: np.ndarray) -> np.ndarray:
    """Return outlines of dots on the curved surface, `[D, 8, 3]`: circles of `radii [D]` in the tangent plane, projected."""
    normals, tangents = frames_at(surface, positions)
    angle = 2 * np.pi * np.arange(OUTLINE) / OUTLINE
    circle = np.stack([np.cos(angle), np.sin(angle)])
    flat = positions[:, None] + radii[:, None, None] * (tangents @ circle).swapaxes(1, 2)
    at_circle, at_centre = (surface_projection(surface, points.reshape(-1, 3)).signed_distance for points in (flat, positions))
    sag = at_circle.reshape(flat.shape[:2]) - at_centre[:, None]
    return flat - sag[..., None] * normals[:, None]


def unit_shapes(camera: Camera, outlines: np.ndarray, radii: np.ndarray) -> np.ndarray:
    """Return the linear maps of unit dots to the image, `[D, 2, 2]`, px per length unit, from `outlines [D, 8, 3]`."""
    p = camera.point_to_pixel(torch.from_numpy(outlines)).numpy()
    quarter = OUTLINE // 4
    columns = [(p[:, k] - p[:, k + OUTLINE // 2]) / (2 * radii[:, None]) for k in (0, quarter)]
    return np.stack(columns, -1)


def correction(surface: Membrane, projection: SurfaceProjection, variances: np.ndarray) -> Correction:
    """Move a surface smoothly onto N points.

    The signed distances, as vectors along the normals, are interpolated with thin-plate splines (scipy), which are
    extrapolated where there are no points.

    Args:
        surface: the surface to move.
        projection: projections of the points onto the surface.
        variances: variances of their signed distances, `[N]`.

    Raises:
        MembraneError: there are fewer than 12 points.

    Limitations:
        Tangential displacements are not observed. A rim far outside the points is extrapolated.
    """
    if len(projection.points) < 12:
        raise MembraneError(f"calibrate: {len(projection.points)} points of the rest surface were given; expected at least 12")
    unit = np.eye(len(projection.points))
    weights = RBFInterpolator(projection.points, unit, kernel="thin_plate_spline", degree=1)(surface.rest.numpy())
    shift = weights @ (projection.signed_distance[:, None] * projection.normals)
    offsets = (shift * surface.rest_normals.numpy()).sum(1)
    return Correction(surface.rest.numpy() + shift, offsets, np.sqrt(weights**2 @ variances))


def surface_projection(surface: Membrane, points: np.ndarray) -> SurfaceProjection:
    """Project `points [N, 3]` onto a surface."""
    near = surface.closest_points(points)
    closest, normals = (
        (values.numpy()[near.vertices] * near.weights[..., None]).sum(1) for values in (surface.rest, surface.rest_normals)
    )
    normals = normals / np.linalg.norm(normals, axis=1, keepdims=True)
    return SurfaceProjection(closest, normals, ((points - closest) * normals).sum(1))
