"""Inference of the prestretch, and of the rest surface's height, from the shapes of presses.

The loss of the presses depends on the prestretch and on the rest surface's height. For an inflated surface, whose height is one
number, the height of least loss is found iteratively. Any other surface keeps its height, and only the effect of another height
is computed.
"""

from dataclasses import replace
from typing import NamedTuple

import numpy as np
import torch
from scipy.interpolate import PchipInterpolator
from torch import Tensor

from ..errors import MembraneError, expect
from ..progress import Progress, within
from ..reconstruct import Reconstructor
from ..sensor.inflated import InflatedSurface
from ..sensor.sensor import Sensor
from .known_modulus import KnownForces, KnownPressures, modulus_at_rest
from .presses import STRETCHES, LossProfile, Presses
from .rest_error import HeightEffect, PressesTold, StatedHeight, changed_height, height_effect, height_told

GRID = (17, 17)  # on finer grids the loss is less smooth in the prestretch
PRESTRETCH_ERROR = 0.03  # relative standard deviation due to the grid and the loss, common to all images
PRESTRETCH_ERROR_INFLATED = 0.02  # the same if the rest surface's height is estimated as well
UNKNOWN = float(np.log(STRETCHES[-1] / STRETCHES[0])) / 12**0.5  # standard deviation of a uniform log prestretch
WRONG = 0.02  # probability that an image is explained wrongly and carries no information
HEIGHT_ROUNDS = 4
RANGE, NEAR = 3.0, 7  # half width of the refined search, standard deviations, and its number of prestretches
FINE = 4001  # number of prestretches over which probabilities are summed
HEIGHT_SHARE = 0.15  # share of the time that losses at another height of the rest surface take, measured


class MeasuredPresses(NamedTuple):
    """Measurements of presses: the markers' displacement `[B, D, 2]` px and confidence `[B, D]`; forces and pressures as for
    `material_from_pixels`; the gauge's reading at rest, hPa; the prior of the rest surface's height; the displacements'
    covariance `[B, D, 2, 2]`, px^2 (default: twice the rest image's)."""

    displacement: Tensor
    confidence: Tensor
    forces: KnownForces | None
    pressures: KnownPressures | None
    overpressure: float | None
    height: StatedHeight
    covariance: Tensor | None = None

    @property
    def tells_modulus(self) -> bool:
        """Whether forces or pressures are known, so that the modulus can be inferred."""
        return any(given is not None for given in (self.forces, self.pressures, self.overpressure))


class ByShapes(NamedTuple):
    """The logarithm of the prestretch inferred from the shapes of presses: its mean and standard deviation, the standard
    deviation due to the losses alone, and mean and variance from each image alone, `[B]`."""

    mean: float
    deviation: float
    by_losses: float
    each: np.ndarray
    variances: np.ndarray

    @property
    def around(self) -> np.ndarray:
        """The mean log prestretch minus one standard deviation, the mean, and plus one, `[3]`."""
        found: np.ndarray = self.mean + self.deviation * np.array([-1.0, 0.0, 1.0])
        return found

    @property
    def near(self) -> np.ndarray:
        """Closely spaced prestretches around the mean, `[S]`."""
        found: np.ndarray = np.exp(self.mean + RANGE * self.deviation * np.linspace(-1, 1, NEAR)).clip(*STRETCHES[[0, -1]])
        return np.unique(found)


def by_shapes(profile: LossProfile, shared_error: float = PRESTRETCH_ERROR) -> ByShapes:
    """Infer the prestretch from the losses of all images, and of each image alone.

    Args:
        profile: the losses.
        shared_error: relative standard deviation of the error of the prestretch that is common to all images.
    """
    each, own = np.array([_log_stretch(profile.stretches, losses[:, None]) for losses in profile.losses.T]).T
    mean, by_losses = _log_stretch(profile.stretches, profile.losses)
    variances = own**2 + shared_error**2
    contradiction = ((each - mean) ** 2 / variances).sum() / max(len(each) - 1, 1)
    deviation = min(float(np.hypot(by_losses * np.sqrt(max(1.0, contradiction)), shared_error)), UNKNOWN)
    return ByShapes(mean, deviation, by_losses, each, variances)


class ExplainedPresses(NamedTuple):
    """The solutions of the presses at one height of the rest surface.

    Attributes:
        sensor: the sensor with this surface and the presses' markers.
        presses: the presses on this surface.
        other: the presses on a surface of another height.
        profile: losses of the presses by prestretch.
        shapes: the prestretch inferred from these losses.
        by: the inferred height, and the effect of the height on prestretch and forces.
        height: the height as stated beforehand.
    """

    sensor: Sensor
    presses: Presses
    other: Presses
    profile: LossProfile
    shapes: ByShapes
    by: HeightEffect
    height: StatedHeight

    def raised(self, sensor: Sensor, height: float) -> tuple[Sensor, np.ndarray]:
        """Raise the rest surface of a sensor.

        Args:
            sensor: a sensor whose rest surface has the current height.
            height: increase of the height, in stated standard deviations.

        Returns:
            The sensor, and the mask of the markers that it still has, `[D]` bool.
        """
        share = self.height.error / self.height.after(height, 1.0).error - 1
        return changed_height(sensor, self.presses.rest_markers, share)


def explained(sensor: Sensor, reconstructor: Reconstructor, known: MeasuredPresses, progress: Progress) -> ExplainedPresses:
    """Solve the presses on the sensor's rest surface; for an inflated surface, at the height inferred from the presses.

    Args:
        sensor: the sensor before this calibration.
        reconstructor: the sensor's reconstructor on the grid for calibration.
        known: the measurements of the presses.
        progress: called with the completed share.
    """
    presses = Presses(reconstructor, known.displacement, known.confidence, known.covariance)
    if isinstance(sensor.surface, InflatedSurface):
        return _at_told_height(sensor, presses, known, progress)
    shapes = by_shapes(profile := presses.profile(within(progress, 0.0, 1 - HEIGHT_SHARE)))
    progress(1 - HEIGHT_SHARE, "prestretch with the rest surface's error")
    other = presses.at_other_height(known.height.error)
    by = height_effect(presses.told(shapes.around), other.told(shapes.around), shapes.deviation, shapes.by_losses**2)
    return ExplainedPresses(sensor, presses, other, profile, shapes, by, known.height)


def _at_told_height(sensor: Sensor, presses: Presses, known: MeasuredPresses, progress: Progress) -> ExplainedPresses:
    """Iterate over the height: each round uses the height and the prestretch inferred in the round before."""
    stretches, height, is_close = STRETCHES, known.height, False
    for k in range(HEIGHT_ROUNDS):
        of_round = within(progress, k / HEIGHT_ROUNDS, (k + 1) / HEIGHT_ROUNDS)
        profile = presses.profile_at(stretches, within(of_round, 0.0, 1 - HEIGHT_SHARE))
        shapes = by_shapes(profile, PRESTRETCH_ERROR_INFLATED)
        of_round(1 - HEIGHT_SHARE, "prestretch at other heights of the rest surface")
        lower, higher = (presses.at_height(side * height.reach * height.error) for side in (-1, 1))
        own, below, above = (each.told(shapes.around[::2]) for each in (presses, lower, higher))
        by = height_told(own, below, above, shapes.deviation, shapes.by_losses**2, height)
        found = ExplainedPresses(sensor, presses, higher, profile, shapes, by, height)
        if k + 1 == HEIGHT_ROUNDS or (is_close and height.is_settled(by.mean, by.deviation)):
            break
        values = [np.exp(shapes.mean + by.shift * by.mean), *_modulus(found, own, known)]
        sensor, kept = found.raised(with_material(sensor, np.array(values)), by.mean)
        presses = Presses(coarse_reconstructor(sensor), *(a[:, kept] for a in presses.measured))
        is_close = abs(by.mean) < height.reach
        stretches, height = shapes.near if is_close else STRETCHES, height.after(by.mean, by.deviation)
    return found


def _modulus(found: ExplainedPresses, own: PressesTold, known: MeasuredPresses) -> list[float]:
    """Return a rough modulus if forces or the gauge at rest determine it; with a gas in the cavity, the shapes depend on it."""
    sensor, shapes = found.sensor, found.shapes
    if known.overpressure is not None:
        return [modulus_at_rest(sensor, shapes.mean, shapes.deviation, known.overpressure).modulus]
    if known.forces is not None:
        ratios = np.linalg.norm(known.forces.forces, axis=1) / np.sqrt(own.forces.prod(0))
        return [float(sensor.material.modulus * np.nanmean(ratios))]
    return []


def with_material(sensor: Sensor, values: np.ndarray) -> Sensor:
    """Return the sensor with the prestretch `values[0]` and, if there is a second value, the modulus `values[1]`."""
    material = replace(sensor.material, prestretch=max(1.0, float(values[0])))
    if len(values) > 1:
        thickness = material.thickness or 1.0
        material = replace(material, shear_modulus=float(values[1]) / thickness, thickness=thickness)
    return replace(sensor, material=material)


def coarse_reconstructor(sensor: Sensor) -> Reconstructor:
    """Return the sensor's reconstructor on `GRID`; raise an error if presses cannot determine the prestretch."""
    views = max(1, len(sensor.views))
    expect(views == 1, "calibrate material: views", views, "1: calibrate sensor.in_view(0), the first view by itself")
    sensor.refuse_heights("calibrate material")
    if sensor.material.model == "harmonic":
        raise MembraneError(
            "calibrate material: the shape of a harmonic membrane does not depend on the prestretch; expected neo_hookean or "
            "mooney_rivlin"
        )
    return Reconstructor(replace(sensor, membrane=sensor.surface.membrane(GRID)), dtype=torch.float64)


def _log_stretch(stretches: np.ndarray, losses: np.ndarray) -> tuple[float, float]:
    """Return mean and standard deviation of the logarithm of the prestretch, from losses `[S, B]` at `stretches [S]`."""
    z = np.log(stretches)
    fine = np.linspace(z[0], z[-1], FINE)
    loss = PchipInterpolator(z, losses)(fine)
    alone = np.exp(loss.min(0) - loss)
    weight = (WRONG + (1 - WRONG) * alone / alone.mean(0)).prod(1)
    mean = (weight * fine).sum() / weight.sum()
    return mean, np.sqrt((weight * (fine - mean) ** 2).sum() / weight.sum())
