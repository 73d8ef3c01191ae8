"""What is painted on the material: dots, speckle, or what a rest image shows. It moves with the membrane."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from ..errors import MembraneError
from ..sensor.sensor import Sensor

DOT_RADIUS = {"small": 0.16, "large": 0.27}  # over the dots' spacing
WAVES = 96  # of a speckle


class Canvas(NamedTuple):
    """The rest surface as it is painted on: `vertices [V, 3]`, their `pixels [V, 2]`, the grey of `white` there `[V]`."""

    vertices: Tensor
    pixels: Tensor
    white: Tensor


@dataclass(frozen=True, eq=False)
class Dots:
    """Discs of `ink` on a ground, both as reflectances in 0..1.

    A disc is all material whose rest distance from `positions[d]`, in the tangent plane there, is at most `radii[d]`.

    positions: `[D, 3]` at rest; radii: `[D]`, length unit; missing: dots that are not painted; ground: around them.
    """

    positions: np.ndarray
    radii: np.ndarray
    missing: Sequence[int] = ()
    ink: float = 0.12
    ground: float = 1.0
    cell = 2.0

    def __post_init__(self):
        object.__setattr__(self, "positions", np.asarray(self.positions, float))
        object.__setattr__(self, "radii", np.asarray(self.radii, float))
        count = len(self.positions)
        if self.radii.shape != (count,) or not (self.radii > 0).all():
            raise MembraneError(f"Dots: radii {self.radii.tolist()}; expected {count} positive lengths, one for each dot")
        if not (0 <= self.ink <= 1 and 0 < self.ground <= 1):
            raise MembraneError(f"Dots: ink = {self.ink}, ground = {self.ground}; expected reflectances in 0..1, ground not 0")
        if not all(0 <= d < count for d in self.missing):
            raise MembraneError(f"Dots: missing = {list(self.missing)}; expected numbers of dots, 0 to {count - 1}")

    @classmethod
    def of(cls, sensor: Sensor, radii: tuple[float, float] | None = None, missing: Sequence[int] = ()) -> "Dots":
        """The dots that a sensor lists; `radii` of small and large ones, default 0.16 and 0.27 of their spacing."""
        positions, sizes = sensor.markers.positions, sensor.markers.sizes
        spacing = (float(sensor.membrane.rest_area.sum()) / len(positions)) ** 0.5
        default = [share * spacing for share in DOT_RADIUS.values()]
        radius = dict(zip(DOT_RADIUS, radii or default, strict=True))
        tones = {"dark": (0.12, 1.0), "light": (1.0, 0.2)}[sensor.markers.polarity]
        return cls(positions, [radius[size] for size in sizes], tuple(missing), *tones)

    def described(self) -> dict:
        return {"dot_radii": sorted(set(self.radii.tolist())), "missing": list(self.missing), "ink": self.ink}

    def albedo(self, canvas: Canvas) -> Tensor:
        return torch.full_like(canvas.white, self.ground)


@dataclass(frozen=True)
class Speckle:
    """Random grains of a mean `size` (length unit), the same for the same `seed`.

    The sum of plane waves `cos(k . X + phase)` over rest positions X, 1.4 to 4 grains long, made steeper by tanh.
    """

    size: float
    seed: int = 0
    dark: float = 0.15
    cell = 1.0

    def __post_init__(self):
        if not self.size > 0:
            raise MembraneError(f"Speckle: size = {self.size}; expected a positive length")

    def albedo(self, canvas: Canvas) -> Tensor:
        rng = np.random.default_rng(self.seed)
        direction = rng.normal(size=(WAVES, 3))
        direction /= np.linalg.norm(direction, axis=1, keepdims=True)
        length = self.size * rng.uniform(1.4, 4, (WAVES, 1))
        k = torch.from_numpy(2 * np.pi * direction / length).to(canvas.vertices)
        phase = torch.from_numpy(rng.uniform(0, 2 * np.pi, WAVES)).to(k)
        wave = (canvas.vertices @ k.T + phase).cos().sum(-1) * (2 / WAVES) ** 0.5
        return self.dark + (1 - self.dark) * (1 + torch.tanh(2 * wave)) / 2


@dataclass(frozen=True, eq=False)
class Painted:
    """What a rest image `[height, width]` shows, taken onto the rest surface and freed of the light that falls on it."""

    image: np.ndarray
    cell = 1.0

    def described(self) -> dict:
        return {}

    def albedo(self, canvas: Canvas) -> Tensor:
        height, width = self.image.shape
        image = torch.from_numpy(self.image).to(canvas.white)
        place = (2 * canvas.pixels.nan_to_num(-1e3) + 1) / canvas.pixels.new_tensor([width, height]) - 1
        grey = F.grid_sample(image[None, None], place[None, None], align_corners=False, padding_mode="border")
        return (grey[0, 0, 0] / canvas.white.clamp_min(1e-3)).clamp(0, 2)


def pattern_of(sensor: Sensor, radii: tuple[float, float] | None = None, missing: Sequence[int] = ()) -> Dots | Painted:
    """A sensor's markers: the dots that it lists, else what its rest image shows."""
    if sensor.markers.positions is not None:
        return Dots.of(sensor, radii, missing)
    if radii or len(missing):
        raise MembraneError(f"sensor {sensor.name!r} lists no dots; expected neither radii nor missing dots, or list them")
    return Painted(sensor.markers.rest_image)
