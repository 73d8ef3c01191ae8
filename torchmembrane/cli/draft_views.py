"""Several views in a drafted sensor: the approximate camera poses, refined with the rest images."""

from argparse import ArgumentTypeError, Namespace
from dataclasses import replace
from pathlib import Path

import numpy as np

from ..calibrate.view_poses import placed_view
from ..calibrate.views import placed_dots
from ..camera.model import Camera
from ..errors import MembraneError
from ..files.images import read_image
from ..markers.placement import markers_in_view
from ..pose import ViewPose
from ..sensor.parts import Markers
from ..sensor.sensor import Sensor
from ..sensor.view_images import view_files
from ..sensor.views import View
from .arguments import vector

UPRIGHT = np.array([0.0, 1.0, 0.0])
"""Approximate direction "down" of all images, which is exact in the first view's image."""


def with_views(sensor: Sensor, arguments: Namespace) -> tuple[Sensor, list[str]]:
    """Add the views to a drafted sensor; return the sensor and lines on what was found.

    Args:
        sensor: drafted sensor of the first view.
        arguments: arguments of the command: `views`, the name of the first view and NAME=X,Y,Z of the others; `rest`, the first
            view's image.

    Raises:
        MembraneError: there are fewer than two views, a view has no position, or a rest image is missing or does not show the
            dots.
    """
    first, *others = arguments.views
    places = dict(text.partition("=")[::2] for text in others)
    if not others or "=" in first or not all(places.values()):
        came = " ".join(arguments.views)
        raise MembraneError(f"init: --views {came}; expected the first view's name, and NAME=X,Y,Z of each other one")
    images = [] if arguments.rest is None else _read(Path(arguments.rest), [first, *places], sensor, arguments.bits)
    if sensor.markers.positions is None:
        positions, sizes = placed_dots(sensor, images[0])
        sensor = replace(sensor, markers=Markers("dots", sensor.markers.polarity, positions, sizes, images[0]))
    middle = sensor.membrane.rest.mean(0).numpy()
    width, height = sensor.camera.image_size
    centre = arguments.centre or ((width - 1) / 2, (height - 1) / 2)
    lens = Camera(sensor.camera.model, sensor.camera.image_size, sensor.camera.focal.tolist(), centre, bits=arguments.bits)
    views = [View(name, lens, looking_at(middle, np.array(_place(name, place)))) for name, place in places.items()]
    sensor = replace(sensor, views=(View(first, sensor.camera), *views))
    if not images:
        return sensor, [_seen_in_words(sensor, number) for number in range(1, len(sensor.views))]
    said = []
    for number, image in enumerate(images[1:], 1):
        sensor, found = placed_view(sensor, number, image)
        view, moved = sensor.views[number], found.fit.noise
        place = ", ".join(f"{value:z.4g}" for value in view.pose.translation)
        said.append(
            f"view {view.name!r} found at {place} {sensor.length_unit}: its dots lie {moved:.2f} px off where it sees them"
        )
    return sensor, said


def _place(name: str, text: str) -> list[float]:
    """Return the position of a view, written X,Y,Z."""
    try:
        return vector(text)
    except ArgumentTypeError as error:
        raise MembraneError(f"init: --views {name}={error}") from None


def looking_at(point: np.ndarray, place: np.ndarray) -> ViewPose:
    """Return the pose of a camera at `place` that looks at `point`, with its image as upright as possible.

    Example:
        >>> pose = looking_at(np.array([0.0, 0.0, 40.0]), np.array([30.0, 0.0, 0.0]))
        >>> pose.vectors(np.array([0.0, 0.0, 50.0])).round(6).tolist(), pose.vectors(np.array([0.0, 1.0, 0.0])).tolist()
        ([-30.0, 0.0, 40.0], [0.0, 1.0, 0.0])
    """
    along = point - place
    along = along / np.linalg.norm(along)
    across = np.cross(UPRIGHT, along)
    if np.linalg.norm(across) < 1e-6:
        raise MembraneError(f"init: --views: a place of {place.tolist()} right above or below the membrane; give its pose")
    across = across / np.linalg.norm(across)
    return ViewPose(np.stack([across, np.cross(along, across), along], -1), place)


def _read(rest: Path, names: list[str], sensor: Sensor, bits: int | None) -> list[np.ndarray]:
    return [read_image(file, sensor.camera.image_size, bits) for file in view_files(rest, names)]


def _seen_in_words(sensor: Sensor, number: int) -> str:
    seen = markers_in_view(sensor.in_view(number))
    return f"view {sensor.views[number].name!r} sees {seen.sum()} of {len(seen)} dots"
