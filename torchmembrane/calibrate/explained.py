"""Presses explained: what their shapes say of the prestretch, at the height of the rest surface that they tell.

The loss of the presses changes with the prestretch and with the rest surface's height. Of an inflated surface, whose height
is one number, the height of the least loss is looked for in rounds; any other surface keeps its own, and only the effect of
another height is found.
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
PRESTRETCH_ERROR = 0.03  # of an estimate, relative: the grid's and the loss's, alike in all images
PRESTRETCH_ERROR_INFLATED = 0.02  # the same where the rest surface's height is found with it
UNKNOWN = float(np.log(STRETCHES[-1] / STRETCHES[0])) / 12**0.5  # of the logarithm of a prestretch that may be any of those
WRONG = 0.02  # probability that an image is explained wrongly altogether and carries no information
HEIGHT_ROUNDS = 4
RANGE, NEAR = 3.0, 7  # standard deviations to either side in which the prestretch is looked for again; how many are tried
FINE = 4001  # prestretches over which the probability is summed
HEIGHT_SHARE = 0.15  # of the time, measured: the losses on a rest surface of another height


class MeasuredPresses(NamedTuple):
    """What is known of presses: the markers' displacement `[B, D, 2]` px and confidence `[B, D]`, forces or pressures as of
    `material_from_pixels`, the rest surface's height, the displacements' covariance (default: the rest image's)."""

    displacement: Tensor
    confidence: Tensor
    forces: KnownForces | None
    pressures: KnownPressures | None
    overpressure: float | None
    height: StatedHeight
    covariance: Tensor | None = None

    @property
    def tells_modulus(self) -> bool:
        """Whether anything but the shapes is known."""
        return any(given is not None for given in (self.forces, self.pressures, self.overpressure))


class ByShapes(NamedTuple):
    """What the presses' shapes say of the logarithm of the prestretch: its mean and standard deviation, that of the losses
    alone, and mean and variance by each image `[B]`."""

    mean: float
    deviation: float
    by_losses: float
    each: np.ndarray
    variances: np.ndarray

    @property
    def around(self) -> np.ndarray:
        """One deviation below, the mean, and one above, `[3]`."""
        found: np.ndarray = self.mean + self.deviation * np.array([-1.0, 0.0, 1.0])
        return found

    @property
    def near(self) -> np.ndarray:
        """Prestretches close together about the mean, `[S]`."""
        found: np.ndarray = np.exp(self.mean + RANGE * self.deviation * np.linspace(-1, 1, NEAR)).clip(*STRETCHES[[0, -1]])
        return np.unique(found)


def by_shapes(profile: LossProfile, shared_error: float = PRESTRETCH_ERROR) -> ByShapes:
    """The presses' losses as probabilities: of all, and of each image.

    Args:
        profile: the losses.
        shared_error: relative standard deviation of the prestretch that all images have in common.
    """
    each, own = np.array([_log_stretch(profile.stretches, losses[:, None]) for losses in profile.losses.T]).T
    mean, by_losses = _log_stretch(profile.stretches, profile.losses)
    variances = own**2 + shared_error**2
    contradiction = ((each - mean) ** 2 / variances).sum() / max(len(each) - 1, 1)
    deviation = min(float(np.hypot(by_losses * np.sqrt(max(1.0, contradiction)), shared_error)), UNKNOWN)
    return ByShapes(mean, deviation, by_losses, each, variances)


class ExplainedPresses(NamedTuple):
    """Presses as explained at one height of the rest surface.

    Attributes:
        sensor: with this surface and the presses' markers.
        presses: on it.
        other: on a surface of another height, one `height.reach`.
        profile: their losses.
        shapes: what these tell of the prestretch.
        by: what they tell with the height, and of it.
        height: what was stated of it.
    """

    sensor: Sensor
    presses: Presses
    other: Presses
    profile: LossProfile
    shapes: ByShapes
    by: HeightEffect
    height: StatedHeight

    def raised(self, sensor: Sensor, height: float) -> tuple[Sensor, np.ndarray]:
        """A sensor of this height with its rest surface higher, in stated standard deviations, and which of the markers it
        has."""
        share = self.height.error / self.height.after(height, 1.0).error - 1
        return changed_height(sensor, self.presses.rest_markers, share)


def explained(sensor: Sensor, reconstructor: Reconstructor, known: MeasuredPresses, progress: Progress) -> ExplainedPresses:
    """The presses at the rest surface of the sensor, or, where it is inflated, at the height that they tell.

    Args:
        sensor: as it is known.
        reconstructor: reconstructor of the sensor, on the grid for calibration.
        known: what is known of the presses.
        progress: is told how far it is.
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
    """In rounds, each at the height and with the prestretch that the one before told."""
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
    """The modulus, roughly, if forces or the gauge at rest tell it: of a gas, whose law is in newtons, it enters the shapes."""
    sensor, shapes = found.sensor, found.shapes
    if known.overpressure is not None:
        return [modulus_at_rest(sensor, shapes.mean, shapes.deviation, known.overpressure).modulus]
    if known.forces is not None:
        ratios = np.linalg.norm(known.forces.forces, axis=1) / np.sqrt(own.forces.prod(0))
        return [float(sensor.material.modulus * np.nanmean(ratios))]
    return []


def with_material(sensor: Sensor, values: np.ndarray) -> Sensor:
    """The sensor with this prestretch and, if it is among the values, modulus."""
    material = replace(sensor.material, prestretch=max(1.0, float(values[0])))
    if len(values) > 1:
        thickness = material.thickness or 1.0
        material = replace(material, shear_modulus=float(values[1]) / thickness, thickness=thickness)
    return replace(sensor, material=material)


def coarse_reconstructor(sensor: Sensor) -> Reconstructor:
    """The sensor's, on `GRID`; refused where its presses tell no prestretch."""
    views = max(1, len(sensor.views))
    expect(views == 1, "calibrate material: views", views, "1: calibrate sensor.in_view(0), the first view by itself")
    sensor.refuse_heights("calibrate material")
    if sensor.material.model == "harmonic":
        raise MembraneError(
            "calibrate material: a harmonic membrane has one shape at any prestretch; expected neo_hookean or mooney_rivlin"
        )
    return Reconstructor(replace(sensor, membrane=sensor.surface.membrane(GRID)), dtype=torch.float64)


def _log_stretch(stretches: np.ndarray, losses: np.ndarray) -> tuple[float, float]:
    """Mean and standard deviation of the logarithm of the prestretch, from losses `[S, B]` at `stretches [S]`."""
    z = np.log(stretches)
    fine = np.linspace(z[0], z[-1], FINE)
    loss = PchipInterpolator(z, losses)(fine)
    alone = np.exp(loss.min(0) - loss)
    weight = (WRONG + (1 - WRONG) * alone / alone.mean(0)).prod(1)
    mean = (weight * fine).sum() / weight.sum()
    return mean, np.sqrt((weight * (fine - mean) ** 2).sum() / weight.sum())
