"""Patterns on the membrane, which move with it: dots, speckle, or the pattern of a rest image."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import torch
import torch.nn.functional as F
from scipy.spatial import cKDTree
from torch import Tensor

from ..errors import MembraneError, check_arguments, expect
from ..sensor.sensor import Sensor

DOT_RADIUS = {"small": 0.16, "large": 0.27}  # over the dots' spacing
WAVES = 96  # number of plane waves of a speckle


class Canvas(NamedTuple):
    """The rest surface as a canvas for a pattern.

    Attributes:
        vertices: `[V, 3]`.
        pixels: pixels of the vertices, `[V, 2]`.
        white: grey value of a white membrane there, `[V]`.
    """

    vertices: Tensor
    pixels: Tensor
    white: Tensor


@check_arguments
@dataclass(frozen=True, eq=False)
class Dots:
    """Discs of reflectance `ink` on a ground of reflectance `ground`, both in 0..1.

    A disc consists of all material points whose rest distance from `positions[d]`, in the tangent plane there, is at most
    `radii[d]`. A disc with a height is the tip of a pin, perpendicular to the normal at `positions[d]`; the pin itself is not
    drawn.

    Args:
        positions: centres at rest, `[D, 3]`, length unit.
        radii: radii of the discs, `[D]`, length unit.
        missing: indices of dots that are not painted.
        ink: reflectance of the discs.
        ground: reflectance around them.
        heights: heights above the surface along its inward normal, `[D]`, length unit; None: all dots lie on it.

    Raises:
        MembraneError: radii, reflectances or missing dots are invalid.

    Example:
        >>> Dots(np.zeros((2, 3)), np.array([0.3, 0.5]), missing=[1]).described()
        {'dot_radii': [0.3, 0.5], 'missing': [1], 'ink': 0.12}
    """

    positions: np.ndarray
    radii: np.ndarray
    missing: Sequence[int] = ()
    ink: float = 0.12
    ground: float = 1.0
    heights: np.ndarray | None = None
    cell = 2.0

    def __post_init__(self) -> None:
        object.__setattr__(self, "positions", np.asarray(self.positions, float))
        object.__setattr__(self, "radii", np.asarray(self.radii, float))
        right = self.positions.ndim == 2 and self.positions.shape[1] == 3
        expect(right, "Dots: positions", f"an array {list(self.positions.shape)}", "[D, 3]")
        count = len(self.positions)
        if self.radii.shape != (count,) or not (self.radii > 0).all():
            raise MembraneError(f"Dots: radii {self.radii.tolist()}; expected {count} positive lengths, one for each dot")
        heights = np.zeros(count) if self.heights is None else np.asarray(self.heights, float)
        object.__setattr__(self, "heights", heights)
        right = heights.shape == (count,) and bool(np.isfinite(heights).all())
        expect(right, "Dots: heights", heights.tolist(), f"{count} lengths, one for each dot")
        if not (0 <= self.ink <= 1 and 0 < self.ground <= 1):
            raise MembraneError(f"Dots: ink = {self.ink}, ground = {self.ground}; expected reflectances in 0..1, ground not 0")
        if not all(0 <= d < count for d in self.missing):
            raise MembraneError(f"Dots: missing = {list(self.missing)}; expected numbers of dots, 0 to {count - 1}")

    @classmethod
    @check_arguments
    def from_sensor(cls, sensor: Sensor, radii: Sequence[float] | None = None, missing: Sequence[int] = ()) -> "Dots":
        """Return the dots of a sensor; `radii` are those of small and large dots, default 0.16 and 0.27 of their spacing."""
        positions, sizes = sensor.markers.positions, sensor.markers.sizes
        if positions is None or sizes is None:
            raise MembraneError(f"sensor {sensor.name!r} lists no dots; expected markers.file with their rest positions")
        spacing = (float(sensor.membrane.rest_area.sum()) / len(positions)) ** 0.5
        right = radii is None or len(radii) == len(DOT_RADIUS)
        expect(right, "Dots: radii", radii, f"{len(DOT_RADIUS)} lengths, of {' and '.join(DOT_RADIUS)} dots")
        default = [share * spacing for share in DOT_RADIUS.values()]
        radius = dict(zip(DOT_RADIUS, default if radii is None else radii, strict=True))
        tones = {"dark": (0.12, 1.0), "light": (1.0, 0.2)}[sensor.markers.polarity]
        heights = sensor.markers.heights(len(positions))
        made = cls(positions, np.array([radius[size] for size in sizes]), tuple(missing), *tones, heights)
        if radii is not None:
            _refuse_overlap(made)
        return made

    of = from_sensor  # its name before 0.2.0

    def described(self) -> dict[str, Any]:
        """Return the description of the pattern that a data set's settings store."""
        told = {"dot_radii": sorted(set(self.radii.tolist())), "missing": list(self.missing), "ink": self.ink}
        return told | ({"heights": self.heights.tolist()} if np.any(self.heights) else {})  # type: ignore[union-attr]

    def albedo(self, canvas: Canvas) -> Tensor:
        """Return the reflectance `[V]` of the ground; discs are drawn sample by sample."""
        return torch.full_like(canvas.white, self.ground)


def _refuse_overlap(dots: Dots) -> None:
    if len(dots.positions) < 2:
        return
    distance, other = (np.asarray(found)[:, 1] for found in cKDTree(dots.positions).query(dots.positions, k=2))
    if (over := dots.radii + dots.radii[other] >= distance).any():
        i = int(over.argmax())
        raise MembraneError(
            f"--dots, radii of small and large dots: dots {i} and {other[i]} overlap, {distance[i]:.3g} apart with radii "
            f"{dots.radii[i]:g} and {dots.radii[other[i]]:g}; expected smaller ones"
        )


@check_arguments
@dataclass(frozen=True)
class Speckle:
    """Random grains, reproducible by `seed`.

    The reflectance is a sum of plane waves `cos(k . X + phase)` over rest positions X, of wavelengths 1.4 to 4 grains,
    sharpened by tanh.

    Args:
        size: mean size of a grain, length unit.
        seed: seed of the waves.
        dark: reflectance of the darkest grains.

    Raises:
        MembraneError: the size is not positive.

    Example:
        >>> canvas = Canvas(torch.rand(100, 3), torch.zeros(100, 2), torch.ones(100))
        >>> bool((Speckle(0.1).albedo(canvas) >= 0.15).all())
        True
    """

    size: float
    seed: int = 0
    dark: float = 0.15
    cell = 1.0

    def __post_init__(self) -> None:
        if not self.size > 0:
            raise MembraneError(f"Speckle: size = {self.size}; expected a positive length")

    def albedo(self, canvas: Canvas) -> Tensor:
        """Return the reflectance `[V]`."""
        rng = np.random.default_rng(self.seed)
        direction = rng.normal(size=(WAVES, 3))
        direction /= np.linalg.norm(direction, axis=1, keepdims=True)
        length = self.size * rng.uniform(1.4, 4, (WAVES, 1))
        k = torch.from_numpy(2 * np.pi * direction / length).to(canvas.vertices)
        phase = torch.from_numpy(rng.uniform(0, 2 * np.pi, WAVES)).to(k)
        wave = (canvas.vertices @ k.T + phase).cos().sum(-1) * (2 / WAVES) ** 0.5
        return self.dark + (1 - self.dark) * (1 + torch.tanh(2 * wave)) / 2


@check_arguments
@dataclass(frozen=True, eq=False)
class Painted:
    """The pattern of a rest image, projected onto the rest surface and corrected for the illumination.

    Args:
        image: the rest image, `[height, width]`, grey 0..1.

    Example:
        >>> canvas = Canvas(torch.zeros(2, 3), torch.tensor([[0.0, 0.0], [1.0, 0.0]]), torch.full((2,), 0.5))
        >>> Painted(np.array([[0.25, 0.5]], np.float32)).albedo(canvas).tolist()
        [0.5, 1.0]
    """

    image: np.ndarray
    cell = 1.0

    def described(self) -> dict[str, Any]:
        """Return the description of the pattern that a data set's settings store."""
        return {}

    def albedo(self, canvas: Canvas) -> Tensor:
        """Return the reflectance `[V]`."""
        height, width = self.image.shape
        image = torch.from_numpy(self.image).to(canvas.white)
        place = (2 * canvas.pixels.nan_to_num(-1e3) + 1) / canvas.pixels.new_tensor([width, height]) - 1
        grey = F.grid_sample(image[None, None], place[None, None], align_corners=False, padding_mode="border")
        return (grey[0, 0, 0] / canvas.white.clamp_min(1e-3)).clamp(0, 2)


def pattern_of(sensor: Sensor, radii: Sequence[float] | None = None, missing: Sequence[int] = ()) -> Dots | Painted:
    """Return the pattern of a sensor: its listed dots, or else the pattern in its rest image.

    Args:
        sensor: the sensor.
        radii: radii of small and large dots, length unit; default: 0.16 and 0.27 of their spacing.
        missing: indices of dots that are not painted.

    Raises:
        MembraneError: radii or missing dots are given, but the sensor lists no dots.

    Example:
        >>> from torchmembrane.presets import preset
        >>> type(pattern_of(preset("bubble"))).__name__
        'Dots'
    """
    if sensor.markers.positions is not None:
        return Dots.from_sensor(sensor, radii, missing)
    if radii or len(missing):
        raise MembraneError(f"sensor {sensor.name!r} lists no dots; expected neither radii nor missing dots, or list them")
    if sensor.markers.rest_image is None:
        raise MembraneError(f"sensor {sensor.name!r} has neither listed dots nor a rest image; expected one of them, to paint")
    return Painted(sensor.markers.rest_image)


def inside_unit_disc(place: Tensor, slope: Tensor) -> Tensor:
    """Return the share of each sample that lies within the unit disc, whose outline is approximated as straight.

    Args:
        place: positions of the samples in units of the disc's radius, `[S, 2]`.
        slope: derivatives of the positions in the image, `[S, 2, 2]`.

    Returns:
        Shares in 0..1, `[S]`.

    Example:
        >>> inside_unit_disc(torch.tensor([[0.0, 0.0], [1.0, 0.0], [2.0, 0.0]]), 0.1 * torch.eye(2).expand(3, 2, 2)).tolist()
        [1.0, 0.5, 0.0]
    """
    rho = place.norm(dim=-1).clamp_min(1e-6)
    outward = place / rho[:, None]
    per_sample = (slope[:, 0] * outward[:, :1] + slope[:, 1] * outward[:, 1:]).norm(dim=-1).clamp_min(1e-12)
    return (0.5 + (1 - rho) / per_sample).clamp(0, 1)


def dot_coordinates(
    corners: np.ndarray, positions: np.ndarray, normals: np.ndarray, radii: np.ndarray
) -> tuple[Tensor, Tensor]:
    """Return the triangles that a dot may touch, and their corners in its tangent plane.

    Args:
        corners: corners of the triangles, `[T, 3, 3]`.
        positions: positions of the dots, `[D, 3]`.
        normals: normals at the dots, `[D, 3]`.
        radii: radii of the dots, `[D]`.

    Returns:
        Whether each triangle is touched, `[T]` bool, and the corners of those in units of the dot's radius, `[I, 3, 2]`.
    """
    middle = corners.mean(1)
    reach = np.linalg.norm(corners - middle[:, None], axis=-1).max(1)
    nearest = cKDTree(positions).query(middle, k=min(4, len(positions)))
    distance, dot = (np.asarray(a).reshape(len(middle), -1) for a in nearest)
    best = (distance - radii[dot]).argmin(1)[:, None]
    distance, dot = (np.take_along_axis(a, best, 1)[:, 0] for a in (distance, dot))
    inked = distance < radii[dot] + 2 * reach
    dot = dot[inked]
    normals = normals / np.linalg.norm(normals, axis=1, keepdims=True)
    first = np.cross(normals, np.eye(3)[np.abs(normals).argmin(1)])
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    axes = np.stack([first, np.cross(normals, first)], -1) / radii[:, None, None]
    place = (corners[inked] - positions[dot][:, None]) @ axes[dot]
    return torch.from_numpy(inked), torch.from_numpy(place)
