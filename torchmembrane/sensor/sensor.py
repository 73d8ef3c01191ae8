"""A sensor: camera, membrane, material, cavity and markers, read from one `sensor.toml` and written back."""

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np
import torch

from ..camera.model import Camera
from ..errors import MembraneError, check_arguments, expect
from ..pose import Pose
from ..surface.membrane import Membrane
from .inflated import InflatedSurface
from .marker_checks import refuse_coincident, refuse_off_surface, refuse_tall
from .parts import (
    Cavity,
    Markers,
    Material,
    Surface,
    refuse_other_size,
)
from .record import Record
from .toml import SensorParts, read_sensor, tables_of, write_sensor
from .units import METRE, hectopascal
from .views import SurfaceInView, View, refuse_views
from .working_range import GENERAL, WorkingRange


@check_arguments
@dataclass(frozen=True, eq=False)
class Sensor:
    """The complete description of one sensor, checked at construction.

    Args:
        name: any text.
        length_unit: "mm" | "cm" | "m" | "um" | "inch".
        camera: the calibrated `Camera`.
        membrane: the rest surface on the solver grid, in the camera's frame.
        material: the membrane's elastic energy and stiffness.
        cavity: the filling of the cavity behind the membrane.
        markers: the markers that the camera tracks on the membrane.
        surface: the rest surface as the file describes it; default: the membrane's vertices.
        tool: the camera's pose in the frame of the tool (a robot's flange, a fingertip), if it is known.
        record: serial number and calibration of this unit, as in `[record]`; not part of the fingerprint.
        range: the working range that `check --accuracy` has validated; default: the general range.
        views: all `View`s of a sensor with several cameras or mirrors; the first one has `camera` and the markers' rest image.
            Empty if there is only one camera.

    If the camera is `in_mode`, a rest image of the calibrated size is cropped and binned accordingly.

    Raises:
        MembraneError: a dot lies off the rest surface or coincides with another dot, or the size of the rest image differs
            from the camera's.

    Example:
        >>> sensor = Sensor.from_file("examples/sensor.toml")
        >>> sensor.camera.image_size, sensor.length_unit, sensor.force_unit
        ((640, 480), 'mm', 'N')
    """

    name: str
    length_unit: str
    camera: Camera
    membrane: Membrane
    material: Material
    cavity: Cavity
    markers: Markers
    surface: Surface = None  # type: ignore[assignment]  # set below where it is left out
    tool: Pose | None = None
    record: Record = Record()
    range: WorkingRange = GENERAL
    views: tuple[View, ...] = ()

    def __post_init__(self) -> None:
        expect(self.length_unit in METRE, "length_unit", self.length_unit, f"one of {', '.join(METRE)}")
        if isinstance(self.surface, InflatedSurface):
            self._solve_again(self.surface)
        if self.surface is None or not _same_surface(self.surface.membrane(self.membrane.grid), self.membrane):
            object.__setattr__(self, "surface", Surface.from_membrane(self.membrane))
        if self.markers.rest_image is not None:
            object.__setattr__(self, "markers", _in_mode(self.markers, self.markers.rest_image, self.camera))
        if self.markers.positions is not None:
            names = [f"Sensor: markers.positions[{i}]" for i in range(len(self.markers.positions))]
            refuse_off_surface(self.membrane, self.markers.positions, names)
            refuse_coincident(self.membrane, self.markers.positions, names)
        refuse_tall(self.membrane, self.markers)
        if self.views:
            first = replace(self.views[0], camera=self.camera, rest_image=self.markers.rest_image)
            object.__setattr__(self, "views", (first, *self.views[1:]))
            refuse_views(self.views, self.markers.kind == "dots" and self.markers.positions is not None)

    def in_view(self, number: int) -> "Sensor":
        """Return a sensor with a single view: that view's camera, and the membrane in that view's frame.

        Args:
            number: number of the view, from 0. For a sensor with one camera, 0 returns the sensor itself.

        Raises:
            MembraneError: there is no such view.

        Example:
            >>> sensor = Sensor.from_file("examples/sensor.toml")
            >>> sensor.in_view(0) is sensor
            True
        """
        count = max(1, len(self.views))
        expected = "0, as the sensor has one view" if count == 1 else f"0 to {count - 1}, as the sensor has {count} views"
        expect(0 <= number < count, "Sensor.in_view: number", number, expected)
        if number == 0:
            return replace(self, views=()) if self.views else self
        view, markers = self.views[number], self.markers
        positions = None if markers.positions is None else view.pose.inverse.points(markers.positions)
        return replace(
            self,
            camera=view.camera,
            membrane=view.membrane(self.membrane),
            markers=replace(markers, positions=positions, rest_image=view.rest_image, height=view.height(markers.height)),
            surface=SurfaceInView(self.surface, view),
            tool=None,
            views=(),
        )

    def with_camera(self, camera: Camera, number: int = 0) -> "Sensor":
        """Return the sensor with another camera (lens and ports), for one of its views.

        Args:
            camera: the new camera, for the pixels of that view's images.
            number: number of the view, from 0.

        Example:
            >>> sensor = Sensor.from_file("examples/sensor.toml")
            >>> sensor.with_camera(Camera("pinhole", (640, 480), (350, 350), (320, 240))).camera.model
            'pinhole'
        """
        if not self.views:
            return replace(self, camera=camera)
        views = list(self.views)
        views[number] = views[number].with_camera(camera)
        return replace(self, camera=views[0].camera, views=tuple(views))

    def refuse_views(self, owner: str) -> None:
        """Raise an error if the sensor has several views, for functions that support one view only.

        Args:
            owner: name of the calling function, with which the message begins.

        Raises:
            MembraneError: the sensor has several views; the message says what to do.
        """
        expect(not self.views, f"{owner}: views", len(self.views), "one camera, as of sensor.in_view(0)")

    def refuse_heights(self, owner: str) -> None:
        """Raise an error if markers stand off the surface, for functions that need them on the surface.

        Args:
            owner: name of the calling function, with which the message begins.

        Raises:
            MembraneError: markers stand off the surface.
        """
        height, expected = self.markers.height, "0: markers must lie on the surface for this; a pin's height is not known to it"
        expect(not self.markers.stand_off, f"{owner}: height of the markers", height, expected)

    @property
    def image_size(self) -> tuple[int, int]:
        """Width and height of the sensor's images, px; with several views, of their shared image or the largest one."""
        modes = [view.camera.mode for view in self.views if view.region is not None]
        if modes and modes[0] is not None:
            return modes[0].image_size
        sizes = [view.camera.image_size for view in self.views] or [self.camera.image_size]
        return max(size[0] for size in sizes), max(size[1] for size in sizes)

    @property
    def views_apart(self) -> list[str]:
        """Names of the views that have images of their own; empty for one view, or if views are regions of one image."""
        return [view.name for view in self.views if view.region is None]

    @property
    def image_cameras(self) -> list[Camera]:
        """Cameras of the images that arrive together: one for each view, or one alone if the views are regions of its image."""
        if self.views_apart:
            return [view.camera for view in self.views]
        return [self.views[0].image_camera if self.views else self.camera]

    def _solve_again(self, surface: InflatedSurface) -> None:
        """Solve the rest surface again with the sensor's material if the given one was solved with another material."""
        own = surface.made_of(self.material, self.length_unit)
        if own is surface:
            return
        grid = self.membrane.grid
        if _same_surface(surface.membrane(grid), self.membrane):
            object.__setattr__(self, "membrane", own.membrane(grid))
        object.__setattr__(self, "surface", own)

    @property
    def force_unit(self) -> str:
        """The unit of forces: "N", or "relative" for units of shear modulus x thickness x length unit."""
        known = self.material.shear_modulus is not None and self.material.thickness is not None
        return "N" if known else "relative"

    @property
    def gas_pressure(self) -> float | None:
        """Absolute pressure of the gas at rest, N per length unit squared (1 hPa = 100 N/m^2); None if not given."""
        pressure = self.cavity.pressure
        return None if pressure is None else pressure * hectopascal(self.length_unit)

    @property
    def parts(self) -> SensorParts:
        """The constructor arguments of this sensor."""
        return SensorParts(*(getattr(self, name) for name in SensorParts._fields))

    @cached_property
    def fingerprint(self) -> str:
        """SHA-256 of values, arrays and grey values of rest images; it does not depend on file names or the order of keys."""
        markers = self.markers
        arrays: dict[str, np.ndarray | None] = {**self.surface.arrays()}
        arrays |= {"positions": markers.positions, "rest_image": markers.rest_image}
        arrays |= {"height": None if isinstance(markers.height, float) else markers.height}
        arrays |= {f"rest_image {view.name}": view.rest_image for view in self.views[1:]}
        words = dict(tables_of(self.parts), sizes=markers.sizes)
        digest = hashlib.sha256(json.dumps(_as_numbers(words), sort_keys=True).encode())
        for key, array in sorted(arrays.items()):
            if array is not None:
                digest.update(f"{key} {array.shape}".encode())
                digest.update(np.ascontiguousarray(array, dtype="<f8").tobytes())
        return digest.hexdigest()

    @classmethod
    @check_arguments
    def from_file(cls, path: str | Path) -> "Sensor":
        """Read a sensor from a `sensor.toml` and the files named in it (their paths are relative to it).

        Args:
            path: path of the `.toml` file.

        Returns:
            The `Sensor`.

        Raises:
            MembraneError: a file is missing or invalid; the message names the file, the key or line, the value found, the value
                expected and the remedy.

        Example:
            >>> Sensor.from_file("examples/sensor.toml").markers.kind
            'dots'
        """
        parts = read_sensor(Path(path))
        try:
            return cls(*parts)
        except MembraneError as error:
            raise MembraneError(f"{path}: {error}") from error

    @check_arguments
    def to_file(self, path: str | Path) -> Path:
        """Write the sensor's file, and beside it its arrays: `sensor_grid.npz`, `sensor_dots.csv`, `sensor_rest.png`.

        Args:
            path: path of a `.toml` file, after which the other files are named; or a folder, in which `sensor.toml` is written.

        Returns:
            The path of the `.toml` file.

        Example:
            >>> import tempfile
            >>> with tempfile.TemporaryDirectory() as folder:
            ...     written = Sensor.from_file("examples/sensor.toml").to_file(folder)
            ...     sorted(file.name for file in written.parent.iterdir())
            ['sensor.toml', 'sensor_dots.csv', 'sensor_grid.npz', 'sensor_rest.png']
        """
        path = Path(path)
        return write_sensor(self.parts, path if path.suffix == ".toml" else path / "sensor.toml")


def _in_mode(markers: Markers, rest_image: np.ndarray, camera: Camera) -> Markers:
    """Return the markers with a rest image of the camera's size; an image of the calibrated size is cropped and binned."""
    size = (rest_image.shape[1], rest_image.shape[0])
    refuse_other_size(size, camera)
    if size == camera.image_size or camera.mode is None:
        return markers
    return replace(markers, rest_image=camera.mode.image(rest_image))


def _same_surface(one: Membrane, other: Membrane) -> bool:
    return torch.equal(one.rest, other.rest.to(one.rest)) and torch.equal(one.fixed, other.fixed.to(one.fixed.device))


def _as_numbers(value: object) -> object:
    """Convert all numbers to floats, so that 12 and 12.0 have the same fingerprint."""
    if isinstance(value, Mapping):
        return {key: _as_numbers(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_as_numbers(item) for item in value]
    return value if value is None or isinstance(value, str) else float(value)  # type: ignore[arg-type]
