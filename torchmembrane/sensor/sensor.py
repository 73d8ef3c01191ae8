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
    SensorParts,
    Surface,
    refuse_other_size,
)
from .record import Record
from .toml import read_sensor, tables_of, write_sensor
from .units import METRE, hectopascal
from .views import SurfaceInView, View, refuse_views
from .working_range import GENERAL, WorkingRange


@check_arguments
@dataclass(frozen=True, eq=False)
class Sensor:
    """All that is known of one sensor; checked at construction.

    Args:
        name: any text.
        length_unit: "mm" | "cm" | "m" | "um" | "inch".
        camera: the calibrated `Camera`.
        membrane: the rest surface on the solver grid, in the camera's frame.
        material: its elastic energy and stiffness.
        cavity: what fills it.
        markers: what the camera follows on it.
        surface: how the file describes the rest surface (default: by the membrane's grid).
        tool: the camera's pose in the frame of the tool (a robot's flange, a fingertip), where it is known.
        record: serial and calibration of the piece, as `[record]` has them; no part of the fingerprint.
        range: in which its answers were shown right, of `check --accuracy`; else the general one.
        views: all `View`s of a sensor with several cameras or mirrors, the first one that of `camera` and the markers' rest
            image; empty: the camera is the only one.

    A rest image of the calibrated size is cropped and binned where the camera is `in_mode`.

    Raises:
        MembraneError: a dot lies off the rest surface or on another one, or the rest image has another size than the camera's.

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
        """The sensor of one of the views alone, in that view's frame: its camera, and the membrane as it is seen from there.

        Args:
            number: number of the view, from 0; 0 of a sensor with one camera is the sensor itself.

        Raises:
            MembraneError: there is no such view.

        Example:
            >>> sensor = Sensor.from_file("examples/sensor.toml")
            >>> sensor.in_view(0) is sensor
            True
        """
        expect(0 <= number < max(1, len(self.views)), "Sensor.in_view: number", number, f"0 to {max(1, len(self.views)) - 1}")
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
        """The sensor with another lens or other ports of its camera, or of that of a view.

        Args:
            camera: the camera, in the pixels of that view's images.
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
        """Refuse a sensor with several views where only one is taken.

        Args:
            owner: what takes it, as the message begins.

        Raises:
            MembraneError: with the remedy.
        """
        expect(not self.views, f"{owner}: views", len(self.views), "one camera, as of sensor.in_view(0)")

    def refuse_heights(self, owner: str) -> None:
        """Refuse a sensor whose markers stand off the surface where they must lie on it.

        Args:
            owner: what needs them there, as the message begins.

        Raises:
            MembraneError: with the remedy.
        """
        height, expected = self.markers.height, "0: markers must lie on the surface for this; a pin's height is not known to it"
        expect(not self.markers.stand_off, f"{owner}: height of the markers", height, expected)

    @property
    def image_size(self) -> tuple[int, int]:
        """Width and height of its images, px. For several views it is the size of their common or largest image."""
        modes = [view.camera.mode for view in self.views if view.region is not None]
        if modes and modes[0] is not None:
            return modes[0].image_size
        sizes = [view.camera.image_size for view in self.views] or [self.camera.image_size]
        return max(size[0] for size in sizes), max(size[1] for size in sizes)

    @property
    def views_apart(self) -> list[str]:
        """Names of the views where each has images of its own; none of one view, or of regions of one image."""
        return [view.name for view in self.views if view.region is None]

    def _solve_again(self, surface: InflatedSurface) -> None:
        """The rest surface of the sensor's own material, where the given one was solved with another."""
        own = surface.made_of(self.material, self.length_unit)
        if own is surface:
            return
        grid = self.membrane.grid
        if _same_surface(surface.membrane(grid), self.membrane):
            object.__setattr__(self, "membrane", own.membrane(grid))
        object.__setattr__(self, "surface", own)

    @property
    def force_unit(self) -> str:
        """Either "N" or "relative": forces in units of shear modulus x thickness x length unit."""
        known = self.material.shear_modulus is not None and self.material.thickness is not None
        return "N" if known else "relative"

    @property
    def gas_pressure(self) -> float | None:
        """The cavity's absolute pressure at rest in N per length unit squared; 1 hPa = 100 N/m^2."""
        pressure = self.cavity.pressure
        return None if pressure is None else pressure * hectopascal(self.length_unit)

    @property
    def parts(self) -> SensorParts:
        """The arguments that make this sensor."""
        return SensorParts(*(getattr(self, name) for name in SensorParts._fields))

    @cached_property
    def fingerprint(self) -> str:
        """sha256 of the content: arrays and the rest image's grey values, wherever and in whatever order they were written."""
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
        """The sensor that a `sensor.toml` describes, with the files named in it (paths relative to it).

        Args:
            path: path of the `.toml` file.

        Returns:
            The `Sensor`.

        Raises:
            MembraneError: names file, key (or line), what came, what was expected and the remedy.

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
        """Write the sensor, its arrays beside it: `sensor_grid.npz`, `sensor_dots.csv`, `sensor_rest.png`.

        Args:
            path: a `.toml`, after which the arrays' files are named; or a folder, which gets `sensor.toml`.

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
    """The markers with a rest image of the camera's size, cropped and binned if it is of the calibrated one."""
    size = (rest_image.shape[1], rest_image.shape[0])
    refuse_other_size(size, camera)
    if size == camera.image_size or camera.mode is None:
        return markers
    return replace(markers, rest_image=camera.mode.image(rest_image))


def _same_surface(one: Membrane, other: Membrane) -> bool:
    return torch.equal(one.rest, other.rest.to(one.rest)) and torch.equal(one.fixed, other.fixed.to(one.fixed.device))


def _as_numbers(value: object) -> object:
    """Whole and other numbers alike, so that 12 and 12.0 have one fingerprint."""
    if isinstance(value, Mapping):
        return {key: _as_numbers(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_as_numbers(item) for item in value]
    return value if value is None or isinstance(value, str) else float(value)  # type: ignore[arg-type]
