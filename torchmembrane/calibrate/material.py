"""Calibrate the membrane's prestretch from images of presses, and its modulus from known forces or pressures."""

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from ..errors import MembraneError, check_arguments, expect
from ..files.tensors import tensor_of
from ..progress import Progress, silent, within
from ..reconstruct import Reconstructor
from ..results.status import Status
from ..sensor.inflated import InflatedSurface
from ..sensor.sensor import Sensor
from ..torch_modes import on_cpu
from .explained import HEIGHT_SHARE, ExplainedPresses, MeasuredPresses, coarse_reconstructor, explained, with_material
from .known_modulus import (
    KnownForces,
    KnownPressures,
    ModulusEvidence,
    joined,
    modulus_at_rest,
    normal_interval,
    refuse_overpressure,
)
from .presses import GAS_ROUNDS, LossProfile
from .rest_error import HEIGHT_ERROR, StatedHeight, changed_height

GAS_SETTLED = 0.1  # relative change of the modulus with a gas that changes the prestretch by less than its deviation
# Shares of the time, measured: of the markers in the images in the total; of the losses in one round, if pressures, forces or
# neither are known.
IMAGES_SHARE, PROFILE_SHARE = 0.05, (0.5, 0.65, 0.85)


class MaterialFit(NamedTuple):
    """The sensor with its calibrated material.

    Attributes:
        sensor: the sensor with this material.
        values: prestretch and, if forces or pressures are known, modulus = shear modulus x thickness (N per length unit),
            `[n]`.
        covariance: covariance of the values, `[n, n]`.
        intervals: lower and upper bounds of 95 % intervals of the values, `[n, 2]`.
        profile: the losses by prestretch from which the prestretch was inferred.
        each: prestretch and its standard deviation from each image alone, `[B, 2]`.
        forces: reconstructed and measured magnitudes of forces, `[B, 2]`, N; NaN if unknown.
        pressures: reconstructed and measured pressure changes since rest, `[B, 2]`, N per length unit squared; NaN if unknown.
        contradictions: sentences about measurements that contradict one another.
        force_deviation: relative standard deviation of the scale of reconstructed forces; None without a modulus.
        height: height of an inflated rest surface over its rim, and its standard deviation, `[2]`, length unit; None for other
            surfaces.
    """

    sensor: Sensor
    values: np.ndarray
    covariance: np.ndarray
    intervals: np.ndarray
    profile: LossProfile
    each: np.ndarray
    forces: np.ndarray
    pressures: np.ndarray
    contradictions: Sequence[str] = ()
    force_deviation: float | None = None
    height: np.ndarray | None = None

    @property
    def deviations(self) -> np.ndarray:
        """Standard deviations of the values, `[n]`."""
        return np.sqrt(np.diag(self.covariance))


@check_arguments
@on_cpu
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
    """Infer the prestretch from images of presses, and the modulus from known forces or pressures.

    `material_from_pixels` describes the method.

    Args:
        sensor: the sensor, calibrated except for its material.
        images: grey images, `[B, 1, H, W]`, in 0..1.
        forces: total force on the membrane, N: `[B, 3]` in the camera's frame, or magnitudes `[B, 1]`; NaN if unknown. Or
            `KnownForces`, with standard deviations.
        pressures: gauge readings during the presses.
        overpressure: gauge reading at rest, hPa.
        rest_error: relative standard deviation of the rest surface's height over its rim.
        progress: called with the completed share.

    Returns:
        The `MaterialFit`.

    Raises:
        MembraneError: an image shows too few markers, or as for `material_from_pixels`.
    """
    refuse_overpressure("calibrate material", overpressure, sensor)
    progress(0.0, "markers of the images")
    reconstructor = coarse_reconstructor(sensor)
    grey = reconstructor.grey(images)
    known_forces = _known(forces, len(grey))
    with torch.no_grad():
        flow = reconstructor.observer.judge(*reconstructor.observer(grey))
    displacement, confidence, _, status = flow
    for i in np.flatnonzero(status != Status.OK):
        raise MembraneError(f"calibrate material: image {i + 1}: {Status(int(status[i])).text}; leave it out")
    known = MeasuredPresses(displacement, confidence, known_forces, pressures, overpressure, StatedHeight(rest_error))
    return _with_own_markers(_material(sensor, reconstructor, known, within(progress, IMAGES_SHARE, 1.0)), sensor)


@check_arguments
@on_cpu
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
    """Infer the prestretch from presses, and the modulus from their forces or the pressures in the cavity.

    Force balance is solved at many prestretches l. Its objective without the normal-compression term (`stretch_loss`), scaled
    by the standard deviations of markers and by the rest pressure, is used as a negative log likelihood:

        p(log l) ~ product over images of [e + (1 - e) exp(-min over x, p of loss(x, p; l)) / mean over l of the same]

    where e = `WRONG` is the probability that an image is explained wrongly. Mean and standard deviation are reported; the
    latter is enlarged if images contradict one another, and by an error common to all images. With a wrong l, the membrane
    would need forces that no contact exerts. Forces are proportional to the modulus, so each press gives it as measured force /
    reconstructed force at modulus 1; the mean is reported. Pressures are used alike (`gauge.modulus_from_pressures`).

    Args:
        sensor: the sensor, calibrated except for its material.
        pixels: positions of the markers in B images of presses, `[B, D, 2]` (NaN for lost markers), corrected by the difference
            between rest image and model.
        forces: total force on the membrane, N: `[B, 3]` in the camera's frame, or magnitudes `[B, 1]`; NaN if unknown. Or
            `KnownForces`, with standard deviations.
        pressures: gauge readings during the presses.
        overpressure: gauge reading at rest, hPa.
        noise: noise of the pixels, as for `Reconstructor.from_pixels`.
        rest_error: relative standard deviation of the rest surface's height over its rim.
        progress: called with the completed share.

    Returns:
        The `MaterialFit`.

    Raises:
        MembraneError: the material is harmonic, so that its shape does not depend on the prestretch; a press with a known force
            hardly shows; or the gauge readings do not determine a modulus, as with an open cavity.

    Limitations:
        Shallow presses, and presses between markers, carry little information (the standard deviation is then large). The
        prestretch must be equibiaxial, and the rest surface accurate. A prestretch outside the range of `STRETCHES` is found
        near its end.
    """
    refuse_overpressure("calibrate material", overpressure, sensor)
    reconstructor = coarse_reconstructor(sensor)
    pixels = tensor_of("calibrate material: pixels", pixels).to(reconstructor.rest_pixels)
    known = pixels.ndim == 3 and pixels.shape[1:] == reconstructor.rest_pixels.shape
    expected = f"[B, {len(reconstructor.rest_pixels)}, 2], one for each marker"
    expect(known, "calibrate material: pixels", f"a tensor {list(pixels.shape)}", expected)
    lost = ~pixels.isfinite().all(-1)
    displacement = torch.where(lost[..., None], 0.0, pixels - reconstructor.rest_pixels)
    confidence = (~lost).to(pixels)
    covariance = None if noise is None else reconstructor.observer.covariance_of(noise, confidence)  # type: ignore[operator]
    height = StatedHeight(rest_error)
    of_images = _known(forces, len(pixels))
    measured = MeasuredPresses(displacement, confidence, of_images, pressures, overpressure, height, covariance)
    return _with_own_markers(_material(sensor, reconstructor, measured, progress), sensor)


def _known(forces: np.ndarray | KnownForces | None, count: int) -> KnownForces | None:
    """Return the known forces of `count` images.

    Raises:
        MembraneError: their shape is another, none is known, or one is zero.
    """
    if forces is None:
        return None
    known, what = forces if isinstance(forces, KnownForces) else KnownForces(forces), "calibrate material: forces"
    values = np.asarray(known.forces, float)
    right = values.ndim == 2 and len(values) == count and values.shape[1] in (1, 3)
    expected = f"[{count}, 3] or [{count}, 1]: of each image its force or magnitude, NaN if unknown"
    expect(right, what, f"an array {list(values.shape)}", expected)
    expect(np.isfinite(values).all(1).any(), what, "NaN for all images", "at least one known force, or None")
    expect(not (np.linalg.norm(values, axis=1) == 0).any(), what, "0 N for an image", "presses, NaN where the force is unknown")
    if known.deviations is None:
        return KnownForces(values)
    deviations, what = np.asarray(known.deviations, float), "calibrate material: deviations of forces"
    expect(deviations.shape == (count,), what, f"an array {list(deviations.shape)}", f"[{count}], one for each image")
    return KnownForces(values, deviations)


def _material(
    sensor: Sensor, reconstructor: Reconstructor, known: MeasuredPresses, progress: Progress, rounds: int = GAS_ROUNDS
) -> MaterialFit:
    if known.pressures is not None:
        reconstructor.estimator.check_gauge()
    of_round, later = _shares(sensor, known.tells_modulus, rounds, progress)
    of_profile = PROFILE_SHARE[0 if known.pressures is not None else 1 if known.forces is not None else 2]
    at = explained(sensor, reconstructor, known, within(of_round, 0.0, of_profile + HEIGHT_SHARE))
    evidence = _Evidence(at)
    evidence.gather(known, within(of_round, of_profile + HEIGHT_SHARE, 1.0))
    found = _found(at, evidence)
    made, inflated = with_material(at.sensor, found.values), isinstance(sensor.surface, InflatedSurface)
    is_rough = not inflated or at.sensor.force_unit == "relative"  # the modulus with which the presses were explained
    if rounds and is_rough and not _is_settled(at.sensor, made):
        displacement, confidence, covariance = at.presses.measured
        known = known._replace(displacement=displacement, confidence=confidence, covariance=covariance, height=at.height)
        return _material(made, coarse_reconstructor(made), known, later, rounds - 1)
    height = None
    if isinstance(made.surface, InflatedSurface):
        height = made.surface.formed.height * np.array([1 + at.height.error * found.height, at.height.error * found.spread])
        made = at.raised(made, found.height)[0]
    shapes = at.shapes
    alone = np.exp(shapes.each)[:, None] * np.stack([np.ones(len(shapes.each)), np.sqrt(shapes.variances)], -1)
    told = (evidence.magnitudes, evidence.gauged, evidence.said + found.contradictions, found.of_force)
    return MaterialFit(made, found.values, found.covariance, found.intervals, at.profile, alone, *told, height)


class _Found(NamedTuple):
    """Result of one round: values, covariance and intervals as in `MaterialFit`, the relative standard deviation of forces
    (None without a modulus), contradictions, and the change of the rest surface's height with its standard deviation, both in
    stated standard deviations."""

    values: np.ndarray
    covariance: np.ndarray
    intervals: np.ndarray
    of_force: float | None
    contradictions: list[str]
    height: float
    spread: float


def _found(at: ExplainedPresses, evidence: "_Evidence") -> _Found:
    shapes, by = at.shapes, at.by
    if not evidence.found:
        values = np.exp([shapes.mean + by.shift * by.mean])
        deviation = np.hypot(shapes.deviation, by.shift * by.deviation)
        intervals = values[:, None] * np.exp(normal_interval([[deviation]]))
        return _Found(values, (values * deviation)[:, None] ** 2, intervals, None, [], by.mean, by.deviation)
    found = joined(evidence.found, by.shift / shapes.deviation, (by.mean, by.deviation), -shapes.mean / shapes.deviation)
    along = np.array([by.by_stretch, 1.0, by.by_height])
    of_force = float(along @ found.covariance @ along) ** 0.5
    values = np.array([np.exp(shapes.mean + found.shift * shapes.deviation), found.modulus])
    scale = values * [shapes.deviation, 1.0]
    covariance = scale[:, None] * found.covariance[:2, :2] * scale
    intervals = np.stack([np.exp(shapes.mean + found.intervals[0] * shapes.deviation), found.intervals[1]])
    height = found.height, float(found.covariance[2, 2]) ** 0.5
    return _Found(values, covariance, intervals, of_force, found.contradictions, *height)


def _with_own_markers(fit: MaterialFit, sensor: Sensor) -> MaterialFit:
    """Return the fit with the markers of the given sensor, moved to the fitted rest surface."""
    surface, material = fit.sensor.surface, fit.sensor.material
    if not isinstance(surface, InflatedSurface) or not isinstance(sensor.surface, InflatedSurface):
        return fit
    made, markers = replace(sensor, material=material), sensor.markers
    if markers.positions is None:
        return fit._replace(sensor=replace(made, surface=surface, membrane=fit.sensor.membrane))
    before = sensor.surface.made_of(material, sensor.length_unit).formed.height
    raised, kept = changed_height(made, markers.positions, surface.formed.height / before - 1)
    sizes = list(np.array(markers.sizes)[kept])
    markers = replace(markers, positions=raised.markers.positions, sizes=sizes)
    return fit._replace(sensor=replace(raised, markers=markers))


class _Evidence:
    """The modulus from forces and gauges (`found`), reconstructed and measured magnitudes and pressures, `[B, 2]`, NaN if
    unknown, and sentences about measurements that contradict the others (`said`)."""

    def __init__(self, at: ExplainedPresses) -> None:
        self.presses, self.other, self.by, self.reach = at.presses, at.other, at.by, at.height.reach
        self.at, self.bent = (at.shapes.mean, at.shapes.deviation), isinstance(at.sensor.surface, InflatedSurface)
        self.magnitudes, self.gauged = np.full((2, len(at.shapes.each), 2), np.nan)
        self.found: list[ModulusEvidence] = []
        self.said: list[str] = []

    def gather(self, known: MeasuredPresses, progress: Progress) -> None:
        """Compute the modulus from each known kind of measurement."""
        if known.forces is not None:
            modulus, sd, change, sides, self.magnitudes, odd = self.presses.modulus(*self.at, known.forces, progress)
            self._add(ModulusEvidence("the forces", modulus, sd, change, -self.by.by_height * modulus, sides))
            self.said += [
                f"image {i + 1}: its force is {r:.2f} of what the others' tell, {z:.1f} standard deviations apart"
                for i, r, z in odd
            ]
        if known.pressures is not None:
            told = self.presses.gauge_modulus(*self.at, known.pressures, self.other, progress)
            modulus, sd, change, by_height, self.gauged = told
            self._add(ModulusEvidence("the gauge under presses", modulus, sd, change, by_height / self.reach))
        if known.overpressure is not None:
            sensor, moved = (presses.reconstructor.sensor for presses in (self.presses, self.other))
            at_rest = modulus_at_rest(sensor, *self.at, known.overpressure, moved)
            self._add(at_rest._replace(by_height=at_rest.by_height / self.reach))

    def _add(self, evidence: ModulusEvidence) -> None:
        self.found.append(evidence if self.bent else evidence._replace(sides=None))


def _shares(sensor: Sensor, with_modulus: bool, rounds: int, progress: Progress) -> tuple[Progress, Progress]:
    """Return the progress of this round and of the later ones. With a gas and an initially unknown modulus, two rounds are
    expected; an inflated surface has rounds of its own."""
    again = sensor.cavity.filling == "gas" and with_modulus and rounds == GAS_ROUNDS and sensor.force_unit == "relative"
    share = 0.5 if again and not isinstance(sensor.surface, InflatedSurface) else 1.0
    return within(progress, 0.0, share), within(progress, share, 1.0)


def _is_settled(sensor: Sensor, made: Sensor) -> bool:
    """Return whether the presses were solved with about the modulus found. Only with a gas do shapes depend on the modulus; a
    gas without modulus is treated as a liquid."""
    if made.cavity.filling != "gas" or made.force_unit == "relative":
        return True
    return sensor.force_unit != "relative" and abs(made.material.modulus / sensor.material.modulus - 1) < GAS_SETTLED
