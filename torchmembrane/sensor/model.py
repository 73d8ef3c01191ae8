"""A sensor: camera, membrane, material, cavity and markers, read from one `sensor.toml` and written back.

Lengths are in the sensor's unit, in the camera's frame. Pressures in the file are in hPa.
"""

import hashlib
import json
import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
import torch

from ..camera.model import Camera
from ..errors import MembraneError
from ..io.images import read_image, to_grey
from ..surface import shapes
from ..surface.membrane import Membrane

FORMAT = 1
METRE = {"mm": 1000.0, "cm": 100.0, "m": 1.0}  # one metre in the length unit
OFF_SURFACE = 0.05  # largest distance of a dot from the rest surface, in the surface's size
SHAPES_BY_NUMBERS = {
    "spherical_cap": ("rim_radius", "height", "base_z"),
    "ellipsoid_cap": ("semi_axes", "base_z"),
    "half_cylinder": ("radius", "length", "half_angle", "base_z"),
}
SHAPES_BY_ARRAYS = {"grid": ("vertices", "fixed"), "heightfield": ("x", "y", "z")}


@dataclass(frozen=True)
class Material:
    """The membrane: energy, prestretch, and its stiffness where known.

    model: "harmonic" | "neo_hookean" | "mooney_rivlin"; prestretch >= 1, equal in both directions; c2_ratio: C2 / C1,
    Mooney-Rivlin only; shear_modulus: N per length unit squared; thickness: length unit, at rest (already stretched).
    """

    model: str
    prestretch: float
    c2_ratio: float | None = None
    shear_modulus: float | None = None
    thickness: float | None = None

    def __post_init__(self):
        models = ("harmonic", "neo_hookean", "mooney_rivlin")
        _expect(self.model in models, "material model", self.model, f"one of {', '.join(models)}")
        _expect(1 <= self.prestretch < math.inf, "prestretch", self.prestretch, "1 (unstretched) or more")
        if self.model == "mooney_rivlin":
            right = self.c2_ratio is not None and 0 <= self.c2_ratio < math.inf
            _expect(right, "c2_ratio", self.c2_ratio, "C2 / C1, 0 or more, as model is mooney_rivlin: add it")
        else:
            _expect(self.c2_ratio is None, "c2_ratio", self.c2_ratio, f"none, as model is {self.model}: remove it")
        _positive(self, "shear_modulus", "thickness")

    @property
    def modulus(self) -> float:
        """Shear modulus times thickness, N per length unit; 1 where either is unknown."""
        return 1.0 if self.shear_modulus is None or self.thickness is None else self.shear_modulus * self.thickness


@dataclass(frozen=True)
class Cavity:
    """What presses from inside: filling "liquid" | "gas" | "open"; a gas' absolute pressure at rest (hPa) and its volume
    (length unit cubed; None: between the rim and the rest surface)."""

    filling: str
    pressure: float | None = None
    volume: float | None = None

    def __post_init__(self):
        _expect(self.filling in ("liquid", "gas", "open"), "filling", self.filling, "'liquid', 'gas' or 'open'")
        known = self.filling != "gas" or self.pressure is not None
        _expect(known, "pressure", None, "the gas' absolute pressure at rest in hPa, about 1013: add it")
        _positive(self, "pressure", "volume")


@dataclass(frozen=True, eq=False)
class Markers:
    """What the camera follows: kind "dots" | "texture", polarity "dark" | "light" (the marks against their ground).

    positions: `[D, 3]` of the dots at rest, or None; sizes: D times "small" | "large", or None; rest_image: a path, or an
    array as `to_grey` takes it, kept as grey float32 `[height, width]`, or None.
    """

    kind: str
    polarity: str = "dark"
    positions: np.ndarray | None = None
    sizes: list[str] | None = None
    rest_image: np.ndarray | None = None

    def __post_init__(self):
        _expect(self.kind in ("dots", "texture"), "kind", self.kind, "'dots' or 'texture'")
        _expect(self.polarity in ("dark", "light"), "polarity", self.polarity, "'dark' or 'light'")
        if self.rest_image is not None:
            given = self.rest_image
            image = read_image(given) if isinstance(given, str | Path) else to_grey(given)
            object.__setattr__(self, "rest_image", image)
        elif self.kind == "texture":
            raise MembraneError("rest_image is missing; expected for texture, whose patches are chosen in it: add one")
        elif self.positions is None:
            raise MembraneError("file and rest_image are missing; expected dots, an image that shows them, or both")
        if self.positions is None:
            _expect(self.sizes is None, "sizes", self.sizes, "none without positions")
            return
        positions = np.asarray(self.positions, dtype=np.float64)
        right = positions.ndim == 2 and positions.shape[1] == 3 and len(positions) > 0 and np.isfinite(positions).all()
        _expect(right, "positions", f"an array {list(positions.shape)}", "[D, 3], finite, D at least 1")
        sizes = ["small"] * len(positions) if self.sizes is None else list(self.sizes)
        right = len(sizes) == len(positions) and set(sizes) <= {"small", "large"}
        _expect(right, "sizes", sizes, f"{len(positions)} times 'small' or 'large'")
        object.__setattr__(self, "positions", positions)
        object.__setattr__(self, "sizes", sizes)


@dataclass(frozen=True, eq=False)
class Surface:
    """The rest surface as the file describes it, before it is brought on the solver grid.

    shape: "grid" | "spherical_cap" | "ellipsoid_cap" | "half_cylinder" | "heightfield"; values: the numbers or arrays that
    belong to it, by the file's keys.
    """

    shape: str
    values: Mapping[str, object]

    def membrane(self, grid: tuple[int, int]) -> Membrane:
        """The surface on a solver grid; what lies in arrays is interpolated unless it has that grid already."""
        if self.shape in SHAPES_BY_NUMBERS:
            return getattr(shapes, self.shape)(**self.values, grid=grid)
        source = Membrane(**self.values) if self.shape == "grid" else shapes.heightfield(**self.values)
        return source if source.grid == tuple(grid) else source.resampled(tuple(grid))

    @classmethod
    def of(cls, membrane: Membrane) -> "Surface":
        m, n = membrane.grid
        vertices = membrane.rest.cpu().double().numpy().reshape(m, n, 3)
        return cls("grid", {"vertices": vertices, "fixed": membrane.fixed.cpu().numpy().reshape(m, n)})


@dataclass(frozen=True, eq=False)
class Sensor:
    """All that is known of one sensor; checked at construction.

    length_unit: "mm" | "cm" | "m"; membrane: on the solver grid; surface: how the file describes it (default: by the grid).

    Raises:
        MembraneError: a dot lies off the rest surface, or the rest image has another size than the camera's.
    """

    name: str
    length_unit: str
    camera: Camera
    membrane: Membrane
    material: Material
    cavity: Cavity
    markers: Markers
    surface: Surface | None = None

    def __post_init__(self):
        _expect(self.length_unit in METRE, "length_unit", self.length_unit, "'mm', 'cm' or 'm'")
        if self.surface is None or not _same_surface(self.surface.membrane(self.membrane.grid), self.membrane):
            object.__setattr__(self, "surface", Surface.of(self.membrane))
        if self.markers.rest_image is not None:
            size = self.markers.rest_image.shape[::-1]
            if size != self.camera.image_size:
                raise MembraneError(
                    f"Sensor: rest_image is {size[0]} x {size[1]} px and image_size {list(self.camera.image_size)}; expected "
                    "the same: calibrate the camera at the images' resolution"
                )
        if self.markers.positions is not None:
            refuse_off_surface(self.membrane, self.markers.positions, lambda i: f"Sensor: markers.positions[{i}]")

    @property
    def force_unit(self) -> str:
        """Either "N" or "relative": forces in units of shear modulus x thickness x length unit."""
        known = self.material.shear_modulus is not None and self.material.thickness is not None
        return "N" if known else "relative"

    @property
    def gas_pressure(self) -> float | None:
        """The cavity's absolute pressure at rest in N per length unit squared; 1 hPa = 100 N/m^2."""
        pressure = self.cavity.pressure
        return None if pressure is None else 100 * pressure / METRE[self.length_unit] ** 2

    @cached_property
    def fingerprint(self) -> str:
        """sha256 of the content: arrays and the rest image's grey values, wherever and in whatever order they were written."""
        markers, values = self.markers, self.surface.values
        arrays = {key: value for key, value in values.items() if isinstance(value, np.ndarray)}
        arrays |= {"positions": markers.positions, "rest_image": markers.rest_image}
        words = dict(content(self), sizes=markers.sizes)
        digest = hashlib.sha256(json.dumps(_as_numbers(words), sort_keys=True).encode())
        for key, array in sorted(arrays.items()):
            if array is not None:
                digest.update(f"{key} {array.shape}".encode())
                digest.update(np.ascontiguousarray(array, dtype="<f8").tobytes())
        return digest.hexdigest()

    @classmethod
    def from_file(cls, path: str | Path) -> "Sensor":
        """The sensor that a `sensor.toml` describes, with the files named in it (paths relative to it).

        Raises:
            MembraneError: names file, key (or line), what came, what was expected and the remedy.
        """
        from .toml import read_sensor

        return read_sensor(Path(path))

    def to_file(self, path: str | Path) -> Path:
        """Write the sensor to `path` (a `.toml`, or a folder that gets `sensor.toml`), its arrays beside it; returns the path.

        The arrays' names begin with the file's: `sensor_grid.npz`, `sensor_dots.csv`, `sensor_rest.png`.
        """
        from .toml import write_sensor

        path = Path(path)
        return write_sensor(self, path if path.suffix == ".toml" else path / "sensor.toml")


def content(sensor: Sensor) -> dict[str, dict]:
    """The sensor's numbers and words, without arrays, as the tables and keys of its file."""
    camera, material, cavity, markers = sensor.camera, sensor.material, sensor.cavity, sensor.markers
    numbers = {key: value for key, value in sensor.surface.values.items() if not isinstance(value, np.ndarray)}
    return {
        "": {"format": FORMAT, "name": sensor.name, "length_unit": sensor.length_unit},
        "camera": {
            "model": camera.model,
            "image_size": list(camera.image_size),
            **{key: getattr(camera, key).tolist() for key in ("focal", "centre", "distortion")},
            "ports": [port._asdict() for port in camera.ports],
            "medium": {"index": camera.medium_index.item()} if camera.ports else {},
        },
        "membrane": {"shape": sensor.surface.shape, "grid": list(sensor.membrane.grid), **numbers},
        "material": asdict(material),
        "cavity": asdict(cavity),
        "markers": {"kind": markers.kind, "polarity": markers.polarity},
    }


def refuse_off_surface(membrane: Membrane, positions: np.ndarray, named) -> None:
    """Raise for the first dot of `positions [D, 3]` that is not near the rest surface; `named(i)` says which one it is."""
    distance = membrane.closest_points(positions).distance
    limit = OFF_SURFACE * membrane.size
    if not (distance <= limit).all():
        i = int(np.flatnonzero(~(distance <= limit))[0])
        raise MembraneError(
            f"{named(i)} at {positions[i].tolist()} is {distance[i]:.4g} off the rest surface; expected at most {limit:.4g}: "
            "give positions at rest, in the camera's frame and the sensor's length unit"
        )


def _same_surface(one: Membrane, other: Membrane) -> bool:
    return torch.equal(one.rest, other.rest.to(one.rest)) and torch.equal(one.fixed, other.fixed.to(one.fixed.device))


def _as_numbers(value):
    """Whole and other numbers alike, so that 12 and 12.0 have one fingerprint."""
    if isinstance(value, Mapping):
        return {key: _as_numbers(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_as_numbers(item) for item in value]
    return value if value is None or isinstance(value, str) else float(value)


def _expect(right: bool, name: str, value: object, expected: str) -> None:
    if not right:
        raise MembraneError(f"{name} is {value!r}; expected {expected}")


def _positive(owner: Material | Cavity, *names: str) -> None:
    for name in names:
        value = getattr(owner, name)
        _expect(value is None or 0 < value < math.inf, name, value, "a finite positive number, or leave it out")
