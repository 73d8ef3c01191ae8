"""The membrane's prestretch from images of presses, and its stiffness from presses of known force."""

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import torch
from scipy.interpolate import PchipInterpolator
from torch import Tensor

from ..errors import MembraneError, check_arguments, expect
from ..files.tensors import tensor_of
from ..progress import Progress, silent, within
from ..reconstruct import Reconstructor
from ..results.status import Status
from ..sensor.sensor import Sensor
from .known_modulus import KnownForces, KnownPressures, ModulusEvidence, joined, modulus_at_rest
from .presses import GAS_ROUNDS, LossProfile, Presses
from .rest_error import HEIGHT_ERROR, HeightEffect, height_effect

GRID = (17, 17)  # on finer grids the loss is less smooth in the prestretch
PRESTRETCH_ERROR = 0.03  # of an estimate, relative: the grid's and the loss's, alike in all images
WRONG = 0.02  # probability that an image is explained wrongly altogether and carries no information
GAS_SETTLED = 0.1  # change of a gas' modulus, relative, that changes the prestretch by less than its deviation
FINE = 4001  # prestretches over which the probability is summed
# What takes how much of the time, measured: of all, the markers in the images; of a round, the losses with pressures, forces or
# neither known, and the same on a rest surface of another height.
IMAGES_SHARE, PROFILE_SHARE, HEIGHT_SHARE = 0.05, (0.5, 0.65, 0.85), 0.15


class MaterialFit(NamedTuple):
    """The sensor with the material found.

    Attributes:
        sensor: the sensor with this material.
        values: `[n]` prestretch and, where forces are known, modulus = shear modulus x thickness (N per length unit).
        covariance: `[n, n]` of the values.
        profile: the losses on which the prestretch rests.
        each: `[B, 2]` prestretch and standard deviation from each image alone.
        forces: `[B, 2]` magnitudes found and measured, N, NaN where not known.
        pressures: `[B, 2]` changes since rest found and measured, N per length unit squared, NaN where not known.
        contradictions: sentences about measurements that contradict one another.
        force_deviation: relative standard deviation of the scale of forces that the sensor then says; None without a modulus.
    """

    sensor: Sensor
    values: np.ndarray
    covariance: np.ndarray
    profile: LossProfile
    each: np.ndarray
    forces: np.ndarray
    pressures: np.ndarray
    contradictions: Sequence[str] = ()
    force_deviation: float | None = None

    @property
    def deviations(self) -> np.ndarray:
        """Standard deviations of the values, `[n]`."""
        return np.sqrt(np.diag(self.covariance))


@check_arguments
def material_from_images(
    sensor: Sensor,
    images: Tensor,
    forces: np.ndarray | KnownForces | None = None,
    pressures: KnownPressures | None = None,
    *,
    overpressure: float | None = None,
    rest_error: float = HEIGHT_ERROR,
    progress: Progress = silent,
) -> MaterialFit:
    """Prestretch from images of presses, and the modulus where forces or pressures are known; see `material_from_pixels`.

    Args:
        sensor: the sensor, calibrated but for its material.
        images: `[B, 1, H, W]` grey in 0..1.
        forces: total force on the membrane, `[B, 3]` in the camera's frame or `[B, 1]` magnitudes, N, NaN where not known; or
            `KnownForces`, with their deviations.
        pressures: what a gauge read.
        overpressure: what it read at rest, hPa.
        rest_error: standard deviation of the rest surface's height over its rim, relative.
        progress: is told how far it is.

    Returns:
        The sensor with the material found.

    Raises:
        MembraneError: an image shows too few markers, or as of `material_from_pixels`.
    """
    progress(0.0, f"markers of {len(images)} images")
    reconstructor = _reconstructor(sensor)
    grey = reconstructor.grey(images)
    with torch.no_grad():
        flow = reconstructor.observer.judge(*reconstructor.observer(grey))
    displacement, confidence, _, status = flow
    for i in np.flatnonzero(status != Status.OK):
        raise MembraneError(f"calibrate material: image {i + 1}: {Status(int(status[i])).text}; leave it out")
    known = MeasuredPresses(displacement, confidence, _known(forces), pressures, overpressure, rest_error)
    return _material(sensor, reconstructor, known, within(progress, IMAGES_SHARE, 1.0))


@check_arguments
def material_from_pixels(
    sensor: Sensor,
    pixels: Tensor,
    forces: np.ndarray | KnownForces | None = None,
    pressures: KnownPressures | None = None,
    *,
    overpressure: float | None = None,
    noise: float | None = None,
    rest_error: float = HEIGHT_ERROR,
    progress: Progress = silent,
) -> MaterialFit:
    """Prestretch from presses, and the modulus where their forces, or the pressures in the cavity, are known.

    Force balance is solved at many prestretches l. What it minimises, in standard deviations of the markers and of tractions in
    units of the rest pressure, less the loss of pushes (`stretch_loss`), is taken for the negative logarithm of a probability:

        p(log l) ~ product over images of [e + (1 - e) exp(-min over x, p of loss(x, p; l)) / mean over l of the same]

    with e = `WRONG`, for an image that is explained wrongly altogether. Mean and deviation are reported, the latter enlarged
    where the images contradict one another, and by an error that all images share. A membrane with the wrong l needs forces
    that no touch exerts. Forces are proportional to the modulus, so that each press gives the modulus as force measured /
    force found at modulus 1; their mean is reported. Pressures likewise (`gauge.modulus_from_pressures`).

    Args:
        sensor: the sensor, calibrated but for its material.
        pixels: `[B, D, 2]` of the markers in B images of presses (NaN where lost), less what rest images show beside the model.
        forces: total force on the membrane, `[B, 3]` in the camera's frame or `[B, 1]` magnitudes, N, NaN where not known; or
            `KnownForces`, with their deviations.
        pressures: what a gauge read.
        overpressure: what it read at rest, hPa.
        noise: of the pixels, as for `Reconstructor.from_pixels`.
        rest_error: standard deviation of the rest surface's height over its rim, relative.
        progress: is told how far it is.

    Returns:
        The sensor with the material found.

    Raises:
        MembraneError: the sensor's material is harmonic: its shape does not depend on the prestretch; both forces and
            pressures; an open cavity, or pressures that tell no modulus.

    Limitations:
        Shallow presses, or presses that the markers miss, identify little (the deviation is large then). The membrane must be
        equally stretched in both directions, and the rest surface right. A prestretch outside `STRETCHES` is found near their
        end.
    """
    reconstructor = _reconstructor(sensor)
    pixels = tensor_of("calibrate material: pixels", pixels).to(reconstructor.rest_pixels)
    known = pixels.ndim == 3 and pixels.shape[1:] == reconstructor.rest_pixels.shape
    expected = f"[B, {len(reconstructor.rest_pixels)}, 2], one for each marker"
    expect(known, "calibrate material: pixels", f"a tensor {list(pixels.shape)}", expected)
    lost = ~pixels.isfinite().all(-1)
    displacement = torch.where(lost[..., None], 0.0, pixels - reconstructor.rest_pixels)
    confidence = (~lost).to(pixels)
    covariance = None if noise is None else reconstructor.observer.covariance_of(noise, confidence)  # type: ignore[operator]
    measured = MeasuredPresses(displacement, confidence, _known(forces), pressures, overpressure, rest_error, covariance)
    return _material(sensor, reconstructor, measured, progress)


class MeasuredPresses(NamedTuple):
    """What is known of presses: the markers' displacement `[B, D, 2]` px and confidence `[B, D]`, forces or pressures as of
    `material_from_pixels`, the displacements' covariance (default: the rest image's)."""

    displacement: Tensor
    confidence: Tensor
    forces: KnownForces | None
    pressures: KnownPressures | None
    overpressure: float | None
    rest_error: float
    covariance: Tensor | None = None

    @property
    def tells_modulus(self) -> bool:
        """Whether anything but the shapes is known."""
        return any(given is not None for given in (self.forces, self.pressures, self.overpressure))


def _known(forces: np.ndarray | KnownForces | None) -> KnownForces | None:
    return forces if forces is None or isinstance(forces, KnownForces) else KnownForces(np.asarray(forces, float))


class _ByShapes(NamedTuple):
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


def _by_shapes(profile: LossProfile) -> _ByShapes:
    each, own = np.array([_log_stretch(profile.stretches, losses[:, None]) for losses in profile.losses.T]).T
    mean, by_losses = _log_stretch(profile.stretches, profile.losses)
    variances = own**2 + PRESTRETCH_ERROR**2
    contradiction = ((each - mean) ** 2 / variances).sum() / max(len(each) - 1, 1)
    deviation = float(np.hypot(by_losses * np.sqrt(max(1.0, contradiction)), PRESTRETCH_ERROR))
    return _ByShapes(mean, deviation, by_losses, each, variances)


def _material(
    sensor: Sensor, reconstructor: Reconstructor, known: MeasuredPresses, progress: Progress, rounds: int = GAS_ROUNDS
) -> MaterialFit:
    if known.pressures is not None:
        reconstructor.estimator.check_gauge()
    presses = Presses(reconstructor, known.displacement, known.confidence, known.covariance)
    of_round, later = _shares(sensor, known.tells_modulus, rounds, progress)
    of_profile = PROFILE_SHARE[0 if known.pressures is not None else 1 if known.forces is not None else 2]
    shapes = _by_shapes(profile := presses.profile(within(of_round, 0.0, of_profile)))
    of_round(of_profile, "prestretch with the rest surface's error")
    other = presses.at_other_height(known.rest_error)
    by = height_effect(presses.told(shapes.around), other.told(shapes.around), shapes.deviation, shapes.by_losses**2)
    evidence = _Evidence(presses, other, shapes, by)
    evidence.gather(known, within(of_round, of_profile + HEIGHT_SHARE, 1.0))
    values = np.exp([shapes.mean])
    covariance, of_force, material = values**2 * (shapes.deviation**2 + by.shift**2), None, sensor.material
    covariance, said = covariance[:, None], evidence.said
    if evidence.found:
        found = joined(evidence.found, by.shift / shapes.deviation)
        along = np.array([by.by_stretch, 1.0, by.by_height])
        of_force = float(along @ found.covariance @ along) ** 0.5
        values = np.array([np.exp(shapes.mean + found.shift * shapes.deviation), found.modulus])
        scale = values * [shapes.deviation, 1.0]
        covariance, said = scale[:, None] * found.covariance[:2, :2] * scale, said + found.contradictions
        thickness = material.thickness or 1.0
        material = replace(material, shear_modulus=found.modulus / thickness, thickness=thickness)
    made = replace(sensor, material=replace(material, prestretch=max(1.0, float(values[0]))))
    if rounds and not _is_settled(sensor, made):
        return _material(made, _reconstructor(made), known, later, rounds - 1)
    alone = np.exp(shapes.each)[:, None] * np.stack([np.ones(len(shapes.each)), np.sqrt(shapes.variances)], -1)
    return MaterialFit(made, values, covariance, profile, alone, evidence.magnitudes, evidence.gauged, said, of_force)


class _Evidence:
    """What forces and gauges tell of the modulus: `found`; magnitudes and pressures found and measured, `[B, 2]`, NaN where not
    known; sentences about measurements that the others contradict."""

    def __init__(self, presses: Presses, other: Presses, shapes: _ByShapes, by: HeightEffect) -> None:
        self.presses, self.other, self.by, self.at = presses, other, by, (shapes.mean, shapes.deviation)
        self.magnitudes, self.gauged = np.full((2, len(shapes.each), 2), np.nan)
        self.found: list[ModulusEvidence] = []
        self.said: list[str] = []

    def gather(self, known: MeasuredPresses, progress: Progress) -> None:
        """From what is known."""
        if known.forces is not None:
            modulus, deviation, change, self.magnitudes, odd = self.presses.modulus(*self.at, known.forces, progress)
            self.found.append(ModulusEvidence("the forces", modulus, deviation, change, -self.by.by_height * modulus))
            self.said += [
                f"image {i + 1}: its force is {r:.2f} of what the others' tell, {z:.1f} standard deviations apart"
                for i, r, z in odd
            ]
        if known.pressures is not None:
            *told, self.gauged = self.presses.gauge_modulus(*self.at, known.pressures, self.other, progress)
            self.found.append(ModulusEvidence("the gauge under presses", *told))
        if known.overpressure is not None:
            sensor, moved = (presses.reconstructor.sensor for presses in (self.presses, self.other))
            self.found.append(modulus_at_rest(sensor, *self.at, known.overpressure, moved))


def _shares(sensor: Sensor, with_modulus: bool, rounds: int, progress: Progress) -> tuple[Progress, Progress]:
    """The progress of one round and of those after it: a gas' modulus, first unknown, is expected to settle in the second."""
    again = sensor.cavity.filling == "gas" and with_modulus and rounds == GAS_ROUNDS and sensor.force_unit == "relative"
    share = 0.5 if again else 1.0
    return within(progress, 0.0, share), within(progress, share, 1.0)


def _is_settled(sensor: Sensor, made: Sensor) -> bool:
    """Whether the presses were explained with about the modulus found; without one a gas acts as a liquid, whose shape does not
    depend on it."""
    if made.cavity.filling != "gas" or made.force_unit == "relative":
        return True
    return sensor.force_unit != "relative" and abs(made.material.modulus / sensor.material.modulus - 1) < GAS_SETTLED


def _reconstructor(sensor: Sensor) -> Reconstructor:
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
