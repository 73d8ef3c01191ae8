"""How sure a rest surface is: the sensor whose surface has another height over its rim, and what presses tell then.

Dots that were placed from the rest image lie on its rays whatever the surface: they are moved along these. What the image
leaves open is mostly one number, how high the surface stands over its rim.
"""

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import torch

from ..errors import MembraneError, expect
from ..sensor.inflated import InflatedSurface
from ..sensor.parts import Markers, Surface
from ..sensor.sensor import Sensor
from ..surface.membrane import Membrane
from ..surface.topology import rim_loop

HEIGHT_ERROR = 0.05
"""Standard deviation of the rest surface's height over its rim, relative, where nothing is said of it."""
MOST_ERROR = 0.5
LEAST_HEIGHT_ERROR = 0.03
"""Standard deviation of the height that presses tell, relative, however little noise there is: the grid's and the model's."""
SETTLED = 1.0  # of its standard deviation that the height may still change by
LEAST_REACH, LOWEST = 0.1, 0.5  # of a step of the height, in stated standard deviations; of a height over the one before
SHRINKING = 0.6  # of the reach from one round to the next, at least
MOST_SHIFT = 3.0  # of the prestretch by the height, in standard deviations by the losses: beyond, a loss is no parabola


@dataclass(frozen=True, eq=False)
class _Scaled(Surface):
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


def at_other_height(sensor: Sensor, positions: np.ndarray, share: float) -> tuple[Sensor, np.ndarray]:
    """The sensor with a rest surface that is lower above its rim by a share, and markers where their rays meet it.

    A surface that folds when it is lowered is raised instead; all effects of the small change then have the opposite sign.

    Args:
        sensor: any.
        positions: `[D, 3]` of its markers.
        share: share of the height.

    Returns:
        The sensor, without a rest image, and which markers it has, `[D]` bool: the rays of the others miss the surface.

    Raises:
        MembraneError: the surface folds either way.
    """
    right = 0 < share <= MOST_ERROR
    expect(right, "calibrate material: rest error", share, f"more than 0, at most {MOST_ERROR:g}, of the height")
    for change in (-share, share):
        try:
            return changed_height(sensor, positions, change)
        except MembraneError as error:
            refused = error
    raise MembraneError(
        f"calibrate material: with its height changed by {share:g} the rest surface folds ({refused}); expected a smaller "
        "--rest-error, or a surface that the camera sees at less of a slant"
    )


def changed_height(sensor: Sensor, positions: np.ndarray, share: float) -> tuple[Sensor, np.ndarray]:
    """The sensor whose rest surface is higher over its rim by a share, else as of `at_other_height`."""
    surface = sensor.surface
    if isinstance(surface, InflatedSurface):
        surface = surface.of_height((1 + share) * surface.formed.height)
    else:
        surface = _Scaled(surface.shape, surface.values, share)
    membrane = surface.membrane(sensor.membrane.grid)
    rays = sensor.camera.pixel_to_ray(sensor.camera.point_to_pixel(torch.from_numpy(positions)))
    origins, directions = rays.origin.numpy(), rays.direction.numpy()
    before, after = (surface.ray_points(origins, directions).distance for surface in (sensor.membrane, membrane))
    moved = after - before  # of facets on the same grid: a marker that is off its facet stays so
    kept = np.isfinite(moved)
    markers = Markers("dots", positions=(positions + moved[:, None] * directions)[kept])
    return replace(sensor, surface=surface, membrane=membrane, markers=markers), kept


class HeightEffect(NamedTuple):
    """What presses tell otherwise where the rest surface has another height, by one standard deviation of it.

    Attributes:
        shift: shift of the logarithm of the prestretch that they tell.
        by_stretch: change of the forces' logarithm with one standard deviation of the prestretch, in the mean.
        by_height: with the height.
        mean: mean of the height, by what was stated of it and what the presses tell, in stated standard deviations.
        deviation: deviation of the height, in stated ones.
    """

    shift: float
    by_stretch: float
    by_height: float
    mean: float = 0.0
    deviation: float = 1.0


class PressesTold(NamedTuple):
    """What presses tell at some prestretches, one standard deviation from the best and there: their loss in sum, `[S]`, and the
    magnitudes of the forces found, `[S, B]`."""

    losses: np.ndarray
    forces: np.ndarray


def height_effect(own: PressesTold, other: PressesTold, step: float, variance: float) -> HeightEffect:
    """From what presses tell on both surfaces.

    Near its minimum the loss is a parabola over the prestretch's logarithm, of curvature 1 / variance; a slope `k` that the
    height adds to it moves the minimum by `-k variance`.

    Args:
        own: on the sensor's surface.
        other: on that of another height.
        step: step of the prestretch's logarithm.
        variance: variance of the prestretch's logarithm by the presses' losses.
    """
    added = other.losses - own.losses
    bound = MOST_SHIFT * variance**0.5
    shift = float(np.clip(-variance * (added[2] - added[0]) / (2 * step), -bound, bound))
    low, middle, high = np.log(own.forces).mean(1)
    return HeightEffect(shift, float(high - low) / 2, float(np.log(other.forces[1]).mean() - middle))


class StatedHeight(NamedTuple):
    """What is said of the height of a rest surface over its rim.

    Attributes:
        error: standard deviation of what was stated, over the surface's height.
        mean: what was stated, above the surface's height, in these.
        reach: how far to either side the height's effect is looked at, in these.
    """

    error: float
    mean: float = 0.0
    reach: float = 1.0

    def after(self, height: float, deviation: float) -> "StatedHeight":
        """The same about the surface that is higher by `height`, which is known to `deviation`, in stated standard deviations.

        Example:
            >>> StatedHeight(0.25).after(1.0, 0.2)
            StatedHeight(error=0.2, mean=-1.0, reach=0.4)
        """
        error = self.error / max(LOWEST, 1 + self.error * height)
        return StatedHeight(error, self.mean - height, float(np.clip(2 * deviation, LEAST_REACH, SHRINKING * self.reach)))

    def is_settled(self, height: float, deviation: float) -> bool:
        """Whether a height found, known to `deviation`, is about the surface's, and was looked for about as closely."""
        return abs(height) <= SETTLED * deviation and self.reach <= max(LEAST_REACH, 4 * deviation)


def height_told(
    own: PressesTold, lower: PressesTold, higher: PressesTold, step: float, variance: float, stated: StatedHeight
) -> HeightEffect:
    """What presses tell of the height `h` itself, and otherwise with it, where it can be changed both ways; all at two
    prestretches, one step below and above the lowest loss.

    Near its minimum over the prestretch's logarithm `z` the loss is a parabola in both,
    `z^2 / (2 variance) + k z h + g h + c h^2 / 2`; least over `z` it is `g h + (c - k^2 variance) h^2 / 2`. What was stated
    adds `(h - mean)^2 / 2`.

    Args:
        own: on the sensor's surface.
        lower: on one that is lower by `stated.reach` standard deviations.
        higher: on one that is as much higher.
        step: step of the prestretch's logarithm.
        variance: variance of the prestretch's logarithm by the presses' losses.
        stated: stated deviation of the height.
    """
    d = stated.reach
    slope = (higher.losses - lower.losses) / (2 * d)
    bent = (higher.losses - 2 * own.losses + lower.losses).mean() / d**2
    k, bound = (slope[1] - slope[0]) / (2 * step), MOST_SHIFT * variance**0.5
    information = max(0.0, bent - k**2 * variance)
    share = 1 / (1 + information * (LEAST_HEIGHT_ERROR / stated.error) ** 2)
    information, gradient = share * information, share * slope.mean()
    mean = np.clip((stated.mean - gradient) / (1 + information), -d, d)
    return HeightEffect(
        shift=float(np.clip(-variance * k, -bound, bound)),
        by_stretch=float(np.log(own.forces[1] / own.forces[0]).mean()) / 2,
        by_height=float(np.log(higher.forces / lower.forces).mean()) / (2 * d),
        mean=float(mean),
        deviation=float(1 + information) ** -0.5,
    )
