"""How sure a rest surface is: the sensor whose surface is higher over its rim, and what that does to what presses tell.

Dots that were placed from the rest image lie on its rays whatever the surface: they are moved along these. What the image
leaves open is mostly one number, how high the surface stands over its rim.
"""

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import torch

from ..errors import expect
from ..sensor.inflated import InflatedSurface
from ..sensor.parts import Markers, Surface
from ..sensor.sensor import Sensor
from ..surface.membrane import Membrane
from ..surface.topology import rim_loop
from .surface import FINE

HEIGHT_ERROR = 0.05
"""Standard deviation of the rest surface's height over its rim, relative, where nothing is said of it."""
MOST_ERROR = 0.5
MOST_SHIFT = 3.0  # of the prestretch by the height, in standard deviations by the losses: beyond, a loss is no parabola


@dataclass(frozen=True, eq=False)
class _Raised(Surface):
    """A surface whose heights over its rim's plane are larger by a share."""

    share: float = 0.0

    def membrane(self, grid: tuple[int, int]) -> Membrane:
        """On a solver grid; see `Surface.membrane`."""
        membrane = super().membrane(grid)
        x, fixed = (a.unflatten(0, grid).numpy() for a in (membrane.rest, membrane.fixed))
        rim = membrane.rest.numpy()[rim_loop(grid)]
        centre = rim.mean(0)
        normal = np.linalg.svd(rim - centre)[2][2]
        return Membrane(x + self.share * ((x - centre) @ normal)[..., None] * normal, fixed)


def raised(sensor: Sensor, positions: np.ndarray, share: float) -> tuple[Sensor, np.ndarray]:
    """The sensor whose rest surface is higher over its rim by a share, its markers where their rays meet it.

    Args:
        sensor: any.
        positions: `[D, 3]` of its markers.
        share: of the height.

    Returns:
        The sensor, without a rest image, and which markers it has, `[D]` bool: the rays of others miss the surface.
    """
    expect(
        0 < share <= MOST_ERROR, "calibrate material: rest error", share, f"more than 0, at most {MOST_ERROR:g} of the height"
    )
    surface = sensor.surface
    if isinstance(surface, InflatedSurface):
        surface = surface.of_height((1 + share) * surface.formed.height)
    else:
        surface = _Raised(surface.shape, surface.values, share)
    rays = sensor.camera.pixel_to_ray(sensor.camera.point_to_pixel(torch.from_numpy(positions)))
    origins, directions = rays.origin.numpy(), rays.direction.numpy()
    distance = surface.membrane((FINE, FINE)).ray_points(origins, directions).distance
    kept = np.isfinite(distance)
    markers = Markers("dots", positions=(origins + distance[:, None] * directions)[kept])
    moved = replace(sensor, surface=surface, membrane=surface.membrane(sensor.membrane.grid), markers=markers)
    return moved, kept


class HeightEffect(NamedTuple):
    """What presses tell otherwise where the rest surface is higher.

    Attributes:
        shift: of the logarithm of the prestretch that they tell.
        by_stretch: change of the forces' logarithm with one standard deviation of the prestretch, in the mean.
        by_height: with the height.
    """

    shift: float
    by_stretch: float
    by_height: float


class PressesTold(NamedTuple):
    """What presses tell at three prestretches, one standard deviation apart: their loss in sum, `[3]`, and the magnitudes of
    the forces found, `[3, B]`."""

    losses: np.ndarray
    forces: np.ndarray


def height_effect(own: PressesTold, higher: PressesTold, step: float, variance: float) -> HeightEffect:
    """From what presses tell on both surfaces.

    Near its minimum the loss is a parabola over the prestretch's logarithm, of curvature 1 / variance; a slope `k` that the
    height adds to it moves the minimum by `-k variance`.

    Args:
        own: on the sensor's surface.
        higher: on the surface raised by one standard deviation.
        step: of the prestretch's logarithm.
        variance: of the prestretch's logarithm by the presses' losses.
    """
    added = higher.losses - own.losses
    bound = MOST_SHIFT * variance**0.5
    shift = float(np.clip(-variance * (added[2] - added[0]) / (2 * step), -bound, bound))
    low, middle, high = np.log(own.forces).mean(1)
    return HeightEffect(shift, float(high - low) / 2, float(np.log(higher.forces[1]).mean() - middle))
