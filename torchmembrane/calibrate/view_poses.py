"""Poses of a sensor's further views from rest images of the same dots, the scale from the listed surface."""

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
from .fit import fit, rotations
from .rest import RestFit, rest_from_image
from .surface import fine_surface

NEAR = 0.35
"""Of the dots' pitch: a found dot so near to where a listed one is expected may be that one."""
FEWEST_MATCHED = 0.6
"""Of the dots that a view sees: fewer that are found where they are expected are a coincidence."""
ROUNDS = 8
STEPS = (-1.0, -0.5, 0.0, 0.5, 1.0)
"""Pitches along u and v by which a first guess may be off."""
TURNS = (-16.0, -8.0, 0.0, 8.0, 16.0)
"""Degrees, likewise."""
KEPT = 6
"""First guesses of which a pose is found."""


class RigFit(NamedTuple):
    """A sensor with several views, its surface, dots and poses where their rest images show them.

    Attributes:
        sensor: with pose and dots found, and the views' poses and rest images.
        first: the fit of the first view alone: the surface's pose before it, and the dots on it.
        further: of each further view its fit: what turned and shifted the surface in its frame, from the pose of the file.
    """

    sensor: Sensor
    first: RestFit
    further: list[RestFit]


def rest_from_view_images(
    sensor: Sensor, images: Sequence[np.ndarray], overpressure: float | None = None, *, progress: Progress = silent
) -> RigFit:
    """Pose of the rest surface and its dots from the first view's rest image, then the poses of the other views.

    Each of these is the pose from which its camera sees the dots, as they were found, where its own image shows them; that of
    the file is a first guess, within tens of degrees.

    Args:
        sensor: the design, with several views and a list of dots.
        images: of each view, `[H, W]` the membrane at rest, grey in 0..1.
        overpressure: as of `rest_from_image`.
        progress: is told how far it is.

    Raises:
        MembraneError: as of `rest_from_image`, which then names the view; dots that are not recognised in an image.

    Limitations:
        The scale is that of the listed surface, which no image shows: an outline that is 1 % too large makes all distances so.

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
        raise MembraneError(f"calibrate rest: {len(images)} images of {count} views; expected one of each of two views or more")
    first = rest_from_image(sensor.in_view(0), images[0], overpressure, progress=within(progress, 0.0, 1 / count))
    views, further = list(sensor.views), []
    whole = replace(first.sensor, views=(replace(views[0], rest_image=images[0]), *views[1:]))
    for number in range(1, count):
        told = within(progress, number / count, (number + 1) / count)
        whole, found = placed_view(whole, number, images[number], progress=told)
        further.append(found)
    return RigFit(whole, first, further)


def placed_view(sensor: Sensor, number: int, image: np.ndarray, *, progress: Progress = silent) -> tuple[Sensor, RestFit]:
    """The sensor with one of its further views where a rest image shows the listed dots.

    Args:
        sensor: with several views, its dots where they are.
        number: of the view, from 1.
        image: `[H, W]` of this view, grey in 0..1.
        progress: is told how far it is.

    Returns:
        The sensor, its view with pose and rest image, and the fit.

    Raises:
        MembraneError: the dots are not recognised, with the view's name.
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
    """A sensor of several views with what was found of the first one alone.

    Where the rest surface is another one now, the further views are placed again by their rest images.

    Args:
        sensor: with several views, or one.
        found: its first view's, with another material, surface or dots.
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
    """A first motion of the surface after which a view has its dots where they were found.

    The dots as expected are brought over those found, centre on centre and of the same extent, or some pitches and turns beside
    that; the nearest ones are taken for each other, which gives an affine map, then a pose, and so better expectations. The
    start after which most are found counts.

    Args:
        sensor: of the view alone, as `Sensor.in_view` gives it.
        pattern: dots found in its image.

    Returns:
        Rotation vector (rad) and shift `[6]`, and the pivot `[3]` of the rotation.

    Raises:
        MembraneError: fewer than `FEWEST_MATCHED` of the dots that the view would see then are found.

    Limitations:
        A regular pattern of one size of dot, of which the image does not show a whole row, may be taken a pitch off.
    """
    shown = markers_in_view(sensor)
    if shown.sum() < FEWEST_MARKERS:
        raise MembraneError(f"{shown.sum()} dots would be seen from the pose in the file; expected at least {FEWEST_MARKERS}")
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
    """Where dots `[D, 2]` may be among those found `[K, 2]`: affine maps of the expected pixels, those that meet most first."""
    middle, pitch, tree = np.median(expected, 0), _pitch(found), cKDTree(found)
    grown = _extent(found) / _extent(expected)
    rows, tries = np.column_stack([expected, np.ones(len(expected))]), []
    for *step, turn in product(STEPS, STEPS, TURNS):
        c, s = np.cos(np.deg2rad(turn)), np.sin(np.deg2rad(turn))
        over = np.median(found, 0) + pitch * np.array(step) + grown * (expected - middle) @ np.array([[c, s], [-s, c]])
        before = np.zeros(0)
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
    """Which found pixel each of the expected ones has near, of which it is the nearest: `[D]`, -1 without one."""
    away, nearest = tree.query(expected)
    back = np.asarray(cKDTree(expected).query(found[nearest])[1])
    return np.where((away < NEAR * _pitch(expected)) & (back == np.arange(len(expected))), nearest, -1)


def _settled(
    sensor: Sensor, X: np.ndarray, sizes: np.ndarray, pivot: np.ndarray, pattern: DotPattern, expected: np.ndarray
) -> tuple[float, np.ndarray]:
    """How many dots are found where a pose has them, those of the wrong size against it, and the pose; from a first guess of
    where they are in the image."""
    tree, motion, score = cKDTree(pattern.pixels), np.zeros(6), 0.0
    both = len(np.unique(sizes)) == 2 == len(np.unique(pattern.sizes))
    before = np.zeros(0)
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
    """The motion `[6]` that brings points to where they are seen."""
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
    """The sensor with a view whose camera sees the surface as after this motion of it, in the view's frame."""
    views, R = list(sensor.views), rotations(torch.from_numpy(motion[:3])).numpy()
    motion_of_surface = ViewPose(R, pivot + motion[3:] - R @ pivot)
    pose = ViewPose.of_matrix(views[number].pose.matrix @ motion_of_surface.inverse.matrix)
    views[number] = replace(views[number], pose=pose)
    return replace(sensor, views=tuple(views))


def _seen(sensor: Sensor, points: np.ndarray) -> np.ndarray:
    pixels: np.ndarray = sensor.camera.point_to_pixel(torch.from_numpy(points)).numpy()
    return pixels


def _pitch(pixels: np.ndarray) -> float:
    """The median distance to the nearest neighbour."""
    return float(np.median(np.asarray(cKDTree(pixels).query(pixels, k=2)[0])[:, 1]))


def _extent(pixels: np.ndarray) -> float:
    """The median distance from the median."""
    return float(np.median(np.linalg.norm(pixels - np.median(pixels, 0), axis=1)))
