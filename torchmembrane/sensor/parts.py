"""The parts of a sensor: material, cavity, markers and rest surface as plain values, checked at construction.

Lengths are in the sensor's unit, positions in the camera's frame, and pressures in hPa, as in the file.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ..camera.model import Camera
from ..errors import MembraneError, check_arguments, expect
from ..files.images import read_image, to_grey
from ..surface import shapes
from ..surface.checks import FARTHEST
from ..surface.membrane import Membrane
from .suggestions import did_you_mean

MOST_PRESTRETCH, MOST_C2_RATIO, MOST_FRICTION = 10.0, 1e3, 10.0
FRICTION = 0.5
"""Default coefficient of friction of a material."""
POSITIVE = {"shear_modulus": (1e-12, 1e12), "thickness": (1e-6, 1e5), "pressure": (1e-3, 1e6), "volume": (1e-12, 1e18)}
"""Lowest and highest allowed values, in the file's units; they are wide enough for every length unit."""
FILLINGS = ("liquid", "gas", "open")
MODELS = ("harmonic", "neo_hookean", "mooney_rivlin")
SHAPES_BY_NUMBERS = {
    "spherical_cap": ("rim_radius", "height", "base_z"),
    "ellipsoid_cap": ("semi_axes", "base_z"),
    "half_cylinder": ("radius", "length", "half_angle", "base_z"),
}
SHAPES_BY_ARRAYS = {"grid": ("vertices", "fixed"), "heightfield": ("x", "y", "z")}


@check_arguments
@dataclass(frozen=True)
class Material:
    """The membrane's elastic energy, its prestretch, and its stiffness if known.

    Args:
        model: "harmonic" | "neo_hookean" | "mooney_rivlin".
        prestretch: the equibiaxial prestretch, 1 or more.
        c2_ratio: C2 / C1, for "mooney_rivlin" only.
        shear_modulus: shear modulus, N per length unit squared; None: forces are relative.
        thickness: thickness at rest, after prestretching, length unit; None: forces are relative.
        friction: Coulomb's coefficient of friction between the membrane and the bodies that are expected to touch it.

    Raises:
        MembraneError: a value is invalid; the message names it and says what was expected.

    Example:
        >>> Material("neo_hookean", prestretch=1.25, shear_modulus=0.3, thickness=0.4).modulus
        0.12
    """

    model: str
    prestretch: float
    c2_ratio: float | None = None
    shear_modulus: float | None = None
    thickness: float | None = None
    friction: float = FRICTION

    def __post_init__(self) -> None:
        meant = did_you_mean(self.model, MODELS)
        expect(self.model in MODELS, "material model", self.model, f"one of {', '.join(MODELS)}" + (meant and f": {meant}"))
        known = 1 <= self.prestretch <= MOST_PRESTRETCH
        expect(known, "prestretch", self.prestretch, f"1 (unstretched) or more, at most {MOST_PRESTRETCH:g}")
        if self.model == "mooney_rivlin":
            right = self.c2_ratio is not None and 0 <= self.c2_ratio <= MOST_C2_RATIO
            expected = f"C2 / C1, from 0 to {MOST_C2_RATIO:g}, as model is mooney_rivlin: add it"
            expect(right, "c2_ratio", self.c2_ratio, expected)
        else:
            expect(self.c2_ratio is None, "c2_ratio", self.c2_ratio, f"none, as model is {self.model}: remove it")
        _expect_positive(shear_modulus=self.shear_modulus, thickness=self.thickness)
        expected = f"Coulomb's coefficient, from 0 (no friction) to {MOST_FRICTION:g}"
        expect(0 <= self.friction <= MOST_FRICTION, "friction", self.friction, expected)

    @property
    def modulus(self) -> float:
        """Shear modulus times thickness, N per length unit; 1 if either is unknown."""
        return 1.0 if self.shear_modulus is None or self.thickness is None else self.shear_modulus * self.thickness


@check_arguments
@dataclass(frozen=True)
class Cavity:
    """The filling of the cavity behind the membrane.

    Args:
        filling: "liquid" (constant volume) | "gas" (constant product of absolute pressure and volume) | "open" (the pressure
            stays as at rest).
        pressure: absolute pressure of a gas at rest, hPa.
        volume: volume of a gas at rest, length unit cubed; None: the volume between the rim and the rest surface.

    Raises:
        MembraneError: a value is invalid; the message names it and says what was expected.

    Example:
        >>> Cavity("gas", pressure=1013.0).volume is None
        True
    """

    filling: str
    pressure: float | None = None
    volume: float | None = None

    def __post_init__(self) -> None:
        meant = did_you_mean(self.filling, FILLINGS)
        expected = "'liquid', 'gas' or 'open'" + (meant and f": {meant}")
        expect(self.filling in FILLINGS, "filling", self.filling, expected)
        known = self.filling != "gas" or self.pressure is not None
        expect(known, "pressure", None, "the gas' absolute pressure at rest in hPa, about 1013: add it")
        _expect_positive(pressure=self.pressure, volume=self.volume)


@check_arguments
@dataclass(frozen=True, eq=False)
class Markers:
    """The markers that the camera tracks.

    Args:
        kind: "dots" | "texture".
        polarity: "dark" | "light": markers that are darker or lighter than their background.
        positions: positions of the D dots at rest, `[D, 3]`, length unit, camera's frame; None: found in the rest image.
        sizes: list of D sizes, "small" | "large"; None: all are small.
        rest_image: an array that `to_grey` accepts, or the path of an image; stored as grey float32 `[height, width]`.
        height: height of dots that stand off the membrane's inner side along the inward normal, such as the tips of pins,
            length unit: one number for all, or `[D]`, one for each listed dot. A dot's position is then its foot's.

    Raises:
        MembraneError: a value is invalid; the message names it and says what was expected.

    Example:
        >>> Markers("dots", positions=np.array([[0.0, 0.0, 24.0], [2.0, 0.0, 23.8]])).sizes
        ['small', 'small']
    """

    kind: str
    polarity: str = "dark"
    positions: np.ndarray | None = None
    sizes: list[str] | None = None
    rest_image: np.ndarray | None = None
    height: float | np.ndarray = 0.0

    def __post_init__(self) -> None:
        expect(self.kind in ("dots", "texture"), "kind", self.kind, "'dots' or 'texture'")
        expect(self.polarity in ("dark", "light"), "polarity", self.polarity, "'dark' or 'light'")
        if self.rest_image is not None:
            given = self.rest_image
            image = read_image(given) if isinstance(given, str | Path) else to_grey(given)
            object.__setattr__(self, "rest_image", image)
        elif self.kind == "texture":
            raise MembraneError("rest_image is missing; expected for texture, whose patches are chosen in it: add one")
        elif self.positions is None:
            raise MembraneError(
                "neither dots nor a rest image is given; expected positions (in a sensor file: file), a rest_image in which "
                "the dots are found, or both"
            )
        if self.positions is None:
            expect(self.sizes is None, "sizes", self.sizes, "none without positions")
            self._set_height(0)
            return
        positions = np.asarray(self.positions, dtype=np.float64)
        right = positions.ndim == 2 and positions.shape[1] == 3 and len(positions) > 0
        right = right and bool((np.abs(positions) <= FARTHEST).all())
        expected = f"[D, 3], finite, up to {FARTHEST:g}, D at least 1"
        expect(right, "positions", f"an array {list(positions.shape)}", expected)
        sizes = ["small"] * len(positions) if self.sizes is None else list(self.sizes)
        right = len(sizes) == len(positions) and set(sizes) <= {"small", "large"}
        expect(right, "sizes", sizes, f"{len(positions)} times 'small' or 'large'")
        object.__setattr__(self, "positions", positions)
        object.__setattr__(self, "sizes", sizes)
        self._set_height(len(positions))

    def _set_height(self, count: int) -> None:
        """Check the heights of `count` listed dots, and store a single number if they are equal."""
        heights = np.asarray(self.height, dtype=np.float64)
        right = heights.shape in ((), (count,)) and bool(np.isfinite(heights).all())
        expect(right, "height", self.height, f"a finite number, or an array of {count}, one for each listed dot")
        alike = heights.ndim == 0 or bool((heights == heights[:1]).all())
        object.__setattr__(self, "height", float(heights.flat[0]) if alike and heights.size else heights)
        standing = self.kind == "dots" or not self.stand_off
        expect(standing, "height", self.height, "no height for texture, which lies on the surface: remove it")

    @property
    def stand_off(self) -> bool:
        """Whether any marker stands off the surface."""
        return bool(np.any(self.height))

    def heights(self, count: int) -> np.ndarray:
        """Return the heights of `count` markers, `[count]`."""
        return np.broadcast_to(np.asarray(self.height, dtype=np.float64), (count,))


@check_arguments
@dataclass(frozen=True, eq=False)
class Surface:
    """The rest surface as the sensor file describes it, before it is resampled to the solver grid.

    Args:
        shape: "grid" | "spherical_cap" | "ellipsoid_cap" | "half_cylinder" | "heightfield".
        values: the numbers or arrays that describe this shape, by the keys of the sensor file.

    Raises:
        MembraneError: the shape is unknown, or the keys of `values` are not those of this shape.

    Example:
        >>> cap = Surface("spherical_cap", {"rim_radius": 12.0, "height": 9.0, "base_z": 15.0})
        >>> cap.membrane((17, 21)).grid
        (17, 21)
    """

    shape: str
    values: Mapping[str, Any]

    def __post_init__(self) -> None:
        known = SHAPES_BY_NUMBERS | SHAPES_BY_ARRAYS
        expect(self.shape in known, "Surface: shape", self.shape, f"one of {', '.join(known)}")
        keys = known[self.shape]
        right = set(self.values) in (set(keys), set(keys) - {"fixed"})
        expect(right, f"Surface: values of a {self.shape}", list(self.values), ", ".join(keys))

    @check_arguments
    def membrane(self, grid: tuple[int, int]) -> Membrane:
        """Return the surface on a solver grid; arrays are interpolated unless they already have that grid.

        Args:
            grid: number of vertices in each direction.

        Returns:
            The `Membrane`.

        Raises:
            MembraneError: the surface folds, or the camera cannot see it.
        """
        if self.shape in SHAPES_BY_NUMBERS:
            made: Membrane = getattr(shapes, self.shape)(**self.values, grid=grid)
            return made
        source = Membrane(**self.values) if self.shape == "grid" else shapes.heightfield(**self.values)
        return source if source.grid == tuple(grid) else source.resampled((grid[0], grid[1]))

    @classmethod
    @check_arguments
    def from_membrane(cls, membrane: Membrane) -> "Surface":
        """Return the surface that a membrane's vertices describe.

        Args:
            membrane: a membrane on any grid.

        Returns:
            A `Surface` of shape "grid".
        """
        m, n = membrane.grid
        vertices = membrane.rest.cpu().double().numpy().reshape(m, n, 3)
        return cls("grid", {"vertices": vertices, "fixed": membrane.fixed.cpu().numpy().reshape(m, n)})

    of = from_membrane  # its name before 0.2.0

    def arrays(self) -> dict[str, np.ndarray]:
        """Return the values that are arrays; they are stored in a separate file."""
        return {key: value for key, value in self.values.items() if isinstance(value, np.ndarray)}

    def numbers(self) -> dict[str, Any]:
        """Return the values that are stored in the sensor file itself."""
        return {key: value for key, value in self.values.items() if not isinstance(value, np.ndarray)}


def refuse_other_size(size: tuple[int, int], camera: Camera) -> None:
    """Raise an error if a rest image has neither the camera's size nor, for a cropped or binned camera, the calibrated size.

    Args:
        size: width and height of the image, px.
        camera: the sensor's camera.

    Raises:
        MembraneError: the size is wrong; the message has both sizes and the remedy.
    """
    mode = camera.mode
    if size == camera.image_size or (mode is not None and size == mode.image_size):
        return
    came = f"Sensor: rest_image is {size[0]} x {size[1]} px and image_size {list(camera.image_size)}"
    if mode is None:
        raise MembraneError(f"{came}; expected the same size; if the camera crops or bins, add crop and binning")
    how = f"of crop {list(mode.crop)} and binning {list(mode.binning)}"
    raise MembraneError(f"{came} {how}; expected the same size, or the calibrated {list(mode.image_size)}")


def _expect_positive(**values: float | None) -> None:
    for name, value in values.items():
        low, high = POSITIVE[name]
        expected = f"a finite positive number, from {low:g} to {high:g}, or leave it out"
        expect(value is None or low <= value <= high, name, value, expected)
