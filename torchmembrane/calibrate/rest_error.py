"""Uncertainty of the rest surface: the sensor with another height of its surface, and the effect on inferences from presses.

Dots that were placed from the rest image lie on its rays whatever the surface is, so they are moved along these rays. A rest
image leaves mainly one number undetermined, the height of the surface over its rim.
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
"""Default relative standard deviation of the rest surface's height over its rim."""
MOST_ERROR = 0.5
LEAST_HEIGHT_ERROR = 0.03
"""Smallest relative standard deviation of a height inferred from presses, due to the grid and the model."""
SETTLED = 1.0  # largest last change of the height, over its standard deviation
LEAST_REACH, LOWEST = 0.1, 0.5  # smallest step of the height, in stated standard deviations; smallest ratio of heights
SHRINKING = 0.6  # largest ratio of the reach from one round to the next
MOST_SHIFT = 3.0  # largest shift of the prestretch by the height, standard deviations: beyond, the loss is not a parabola


@dataclass(frozen=True, eq=False)
class _Scaled(Surface):
    """A surface whose heights over its rim's plane are scaled by `1 + share`."""

    share: float = 0.0

    def membrane(self, grid: tuple[int, int]) -> Membrane:
        """Return the surface on a solver grid; see `Surface.membrane`."""
        membrane = super().membrane(grid)
        x, fixed = (a.unflatten(0, grid).numpy() for a in (membrane.rest, membrane.fixed))
        rim = membrane.rest.numpy()[rim_loop(grid)]
        centre = rim.mean(0)
        normal = np.linalg.svd(rim - centre)[2][2]
        return Membrane(x + self.share * ((x - centre) @ normal)[..., None] * normal, fixed)


def at_other_height(sensor: Sensor, positions: np.ndarray, share: float) -> tuple[Sensor, np.ndarray]:
    """Lower the rest surface of a sensor by a share of its height over the rim, and move the markers along their rays.

    A surface that would fold when lowered is raised instead; all effects of the small change then have the opposite sign.

    Args:
        sensor: the sensor.
        positions: positions of its markers, `[D, 3]`.
        share: relative change of the height.

    Returns:
        The sensor, without a rest image, and the mask of the markers kept, `[D]` bool; rays of the others miss the surface.

    Raises:
        MembraneError: the surface folds either way.
    """
    right = 0 < share <= MOST_ERROR
    expect(right, "calibrate material: rest error", share, f"a share of the height, more than 0 and at most {MOST_ERROR:g}")
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
    """Return a sensor whose rest surface is `1 + share` times as high over its rim, and the mask `[D]` of the markers kept.

    The markers move along their rays. A negative share lowers the surface. Unlike `at_other_height`, this function does not try
    the other direction.

    Raises:
        MembraneError: the surface folds.
    """
    surface = sensor.surface
    if isinstance(surface, InflatedSurface):
        surface = surface.of_height((1 + share) * surface.formed.height)
    else:
        surface = _Scaled(surface.shape, surface.values, share)
    membrane = surface.membrane(sensor.membrane.grid)
    rays = sensor.camera.pixel_to_ray(sensor.camera.point_to_pixel(torch.from_numpy(positions)))
    origins, directions = rays.origin.numpy(), rays.direction.numpy()
    before, after = (surface.ray_points(origins, directions).distance for surface in (sensor.membrane, membrane))
    moved = after - before  # between facets of the same grid: a marker keeps its distance from the facet
    kept = np.isfinite(moved)
    markers = Markers("dots", positions=(positions + moved[:, None] * directions)[kept])
    return replace(sensor, surface=surface, membrane=membrane, markers=markers), kept


class HeightEffect(NamedTuple):
    """Effect of one standard deviation of the rest surface's height on inferences from presses.

    Attributes:
        shift: change of the inferred logarithm of the prestretch.
        by_stretch: mean change of the forces' logarithm for one standard deviation of the prestretch.
        by_height: mean change of the forces' logarithm for one standard deviation of the height.
        mean: mean of the height given the stated value and the presses, in stated standard deviations.
        deviation: standard deviation of the height given both, in stated standard deviations.
    """

    shift: float
    by_stretch: float
    by_height: float
    mean: float = 0.0
    deviation: float = 1.0


class PressesTold(NamedTuple):
    """Results of presses at S prestretches, up to one standard deviation from the best one: the sum of their losses, `[S]`, and
    the magnitudes of reconstructed forces, `[S, B]`."""

    losses: np.ndarray
    forces: np.ndarray


def height_effect(own: PressesTold, other: PressesTold, step: float, variance: float) -> HeightEffect:
    """Compute the effect of the height from the presses on two surfaces.

    Near its minimum, the loss is a parabola over the prestretch's logarithm with curvature 1 / variance. A slope `k` that the
    height adds to the loss moves the minimum by `-k variance`.

    Args:
        own: results on the sensor's surface.
        other: results on the surface of another height.
        step: step of the prestretch's logarithm.
        variance: variance of the prestretch's logarithm according to the presses' losses.
    """
    added = other.losses - own.losses
    bound = MOST_SHIFT * variance**0.5
    shift = float(np.clip(-variance * (added[2] - added[0]) / (2 * step), -bound, bound))
    low, middle, high = np.log(own.forces).mean(1)
    return HeightEffect(shift, float(high - low) / 2, float(np.log(other.forces[1]).mean() - middle))


class StatedHeight(NamedTuple):
    """The prior of the height of a rest surface over its rim.

    Attributes:
        error: standard deviation of the stated height, relative to the surface's height.
        mean: stated height minus the surface's height, in standard deviations.
        reach: change of the height, up and down, from which the height's effect is computed, in standard deviations.
    """

    error: float
    mean: float = 0.0
    reach: float = 1.0

    def after(self, height: float, deviation: float) -> "StatedHeight":
        """Return the prior relative to a surface higher by `height`, known to `deviation`; both in stated standard deviations.

        Example:
            >>> StatedHeight(0.25).after(1.0, 0.2)
            StatedHeight(error=0.2, mean=-1.0, reach=0.4)
        """
        error = self.error / max(LOWEST, 1 + self.error * height)
        return StatedHeight(error, self.mean - height, float(np.clip(2 * deviation, LEAST_REACH, SHRINKING * self.reach)))

    def is_settled(self, height: float, deviation: float) -> bool:
        """Return whether the inferred height, known to `deviation`, is close to the surface's and the reach is small enough."""
        return abs(height) <= SETTLED * deviation and self.reach <= max(LEAST_REACH, 4 * deviation)


def height_told(
    own: PressesTold, lower: PressesTold, higher: PressesTold, step: float, variance: float, stated: StatedHeight
) -> HeightEffect:
    """Infer the height `h` from presses on three surfaces, and its effect on other inferences.

    All results are at two prestretches, one step below and one step above the lowest loss.

    Near its minimum, the loss is quadratic in the logarithm `z` of the prestretch and in the height `h`,
    `z^2 / (2 variance) + k z h + g h + c h^2 / 2`; its minimum over `z` is `g h + (c - k^2 variance) h^2 / 2`. The prior adds
    `(h - mean)^2 / 2`.

    Args:
        own: results on the sensor's surface.
        lower: results on a surface lower by `stated.reach` standard deviations.
        higher: results on a surface higher by as much.
        step: step of the prestretch's logarithm.
        variance: variance of the prestretch's logarithm according to the presses' losses.
        stated: prior of the height.
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
