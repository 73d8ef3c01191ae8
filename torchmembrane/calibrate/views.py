"""Dots that nobody listed: their places in space from several views, and the rest surface through them."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from torch.func import jacfwd, vmap

from ..errors import MembraneError
from ..markers.dots import find_dots
from ..markers.place import rim_mask
from ..sensor.model import Sensor
from .fit import Fit, fit, outline_centres, rotations, strays, with_common_errors
from .rest import measured_outlines, shading_bias
from .surface import Correction, correction, feet_of, fine_surface, recalibrated

SIDEWAYS = 0.015  # px: a turned view is shaded to one side, and its located dots share a shift (0.024 px at 4 degrees)


class ViewsFit(NamedTuple):
    """The sensor with the surface and dots that several views show.

    names, fit: of the cameras' turns (degrees) and places, then of the dots (length unit, first camera's frame); dots
    `[D, 3]` and their standard deviations `[D, 3]`; surface: `Correction` of the design; residuals: `[P, D, 2]` px.
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
    hits_from = fine_surface(sensor)
    origin, direction = (ray.numpy() for ray in sensor.camera.pixel_to_ray(torch.from_numpy(pattern.pixels)))
    distance = hits_from.ray_points(origin, direction).distance
    met = np.isfinite(distance)
    if met.sum() < 12:
        raise MembraneError(f"calibrate: {met.sum()} dots found on the rest surface; expected at least 12")
    places = origin + distance[:, None] * direction
    return places[met], ["large" if size else "small" for size in pattern.sizes[met]]


def rest_from_views(sensor: Sensor, images: Sequence[np.ndarray], motions: np.ndarray, travel_error: float) -> ViewsFit:
    """Dots and rest surface from P views `[H, W]` by a camera that moved; the first view is the sensor's own.

    Arguments
        motions       `[P, 6]` where the camera was, roughly: its place (length unit) and turn (rotation vector, degrees) in
                      the first camera's frame, the first row zeros. Dots must be predicted to half their pitch
        travel_error  standard deviation of the second view's travel: images do not tell the scale, this length sets it

    Bundle adjustment: all dots, all poses but the first. Then the designed surface is moved along its normals onto the dots;
    what moves it within itself, and its rim outside the dots, is not seen. Wrong where fewer than two views differ.
    """
    if len(images) < 2 or motions.shape != (len(images), 6) or np.abs(motions[0]).max() > 0:
        raise MembraneError(
            f"calibrate views: {len(images)} images, motions {list(motions.shape)}; expected 2 or more, [P, 6], first zeros"
        )
    if not np.linalg.norm(motions[1, :3]) > 0:
        raise MembraneError("calibrate views: the second view did not travel; expected that its travel sets the scale")
    surface = fine_surface(sensor)
    X, sizes = placed_dots(sensor, images[0])
    large = np.array([size == "large" for size in sizes], dtype=int)
    turns, places = np.deg2rad(motions[:, 3:]), motions[:, :3]
    outlines, pixels = [], []
    for image, turn, place in zip(images, turns, places, strict=True):
        R = rotations(torch.from_numpy(turn)).numpy()
        into = lambda x, R=R, place=place: (x - place) @ R  # noqa: E731
        found = measured_outlines(sensor, surface, X, large, image, into)
        outlines.append(found[0])
        pixels.append(found[1])
    rel, pixels = np.median(outlines, 0) - X[:, None], np.stack(pixels)
    motions = np.concatenate([turns, places], 1)[1:]
    return _bundle(sensor, surface, X, sizes, rel, pixels, motions, travel_error, images[0])


def _bundle(sensor, surface, X, sizes, rel, pixels, motions, travel_error, image) -> ViewsFit:
    P, D, own, travel = len(pixels), len(X), motions.size, np.linalg.norm(motions[0, 3:])
    visible = np.isfinite(pixels).all(-1)
    visible &= visible.sum(0) >= 2

    def modelled(motion, dot, rel):
        return outline_centres(sensor.camera.point_to_pixel((dot + rel - motion[3:]) @ rotations(motion[:3])))

    each = vmap(vmap(modelled, (None, 0, 0)), (0, None, None))
    slopes = vmap(vmap(jacfwd(modelled, (0, 1)), (None, 0, 0)), (0, None, None))

    def parts(theta):
        moved = torch.from_numpy(theta[:own]).view(-1, 6)
        return torch.cat([moved.new_zeros(1, 6), moved]), torch.from_numpy(theta[own:]).view(-1, 3), torch.from_numpy(rel)

    def residuals(theta):
        left = each(*parts(theta)).numpy() - pixels
        place = theta[3:6]
        return np.append(left[visible].ravel(), pull * (np.linalg.norm(place) - travel))

    def jacobian(theta):
        by_motion, by_dot = (a.numpy() for a in slopes(*parts(theta)))
        J = np.zeros((P, D, 2, own + 3 * D))
        for p in range(1, P):
            J[p, ..., 6 * (p - 1) : 6 * p] = by_motion[p]
        for d in range(D):
            J[:, d, :, own + 3 * d : own + 3 * d + 3] = by_dot[:, d]
        row = np.zeros((1, own + 3 * D))
        place = theta[3:6]
        row[0, 3:6] = pull * place / np.linalg.norm(place)
        return np.concatenate([J[visible].reshape(-1, own + 3 * D), row])

    kept = visible.any(0)
    X, rel, sizes = X[kept], rel[kept], [size for size, keep in zip(sizes, kept, strict=True) if keep]
    pixels, visible, D = pixels[:, kept], visible[:, kept], int(kept.sum())
    theta, pull = np.concatenate([motions.ravel(), X.ravel()]), 0.05 / travel_error
    found = fit(residuals, jacobian, theta, "calibrate views")
    wild = strays(found.residuals[:-1].reshape(-1, 2))
    visible[np.nonzero(visible)] = ~wild
    pull = found.noise / travel_error
    found = fit(residuals, jacobian, found.values, "calibrate views")
    sideways = np.broadcast_to(SIDEWAYS * np.eye(2)[:, None], (2, visible.sum(), 2))
    biases = np.concatenate([shading_bias(sensor, pixels[visible])[None], sideways])  # [3, N, 2], of every view for itself
    of_view = np.nonzero(visible)[0][:, None] == np.arange(P)
    errors = np.einsum("knc,np->nckp", biases, of_view).reshape(-1, 3 * P)
    found = with_common_errors(found, jacobian(found.values), np.pad(errors, ((0, 1), (0, 0))))
    dots, left = (
        found.values[own:].reshape(-1, 3),
        np.where(visible[..., None], pixels - each(*parts(found.values)).numpy(), np.nan),
    )
    feet = feet_of(surface, dots)
    blocks = np.stack([found.covariance[own + 3 * d : own + 3 * d + 3, own + 3 * d : own + 3 * d + 3] for d in range(D)])
    change = correction(surface, feet, np.einsum("di,dij,dj->d", feet.normals, blocks, feet.normals))
    moved = recalibrated(sensor, surface, change.vertices, dots, sizes, image)
    names = [f"{name}[{p}]" for p in range(1, P) for name in ("turn_x", "turn_y", "turn_z", "place_x", "place_y", "place_z")]
    scale = np.array(([180 / np.pi] * 3 + [1.0] * 3) * (P - 1) + [1.0] * (3 * D))
    found = found._replace(values=scale * found.values, covariance=scale[:, None] * found.covariance * scale)
    return ViewsFit(moved, names, found, dots, found.deviations[own:].reshape(-1, 3), change, left)
