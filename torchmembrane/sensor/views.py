"""Several views of one membrane, by cameras or mirrors: their poses, and the rest surface in the frame of each."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from ..camera.model import Camera
from ..errors import MembraneError, check_arguments, expect
from ..files.images import read_image, to_grey
from ..pose import ViewPose
from ..surface.membrane import Membrane
from .parts import Surface

SIDES = ("inside", "outside")
MOST_VIEWS = 8
FEWEST_LINES = 25
"""Fewest lines per side of the solver grid with several views: a coarser grid would dominate the error of forces."""
SAME_PLACE = 1e-9
"""Largest difference of any entry of the first view's pose from the identity."""


@check_arguments
@dataclass(frozen=True, eq=False)
class View:
    """One view of a membrane that several cameras or mirrors see.

    Args:
        name: name of the view, one word; the view's image files are named with it.
        camera: the calibrated `Camera`; for a region of a shared image, that of the region: `camera.in_mode(region)`.
        pose: pose of the view's frame in the first view's frame; a mirror's pose includes a reflection.
        rest_image: image without contact, as for `Markers`; None: displacements are measured from the projected rest markers.
        side: side of the membrane that the view sees, "inside" | "outside".
        is_region: whether the view is a region of an image that all views share.

    Raises:
        MembraneError: a value is invalid; the message names it and says what was expected.

    Example:
        >>> camera = Camera("pinhole", (640, 480), (400, 400), (320, 240))
        >>> View("left", camera, ViewPose(np.array([0.0, 30.0, 0.0]), np.array([-20.0, 0.0, 0.0]))).side
        'inside'
    """

    name: str
    camera: Camera
    pose: ViewPose = field(default_factory=lambda: ViewPose(np.eye(3), np.zeros(3)))
    rest_image: np.ndarray | None = None
    side: str = SIDES[0]
    is_region: bool = False

    def __post_init__(self) -> None:
        expected = "a name of letters, digits and dashes, of which image files are named"
        expect(self.name.replace("-", "").isalnum() and self.name.isascii(), "View: name", self.name, expected)
        expect(self.side in SIDES, "View: side", self.side, "'inside' or 'outside'")
        if self.rest_image is not None:
            given = self.rest_image
            image = read_image(given) if isinstance(given, str) else to_grey(given)
            object.__setattr__(self, "rest_image", image)
            size, wanted = (image.shape[1], image.shape[0]), self.camera.image_size
            expect(size == wanted, f"View {self.name!r}: size of its rest image", list(size), f"{list(wanted)}, its camera's")

    @property
    def region(self) -> tuple[int, int, int, int] | None:
        """Left, top, width and height of the region in the shared image, px; None: the view has images of its own."""
        return tuple(self.camera.mode.crop) if self.is_region and self.camera.mode is not None else None  # type: ignore[return-value]

    @property
    def image_camera(self) -> Camera:
        """Camera of the images that show the view: of the whole shared image if the view is a region of it."""
        mode = self.camera.mode
        if self.region is None or mode is None:
            return self.camera
        return _with_lens(self.camera, mode.image_size, mode.focal, mode.centre)

    def with_camera(self, camera: Camera) -> "View":
        """Return the view with another camera (lens and ports), for the pixels of the view's own images or region.

        Example:
            >>> whole = Camera("pinhole", (640, 480), (400, 400), (320, 240))
            >>> right = View("right", whole.in_mode((320, 0, 320, 480)), is_region=True)
            >>> found = right.with_camera(Camera("pinhole", (320, 480), (410, 410), (2, 240)))
            >>> found.region, found.camera.focal.tolist(), found.camera.mode.centre
            ((320, 0, 320, 480), [410.0, 410.0], (322.0, 240.0))
        """
        if self.region is None or self.camera.mode is None:
            return replace(self, camera=camera)
        left, top, _, _ = self.region
        u, v = camera.centre.tolist()
        whole = _with_lens(camera, self.camera.mode.image_size, camera.focal.tolist(), (u + left, v + top))
        return replace(self, camera=whole.in_mode(self.region))

    def membrane(self, membrane: Membrane) -> Membrane:
        """Return the membrane in the view's frame; its outward normals point away from the view's camera on either side."""
        return membrane.in_frame(self.pose.inverse, outside=self.side == "outside")

    def height(self, height: float | np.ndarray) -> float | np.ndarray:
        """Return the markers' height along the normals that point to the view's camera: negated for "outside"."""
        return -height if self.side == "outside" else height

    def described(self) -> dict[str, Any]:
        """Return name, pose, region and side by the keys of the sensor's file."""
        return {
            "name": self.name,
            "pose": self.pose.matrix.tolist(),
            "region": None if self.region is None else list(self.region),
            "side": None if self.side == SIDES[0] else self.side,
        }


def _with_lens(camera: Camera, image_size: Sequence[int], focal: Sequence[float], centre: Sequence[float]) -> Camera:
    """Return a camera with another image size, focal length and centre, and with the distortion, ports and bits of `camera`."""
    beyond: dict[str, Any] = dict(ports=camera.ports, medium_index=camera.medium_index.item(), bits=camera.bits)
    return Camera(camera.model, image_size, focal, centre, camera.distortion.tolist(), **beyond)


class SurfaceInView(Surface):
    """A rest surface in the frame of a view, which may see only a part of it.

    Args:
        surface: the rest surface in the first view's frame.
        view: the view.
    """

    def __init__(self, surface: Surface, view: View) -> None:
        object.__setattr__(self, "shape", surface.shape)
        object.__setattr__(self, "values", surface.values)
        object.__setattr__(self, "whole", surface)
        object.__setattr__(self, "view", view)

    whole: Surface
    view: View

    def membrane(self, grid: tuple[int, int]) -> Membrane:
        """Return the rest surface on a solver grid, in the view's frame."""
        return self.view.membrane(self.whole.membrane(grid))


def refuse_views(views: Sequence[View], has_listed_dots: bool) -> None:
    """Raise an error if the views of a sensor are inconsistent.

    Args:
        views: all views of the sensor, in order.
        has_listed_dots: whether the markers are dots with listed positions.

    Raises:
        MembraneError: the views are inconsistent; the message names the view, the value found and what was expected.
    """
    expect(len(views) <= MOST_VIEWS, "views", len(views), f"at most {MOST_VIEWS}")
    names = [view.name for view in views]
    for number, name in enumerate(names):
        expect(name not in names[:number], "View: name", name, "another name for each view")
    expected = "four rows of the unit matrix: poses are to the first view, whose frame is that of the membrane"
    first = views[0].pose.matrix
    expect(bool(np.abs(first - np.eye(4)).max() <= SAME_PLACE), f"View {names[0]!r}: pose", first.tolist(), expected)
    expect(views[0].side == SIDES[0], f"View {names[0]!r}: side", views[0].side, "'inside' of the first view: list it later")
    expect(has_listed_dots, "markers of several views", "none listed", "dots with their positions (`file`), seen by any view")
    parts = [view.region is not None for view in views]
    if any(parts) and not all(parts):
        without = names[parts.index(False)]
        raise MembraneError(f"View {without!r}: no region; expected one, as other views have one, or none for all views")
    wholes = {view.name: view.camera.mode.image_size for view in views if view.region is not None and view.camera.mode}
    one = next(iter(wholes), "")
    for name, whole in wholes.items():
        expected = f"{list(wholes[one])}, as in view {one!r}: all regions are parts of one shared image"
        expect(whole == wholes[one], f"View {name!r}: image_size", list(whole), expected)
