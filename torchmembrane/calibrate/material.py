"""The membrane's prestretch from images of presses, and its stiffness from presses of known force."""

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import NamedTuple

import numpy as np
import torch
from scipy.interpolate import PchipInterpolator
from torch import Tensor

from ..errors import MembraneError, check_arguments, expect
from ..estimators.force_balance.estimator import ForceBalance
from ..files.tensors import tensor_of
from ..progress import Progress, silent, within
from ..reconstruct import Reconstructor
from ..results.status import Status
from ..sensor.factories import elastic_energy
from ..sensor.sensor import Sensor
from .gauge import UNSURE, FoundPressures, GaugeModulus, modulus_from_pressures
from .known_modulus import ModulusEvidence, joined, modulus_at_rest, odd_ones
from .stretch_loss import Explained, continued

GRID = (17, 17)  # on finer grids the loss is less smooth in the prestretch
PRESSURE_GRID = (33, 33)  # on coarser ones pressure changes are off by up to a tenth
STRETCHES = np.geomspace(1.01, 2.0, 10)  # beyond, the shape hardly depends on it
BETWEEN = 5  # prestretches tried on either side of the lowest
PRESTRETCH_ERROR = 0.03  # of an estimate, relative: the grid's and the loss's, alike in all images
WRONG = 0.02  # probability that an image is explained wrongly altogether and carries no information
FORCE_ERROR = 0.1  # of a press, relative: force balance's on presses of known force (docs/calibration.md)
GAS_ROUNDS = 4
GAS_SETTLED = 0.1  # change of a gas' modulus, relative, that changes the prestretch by less than its deviation
FINE = 4001  # prestretches over which the probability is summed
# What takes how much of the time, measured: of all, the markers in the images; of a round, the losses with pressures, forces or
# neither known; over a solve from rest, the steps from both neighbours' solutions.
IMAGES_SHARE, PROFILE_SHARE, CONTINUED = 0.05, (0.6, 0.8, 1.0), 0.1


class LossProfile(NamedTuple):
    """The least loss at each prestretch.

    Attributes:
        stretches: `[S]` prestretches, increasing.
        losses: `[S, B]` of every image.
    """

    stretches: np.ndarray
    losses: np.ndarray


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
    """

    sensor: Sensor
    values: np.ndarray
    covariance: np.ndarray
    profile: LossProfile
    each: np.ndarray
    forces: np.ndarray
    pressures: np.ndarray
    contradictions: Sequence[str] = ()

    @property
    def deviations(self) -> np.ndarray:
        """Standard deviations of the values, `[n]`."""
        return np.sqrt(np.diag(self.covariance))


class KnownPressures(NamedTuple):
    """What a gauge read.

    Attributes:
        readings: `[B]` of the images, N per length unit squared, NaN where not known.
        since_rest: whether these are changes since rest; else what the gauge reads at rest is found as well.
    """

    readings: np.ndarray
    since_rest: bool = False


class KnownForces(NamedTuple):
    """What pressed.

    Attributes:
        forces: total force on the membrane, `[B, 3]` in the camera's frame or `[B, 1]` magnitudes, N, NaN where not known.
        deviations: `[B]` standard deviations of their magnitudes, N; None, or NaN where not known: small beside `FORCE_ERROR`.
    """

    forces: np.ndarray
    deviations: np.ndarray | None = None

    @property
    def relative(self) -> np.ndarray:
        """Standard deviation of what each known force tells, relative, with `FORCE_ERROR` in it."""
        size = np.linalg.norm(self.forces, axis=1)
        own = np.zeros_like(size) if self.deviations is None else np.nan_to_num(self.deviations) / size
        return np.hypot(FORCE_ERROR, own)[np.isfinite(size)]


@check_arguments
def material_from_images(
    sensor: Sensor,
    images: Tensor,
    forces: np.ndarray | KnownForces | None = None,
    pressures: KnownPressures | None = None,
    *,
    overpressure: float | None = None,
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
    known = MeasuredPresses(displacement, confidence, _known(forces), pressures, overpressure)
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
    covariance = None if noise is None else reconstructor.observer.covariance_of(noise, confidence)
    measured = MeasuredPresses(displacement, confidence, _known(forces), pressures, overpressure, covariance)
    return _material(sensor, reconstructor, measured, progress)


class MeasuredPresses(NamedTuple):
    """What is known of presses: the markers' displacement `[B, D, 2]` px and confidence `[B, D]`, forces or pressures as of
    `material_from_pixels`, the displacements' covariance (default: the rest image's)."""

    displacement: Tensor
    confidence: Tensor
    forces: KnownForces | None
    pressures: KnownPressures | None
    overpressure: float | None
    covariance: Tensor | None = None


def _known(forces: np.ndarray | KnownForces | None) -> KnownForces | None:
    return forces if forces is None or isinstance(forces, KnownForces) else KnownForces(np.asarray(forces, float))


def _material(
    sensor: Sensor, reconstructor: Reconstructor, known: MeasuredPresses, progress: Progress, rounds: int = GAS_ROUNDS
) -> MaterialFit:
    displacement, confidence, forces, pressures, overpressure, covariance = known
    if pressures is not None:
        reconstructor.estimator.check_gauge()
    presses = Presses(reconstructor, displacement, confidence, covariance)
    of_round, later = _shares(sensor, any(given is not None for given in known[2:5]), rounds, progress)
    of_profile = PROFILE_SHARE[0 if pressures is not None else 1 if forces is not None else 2]
    profile = presses.profile(within(of_round, 0.0, of_profile))
    of_modulus = within(of_round, of_profile, 1.0)
    each = np.array([_log_stretch(profile.stretches, losses[:, None]) for losses in profile.losses.T])
    log_stretch, deviation = _log_stretch(profile.stretches, profile.losses)
    variances = each[:, 1] ** 2 + PRESTRETCH_ERROR**2
    contradiction = ((each[:, 0] - log_stretch) ** 2 / variances).sum() / max(len(each) - 1, 1)
    deviation = np.hypot(deviation * np.sqrt(max(1.0, contradiction)), PRESTRETCH_ERROR)
    prestretch = float(np.exp(log_stretch))
    values = [prestretch]
    material = replace(sensor.material, prestretch=prestretch)
    magnitudes, gauged = np.full((2, len(each), 2), np.nan)
    evidence, said = [], []
    if forces is not None:
        *told, magnitudes, odd = presses.modulus(log_stretch, deviation, forces, of_modulus)
        evidence.append(ModulusEvidence("the forces", *told))
        said += [
            f"image {i + 1}: its force is {r:.2f} of what the others' tell, {z:.1f} standard deviations apart"
            for i, r, z in odd
        ]
    if pressures is not None:
        *told, gauged = presses.gauge_modulus(log_stretch, deviation, pressures, of_modulus)
        evidence.append(ModulusEvidence("the gauge under presses", *told))
    if overpressure is not None:
        evidence.append(modulus_at_rest(sensor, log_stretch, deviation, overpressure))
    covariance = np.array([[(prestretch * deviation) ** 2]])
    if evidence:
        found = joined(evidence)
        prestretch, said = float(np.exp(log_stretch + found.shift * deviation)), said + found.contradictions
        values, scale = [prestretch, found.modulus], np.array([prestretch * deviation, found.modulus])
        covariance = scale[:, None] * found.covariance * scale
        thickness = material.thickness or 1.0
        modulus = found.modulus / thickness
        material = replace(material, prestretch=max(1.0, prestretch), shear_modulus=modulus, thickness=thickness)
    alone = np.exp(each[:, :1]) * np.stack([np.ones(len(each)), np.sqrt(variances)], -1)
    made = replace(sensor, material=material)
    if rounds and not _is_settled(sensor, made):
        return _material(made, _reconstructor(made), known, later, rounds - 1)
    return MaterialFit(made, np.array(values), covariance, profile, alone, magnitudes, gauged, said)


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


class Presses:
    """B presses as measured, to be explained by one material or another.

    Args:
        reconstructor: the sensor's.
        displacement: `[B, D, 2]` of its markers, px.
        confidence: `[B, D]` of its markers.
        covariance: `[B, D, 2, 2]` of the displacements, px^2; default: the rest image's.
    """

    def __init__(
        self, reconstructor: Reconstructor, displacement: Tensor, confidence: Tensor, covariance: Tensor | None = None
    ):
        self.reconstructor = reconstructor
        self.observation = reconstructor.observation(displacement, confidence, covariance)

    def explained(self, stretch: float, modulus: float, grid: tuple[int, int] | None = None) -> Explained:
        """The estimator with this material, on this grid, default the reconstructor's, and what it finds."""
        r, known = self.reconstructor, self.reconstructor.estimator
        assert isinstance(known, ForceBalance)  # as `_reconstructor` chooses
        cavity, membrane = known.cavity, known.membrane if grid is None else r.sensor.surface.membrane(grid)
        elasticity = elastic_energy(r.sensor, membrane, prestretch=stretch, modulus=modulus)
        points = r.marker_points if grid is None else membrane.closest_points(r.rest_markers.numpy())
        gas = tuple(cavity.gas.tolist())
        estimator = ForceBalance(
            membrane, elasticity, points, r.rest_markers, known.equations.bearings.noise, cavity.filling, gas
        )
        with torch.no_grad():
            return estimator, estimator(self.observation)

    def profile(self, progress: Progress) -> LossProfile:
        """The presses' losses at `STRETCHES`, and closer together around the lowest."""
        work = np.array([len(STRETCHES), CONTINUED * len(STRETCHES), BETWEEN, CONTINUED * (len(STRETCHES) + BETWEEN)])
        ends = np.cumsum([0.0, *work / work.sum()]).tolist()
        solve, follow, solve_between, follow_all = (within(progress, *pair) for pair in zip(ends, ends[1:], strict=False))
        solutions = self._solutions(STRETCHES, solve)
        total = self._profile(solutions, follow).losses.sum(1)
        k = min(max(int(np.argmin(total)), 1), len(STRETCHES) - 2)
        between = np.geomspace(STRETCHES[k - 1], STRETCHES[k + 1], BETWEEN + 2)[1:-1]
        return self._profile(solutions | self._solutions(between, solve_between), follow_all)

    def _solutions(self, stretches: np.ndarray, progress: Progress) -> dict[float, Explained]:
        """What explains the presses at each prestretch, solved from rest."""
        modulus, found = self.reconstructor.sensor.material.modulus, {}
        for k, stretch in enumerate(stretches):
            progress(k / len(stretches), f"force balance at prestretch {stretch:.3g}")
            found[stretch] = self.explained(stretch, modulus)
        return found

    def _profile(self, solutions: dict[float, Explained], progress: Progress) -> LossProfile:
        stretches = sorted(solutions)
        best = continued([solutions[stretch] for stretch in stretches], self.observation, progress)
        seen = self.observation.confidence.sum(-1)
        return LossProfile(np.array(stretches), np.array([(seen * found.unexplained).numpy() for _, found in best]))

    def gauge_modulus(
        self, log_stretch: float, deviation: float, pressures: KnownPressures, progress: Progress
    ) -> tuple[float, float, float, np.ndarray]:
        """The modulus from pressures; arguments and what is returned as of `modulus`, with pressure changes for forces."""
        gas, modulus = self.reconstructor.estimator.cavity.filling == "gas", self.reconstructor.sensor.material.modulus
        readings = np.asarray(pressures.readings, float)

        def found(stretch: float, modulus: float) -> FoundPressures:
            estimator, it = self.explained(stretch, modulus, PRESSURE_GRID)
            noise = estimator.equations.bearings.noise
            with torch.no_grad():
                spread = estimator.standard_deviations(it.vertices, it.pressure, it.moved, self.observation, noise)
            rest = float(estimator.rest_pressure)
            return FoundPressures((it.pressure - rest).numpy(), spread.pressure.numpy(), rest)

        def fit(stretch: float, begin: float, share: float) -> GaugeModulus:
            progress(share, f"modulus from pressures at prestretch {stretch:.3g}")
            return modulus_from_pressures(partial(found, stretch), readings, pressures.since_rest, begin, gas)

        fitted = fit(np.exp(log_stretch), modulus, 0.0)
        sides = ((np.exp(log_stretch + s * deviation), share) for s, share in ((-1, 1 / 3), (1, 2 / 3)))
        low, high = (fit(stretch, fitted.modulus, share).modulus - fitted.modulus for stretch, share in sides)
        change = float(np.sign(high - low) * max(abs(low), abs(high)))
        return fitted.modulus, fitted.deviation, change, fitted.pressures

    def modulus(
        self, log_stretch: float, deviation: float, known: KnownForces, progress: Progress = silent
    ) -> tuple[float, float, float, np.ndarray, list[tuple[int, float, float]]]:
        """The modulus from presses of known force.

        A gas resists in newtons: there the presses are explained anew with each modulus.

        Args:
            log_stretch: logarithm of the prestretch.
            deviation: its standard deviation.
            known: as for `material_from_pixels`.
            progress: is told how far it is.

        Returns:
            The modulus; its standard deviation at this prestretch; its change with one deviation of the prestretch, the larger
            of those to either side, negative, as under more tension at rest a softer membrane presses as hard; magnitudes of
            the forces found and measured, `[B, 2]`; and images whose forces the others contradict, as of `odd_ones`.
        """
        forces, relative = known.forces, known.relative
        weight = relative**-2.0 / (relative**-2.0).sum()
        modulus = self.reconstructor.sensor.material.modulus
        progress(0.0, "modulus from forces")
        self._refuse_unpressed(float(np.exp(log_stretch)), modulus, np.isfinite(forces).all(1))
        for _ in range(GAS_ROUNDS if self.reconstructor.estimator.cavity.filling == "gas" else 1):
            ratios, magnitudes = self._ratios(np.exp(log_stretch), modulus, forces)
            modulus = float((weight * ratios).sum() * modulus)
        progress(0.5, "modulus with the prestretch's error")
        sides = [(weight * self._ratios(np.exp(log_stretch + s * deviation), modulus, forces)[0]).sum() for s in (-1, 1)]
        change = -modulus * np.abs(np.array(sides) - 1).max()
        sure, mean = (relative**-2.0).sum() ** -0.5, (weight * ratios).sum()
        scatter = (((ratios / mean - 1) / relative) ** 2).sum() / max(len(ratios) - 1, 1)
        images = np.flatnonzero(np.isfinite(forces).all(1))
        odd = [(int(images[i]), ratio, apart) for i, ratio, apart in odd_ones(ratios, relative)]
        return modulus, modulus * sure * max(1.0, scatter) ** 0.5, change, magnitudes, odd

    def _refuse_unpressed(self, stretch: float, modulus: float, known: np.ndarray) -> None:
        """Refuse images of known force `[B]` in which the markers show hardly any."""
        estimator, it = self.explained(stretch, modulus)
        noise = estimator.equations.bearings.noise
        with torch.no_grad():
            spread = estimator.standard_deviations(it.vertices, it.pressure, it.moved, self.observation, noise)
        force = (it.traction * estimator.membrane.rest_area[:, None]).sum(1)
        unsure = (spread.force.norm(dim=1) > UNSURE * force.norm(dim=1)).numpy()
        for i in np.flatnonzero(known & unsure):
            raise MembraneError(
                f"calibrate material: image {i + 1} hardly shows a force, though one is given for it; expected presses that "
                "dent the membrane visibly: leave it out"
            )

    def _ratios(self, stretch: float, modulus: float, forces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Forces measured over found of the presses of known force `[F]`, and all magnitudes, found and measured `[B, 2]`."""
        estimator, equilibrium = self.explained(stretch, modulus)
        found = (equilibrium.traction * estimator.membrane.rest_area[:, None]).sum(1).numpy()
        size, measured = np.linalg.norm(found, axis=1), np.linalg.norm(forces, axis=1)
        along = (forces * found).sum(1) / size if forces.shape[1] == 3 else measured
        return (along / size)[np.isfinite(along)], np.stack([size, measured], -1)
