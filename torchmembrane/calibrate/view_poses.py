"""Poses of a sensor's further views from rest images of the same dots; the listed surface sets the scale."""

from collections.abc import Sequence
from dataclasses import replace
from itertools import product
from typing import NamedTuple

import numpy as np
import torch
from scipy.spatial import cKDTree
from torch import Tensor
from torch.func import jacfwd

from ..errors import MembraneError
from ..files.grayscale import check_image
from ..markers.dots.pattern import DotPattern, find_dots
from ..markers.placement import FEWEST_MARKERS, markers_in_view
from ..pose import ViewPose
from ..progress import Progress, silent, within
from ..sensor.sensor import Sensor
from ..torch_modes import on_cpu
from .fit import fit, rotations
from .rest import RestFit, rest_from_image
from .surface import fine_surface

NEAR = 0.35
"""Largest distance between a found dot and the expected position of a listed one for a match, over the dots' pitch."""
FEWEST_MATCHED = 0.6
"""Smallest share of a view's dots that must be found at their expected positions; fewer may be a coincidence."""
ROUNDS = 8
STEPS = (-1.0, -0.5, 0.0, 0.5, 1.0)
"""Shifts of the first guess along u and v that are tried, over the pitch."""
TURNS = (-16.0, -8.0, 0.0, 8.0, 16.0)
"""Rotations of the first guess in the image that are tried, degrees."""
KEPT = 6
"""Number of best first guesses from which a pose is fitted."""


class RigFit(NamedTuple):
    """A sensor with several views, calibrated from rest images of all views.

    Attributes:
        sensor: the sensor with the fitted surface, dots and poses, and the views' rest images.
        first: fit of the first view alone: pose of the surface and the dots on it.
        further: fit of each further view: rotation and shift of the surface in the view's frame, relative to the file's pose.
    """

    sensor: Sensor
    first: RestFit
    further: list[RestFit]


@on_cpu
def rest_from_view_images(
    sensor: Sensor, images: Sequence[np.ndarray], overpressure: float | None = None, *, progress: Progress = silent
) -> RigFit:
    """Find the pose of the rest surface and its dots in the first view's rest image, then the poses of the other views.

    The pose of each other view is fitted to the dots found in its own image; the file's pose is a first guess, which may be
    wrong by tens of degrees.

    Args:
        sensor: the design, with several views and a list of dots.
        images: grey image of the membrane at rest for each view, `[H, W]`, in 0..1.
        overpressure: gauge reading at rest, hPa, as for `rest_from_image`.
        progress: called with the completed share.

    Raises:
        MembraneError: as for `rest_from_image`, with the name of the view; or the dots are not recognised in an image.

    Limitations:
        Images do not show the scale; it is that of the listed surface: if the outline is 1 % too large, so are all distances.

    Example:
        >>> from torchmembrane import Camera
        >>> from torchmembrane.sensor.views import View
        >>> sensor = Sensor.from_file("examples/sensor.toml")
        >>> image = sensor.markers.rest_image[::2, ::2]  # every other pixel, and a camera that sees them
        >>> camera = Camera("fisheye", (320, 240), (80.0, 80.0), (161.05, 121.45))
        >>> guess = ViewPose(np.array([0.0, 3.0, 0.0]), np.array([1.0, 0.0, 0.0]))
        >>> views = View("one", camera), View("two", camera, guess)  # which stand at one place in truth
        >>> pair = replace(sensor, camera=camera, markers=replace(sensor.markers, rest_image=image), views=views)
        >>> found = rest_from_view_images(pair, [image, image])
        >>> bool(np.abs(found.sensor.views[1].pose.matrix - np.eye(4)).max() < 0.05)
        True
    """
    count = len(sensor.views)
    if count < 2 or len(images) != count:
        raise MembraneError(
            f"calibrate rest: {len(images)} images for {count} views; expected at least two views and one image for each"
        )
    first = rest_from_image(sensor.in_view(0), images[0], overpressure, progress=within(progress, 0.0, 1 / count))
    views, further = list(sensor.views), []
    whole = replace(first.sensor, views=(replace(views[0], rest_image=images[0]), *views[1:]))
    for number in range(1, count):
        told = within(progress, number / count, (number + 1) / count)
        whole, found = placed_view(whole, number, images[number], progress=told)
        further.append(found)
    return RigFit(whole, first, further)


def placed_view(sensor: Sensor, number: int, image: np.ndarray, *, progress: Progress = silent) -> tuple[Sensor, RestFit]:
    """Fit the pose of one of a sensor's further views to the listed dots in its rest image.

    Args:
        sensor: the sensor with several views and known dots.
        number: number of the view, from 1.
        image: rest image of this view, grey, `[H, W]`, in 0..1.
        progress: called with the completed share.

    Returns:
        The sensor, with pose and rest image of this view, and the fit.

    Raises:
        MembraneError: the dots are not recognised; the message names the view.
    """
    view = sensor.views[number]
    try:
        grey = check_image("calibrate rest: the image", image, view.camera.image_size)
        pattern = find_dots(grey, sensor.markers.polarity)
        roughly = _moved(sensor, number, *recognised(sensor.in_view(number), pattern))
        seen = roughly.in_view(number)
        shown = markers_in_view(seen)
        sizes = None if seen.markers.sizes is None else [seen.markers.sizes[d] for d in np.nonzero(shown)[0]]
        part = replace(seen.markers, positions=np.asarray(seen.markers.positions)[shown], sizes=sizes)
        found = rest_from_image(replace(seen, markers=part), grey, progress=progress)
    except MembraneError as error:
        raise MembraneError(f"view {view.name!r}: {error}") from error
    surface = fine_surface(seen)
    motion = np.concatenate([np.deg2rad(found.fit.values[:3]), found.fit.values[3:6]])
    placed = _moved(roughly, number, motion, surface.rest[surface.fixed].mean(0).numpy())
    views = list(placed.views)
    views[number] = replace(views[number], rest_image=grey.astype(np.float32))
    return replace(placed, views=tuple(views)), found


def with_found(sensor: Sensor, found: Sensor) -> Sensor:
    """Transfer a calibration of the first view alone to a sensor with several views.

    If the rest surface has changed, the poses of the further views are fitted again to their rest images.

    Args:
        sensor: the sensor, with one or several views.
        found: the sensor of its first view, with another material, surface or dots.
    """
    if not sensor.views:
        return found
    whole = replace(found, tool=sensor.tool, views=sensor.views)
    same = torch.equal(found.membrane.rest, sensor.membrane.rest)
    for number, view in enumerate(() if same else sensor.views):
        if number and view.rest_image is not None:
            whole, _ = placed_view(whole, number, view.rest_image)
    return whole


def recognised(sensor: Sensor, pattern: DotPattern) -> tuple[np.ndarray, np.ndarray]:
    """Find an initial motion of the surface that brings a view's dots to where they were found.

    The expected dots are laid over the found ones, with equal centre and extent, also shifted by some pitches and rotated.
    Mutual nearest neighbours are matched, which gives an affine map, then a pose, and thus better predictions. The start with
    most matches is used.

    Args:
        sensor: the sensor of this view alone, from `Sensor.in_view`.
        pattern: dots found in the view's image.

    Returns:
        Rotation vector (rad) and shift `[6]`, and the pivot of the rotation `[3]`.

    Raises:
        MembraneError: fewer than `FEWEST_MATCHED` of the dots that the view would see then are found.

    Limitations:
        A regular pattern of equal dots that is not completely visible may be matched with an offset of one pitch.
    """
    shown = markers_in_view(sensor)
    if shown.sum() < FEWEST_MARKERS:
        raise MembraneError(
            f"{shown.sum()} dots would be visible from the pose in the file; expected at least {FEWEST_MARKERS}"
        )
    X, pivot = np.asarray(sensor.markers.positions)[shown], np.asarray(sensor.markers.positions)[shown].mean(0)
    sizes = np.array([int(size == "large") for size in sensor.markers.sizes or ()], dtype=int)[shown]
    starts = _overlays(_seen(sensor, X), pattern.pixels)
    tries = [_settled(sensor, X, sizes, pivot, pattern, start) for start in starts]
    matched, motion = max(tries, key=lambda each: each[0])
    if matched < FEWEST_MATCHED * len(X):
        raise MembraneError(
            f"{matched:.0f} of {len(X)} dots are recognised among {len(pattern.pixels)} found in its rest image; expected "
            "most: check the pose in the file, its lens, and that the image shows the membrane at rest"
        )
    return motion, pivot


def _overlays(expected: np.ndarray, found: np.ndarray) -> list[np.ndarray]:
    """Return affine maps of the expected pixels `[D, 2]` that match found pixels `[K, 2]`, those with most matches first."""
    middle, pitch, tree = np.median(expected, 0), _pitch(found), cKDTree(found)
    grown = _extent(found) / _extent(expected)
    rows, tries = np.column_stack([expected, np.ones(len(expected))]), []
    for *step, turn in product(STEPS, STEPS, TURNS):
        c, s = np.cos(np.deg2rad(turn)), np.sin(np.deg2rad(turn))
        over = np.median(found, 0) + pitch * np.array(step) + grown * (expected - middle) @ np.array([[c, s], [-s, c]])
        before = np.empty(0, int)
        for _ in range(ROUNDS):
            partner = _partners(over, found, tree)
            near = partner >= 0
            if near.sum() < FEWEST_MARKERS or np.array_equal(partner, before):
                break
            over, before = rows @ np.linalg.lstsq(rows[near], found[partner[near]], rcond=None)[0], partner
        tries.append((partner, over))
    best = sorted(tries, key=lambda each: -(each[0] >= 0).sum())[:KEPT]
    return list({partner.tobytes(): over for partner, over in best}.values())


def _partners(expected: np.ndarray, found: np.ndarray, tree: cKDTree) -> np.ndarray:
    """Return the index of each expected pixel's mutual nearest neighbour among the found ones, `[D]`; -1 if none is nearby."""
    away, nearest = tree.query(expected)
    back = np.asarray(cKDTree(expected).query(found[nearest])[1])
    return np.where((away < NEAR * _pitch(expected)) & (back == np.arange(len(expected))), nearest, -1)


def _settled(
    sensor: Sensor, X: np.ndarray, sizes: np.ndarray, pivot: np.ndarray, pattern: DotPattern, expected: np.ndarray
) -> tuple[float, np.ndarray]:
    """Fit a pose from a first guess of the dots' pixels; return the number of matches of equal size minus that of different
    size, and the pose."""
    tree, motion, score = cKDTree(pattern.pixels), np.zeros(6), 0.0
    both = len(np.unique(sizes)) == 2 == len(np.unique(pattern.sizes))
    before = np.empty(0, int)
    for _ in range(ROUNDS):
        partner = _partners(expected, pattern.pixels, tree)
        near = partner >= 0
        if near.sum() < FEWEST_MARKERS:
            return 0.0, motion
        if np.array_equal(partner, before):
            break
        motion, before = _pose(sensor, X[near], pivot, pattern.pixels[partner[near]], motion), partner
        expected = _seen(sensor, _turned(motion, X, pivot))
        alike = sizes[near] == pattern.sizes[partner[near]] if both else np.ones(near.sum(), bool)
        score = float(alike.sum() - (~alike).sum())
    return score, motion


def _pose(sensor: Sensor, X: np.ndarray, pivot: np.ndarray, pixels: np.ndarray, start: np.ndarray) -> np.ndarray:
    """Fit the motion `[6]` that brings points to their pixels."""
    points, centre, seen = torch.from_numpy(X), torch.from_numpy(pivot), torch.from_numpy(pixels)

    def residuals(theta: Tensor) -> Tensor:
        moved = (points - centre) @ rotations(theta[:3]).mT + centre + theta[3:]
        return (sensor.camera.point_to_pixel(moved) - seen).flatten()

    found = fit(
        lambda theta: residuals(torch.from_numpy(theta)).numpy(),
        lambda theta: jacfwd(residuals)(torch.from_numpy(theta)).numpy(),
        start,
        "calibrate rest",
    )
    return found.values


def _turned(motion: np.ndarray, points: np.ndarray, pivot: np.ndarray) -> np.ndarray:
    turned: np.ndarray = (points - pivot) @ rotations(torch.from_numpy(motion[:3])).numpy().T + pivot + motion[3:]
    return turned


def _moved(sensor: Sensor, number: int, motion: np.ndarray, pivot: np.ndarray) -> Sensor:
    """Return the sensor with a new pose of one view, equivalent to this motion of the surface in the view's frame."""
    views, R = list(sensor.views), rotations(torch.from_numpy(motion[:3])).numpy()
    motion_of_surface = ViewPose(R, pivot + motion[3:] - R @ pivot)
    pose = ViewPose.of_matrix(views[number].pose.matrix @ motion_of_surface.inverse.matrix)
    views[number] = replace(views[number], pose=pose)
    return replace(sensor, views=tuple(views))


def _seen(sensor: Sensor, points: np.ndarray) -> np.ndarray:
    pixels: np.ndarray = sensor.camera.point_to_pixel(torch.from_numpy(points)).numpy()
    return pixels


def _pitch(pixels: np.ndarray) -> float:
    """Return the median distance to the nearest neighbour."""
    return float(np.median(np.asarray(cKDTree(pixels).query(pixels, k=2)[0])[:, 1]))


def _extent(pixels: np.ndarray) -> float:
    """Return the median distance from the median."""
    return float(np.median(np.linalg.norm(pixels - np.median(pixels, 0), axis=1)))
