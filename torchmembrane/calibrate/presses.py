"""Measured presses, solved with different materials: the loss at each prestretch, and the modulus from forces or pressures."""

from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from ..errors import MembraneError
from ..estimators.force_balance.estimator import ForceBalance
from ..progress import Progress, silent, within
from ..reconstruct import Reconstructor
from ..sensor.factories import elastic_energy
from ..sensor.sensor import Sensor
from .gauge import UNSURE, FoundPressures, GaugeModulus, modulus_from_pressures
from .known_modulus import KnownForces, KnownPressures, odd_ones
from .rest_error import PressesTold, at_other_height, changed_height
from .stretch_loss import Explained, continued

PRESSURE_GRID = (33, 33)  # on coarser grids pressure changes are wrong by up to a tenth
STRETCHES = np.geomspace(1.01, 2.0, 10)  # at larger prestretches the shape hardly depends on the prestretch
BETWEEN = 5  # number of prestretches tried around the one of lowest loss
GAS_ROUNDS = 4
MODULUS_SETTLED = 1e-3  # relative change of the modulus with a gas that changes forces by less than a thousandth
LARGEST_ANGLE = 30.0  # degrees between a given and a reconstructed force; a mounting that is not quite straight makes less
CONTINUED = 0.1  # time of a continuation from a neighbouring prestretch, over that of a solve from rest, measured


class LossProfile(NamedTuple):
    """The lowest loss at each prestretch.

    Attributes:
        stretches: the prestretches, `[S]`, increasing.
        losses: the loss of each image, `[S, B]`.
    """

    stretches: np.ndarray
    losses: np.ndarray


class Presses:
    """B measured presses, which can be solved with different materials.

    Args:
        reconstructor: the sensor's reconstructor.
        displacement: displacements of its markers, `[B, D, 2]`, px.
        confidence: confidence of its markers, `[B, D]`.
        covariance: covariance of the displacements, `[B, D, 2, 2]`, px^2; default: twice the rest image's.
    """

    def __init__(
        self, reconstructor: Reconstructor, displacement: Tensor, confidence: Tensor, covariance: Tensor | None = None
    ):
        if covariance is None:
            covariance = (2 * reconstructor.observer.rest_covariance).expand(*displacement.shape, 2)
        self.reconstructor, self.measured = reconstructor, (displacement, confidence, covariance)
        self.observation = reconstructor.observation(*self.measured)

    def at_other_height(self, share: float) -> "Presses":
        """Return the presses on a rest surface whose height differs by this share; see `rest_error.at_other_height`."""
        return self._on(*at_other_height(self.reconstructor.sensor, self.rest_markers, share))

    def at_height(self, share: float) -> "Presses":
        """Return the presses on a rest surface that is higher by this share; see `rest_error.changed_height`."""
        return self._on(*changed_height(self.reconstructor.sensor, self.rest_markers, share))

    @property
    def rest_markers(self) -> np.ndarray:
        """Positions of the markers on the rest surface, `[D, 3]`."""
        positions: np.ndarray = self.reconstructor.rest_markers.double().numpy()
        return positions

    def _on(self, sensor: Sensor, kept: np.ndarray) -> "Presses":
        """Return the presses for a sensor with a subset of the markers, `kept` `[D]` bool."""
        return Presses(Reconstructor(sensor, dtype=torch.float64, check_rest=False), *(a[:, kept] for a in self.measured))

    def explained(self, stretch: float, modulus: float, grid: tuple[int, int] | None = None) -> Explained:
        """Return the estimator with this material on this grid (default: the reconstructor's), and its solution."""
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

    def profile_at(self, stretches: np.ndarray, progress: Progress) -> LossProfile:
        """Return the losses of the presses at given prestretches."""
        solutions = self._solutions(stretches, within(progress, 0.0, 1 - CONTINUED))
        return self._profile(solutions, within(progress, 1 - CONTINUED, 1.0))

    def profile(self, progress: Progress) -> LossProfile:
        """Return the losses of the presses at `STRETCHES`, and at further prestretches around the one of lowest loss."""
        work = np.array([len(STRETCHES), CONTINUED * len(STRETCHES), BETWEEN, CONTINUED * (len(STRETCHES) + BETWEEN)])
        ends = np.cumsum([0.0, *work / work.sum()]).tolist()
        solve, follow, solve_between, follow_all = (within(progress, *pair) for pair in zip(ends, ends[1:], strict=False))
        solutions = self._solutions(STRETCHES, solve)
        total = self._profile(solutions, follow).losses.sum(1)
        k = min(max(int(np.argmin(total)), 1), len(STRETCHES) - 2)
        between = np.geomspace(STRETCHES[k - 1], STRETCHES[k + 1], BETWEEN + 2)[1:-1]
        return self._profile(solutions | self._solutions(between, solve_between), follow_all)

    def _solutions(self, stretches: np.ndarray, progress: Progress) -> dict[float, Explained]:
        """Return the solutions at each prestretch, solved from rest."""
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

    def told(self, log_stretches: np.ndarray) -> PressesTold:
        """Return losses and forces at these log prestretches."""
        explained = [self.explained(float(np.exp(z)), self.reconstructor.sensor.material.modulus) for z in log_stretches]
        losses = np.array([float((self.observation.confidence.sum(-1) * found.unexplained).sum()) for _, found in explained])
        return PressesTold(losses, np.stack([np.linalg.norm(_forces(each), axis=1) for each in explained]))

    def gauge_modulus(
        self,
        log_stretch: float,
        deviation: float,
        pressures: KnownPressures,
        other: "Presses | None" = None,
        progress: Progress = silent,
    ) -> tuple[float, float, float, float, np.ndarray]:
        """Return the modulus from gauge readings.

        Args and results are like those of `modulus`: the modulus, its standard deviation at this prestretch, its change for one
        deviation of the prestretch, its change on the rest surface of another height, and the pressure changes, `[B, 2]`.
        """
        modulus = self.reconstructor.sensor.material.modulus
        progress(0.0, "modulus from pressures")
        fitted = self._gauge_fit(np.exp(log_stretch), modulus, pressures)
        changes = []
        for k, s in enumerate((-1, 1)):
            progress((k + 1) / 4, "modulus from pressures with the prestretch's error")
            at = self._gauge_fit(np.exp(log_stretch + s * deviation), fitted.modulus, pressures)
            changes.append(at.modulus - fitted.modulus)
        low, high = changes
        change = float(np.sign(high - low) * max(abs(low), abs(high)))
        progress(0.75, "modulus from pressures with the rest surface's error")
        moved = fitted if other is None else other._gauge_fit(np.exp(log_stretch), fitted.modulus, pressures)
        return fitted.modulus, fitted.deviation, change, moved.modulus - fitted.modulus, fitted.pressures

    def _gauge_fit(self, stretch: float, begin: float, pressures: KnownPressures) -> GaugeModulus:
        def found(modulus: float) -> FoundPressures:
            estimator, it = self.explained(stretch, modulus, PRESSURE_GRID)
            noise = estimator.equations.bearings.noise
            with torch.no_grad():
                spread = estimator.standard_deviations(it.vertices, it.pressure, it.moved, self.observation, noise)
            rest = float(estimator.rest_pressure)
            return FoundPressures((it.pressure - rest).numpy(), spread.pressure.numpy(), rest)

        gas = self.reconstructor.estimator.cavity.filling == "gas"
        return modulus_from_pressures(found, np.asarray(pressures.readings, float), pressures.since_rest, begin, gas)

    def modulus(
        self, log_stretch: float, deviation: float, known: KnownForces, progress: Progress = silent
    ) -> tuple[float, float, float, tuple[float, float], np.ndarray, list[tuple[int, float, float]]]:
        """Return the modulus from presses of known force.

        A gas has a stiffness in newtons, so with a gas the presses are solved again for each modulus.

        Args:
            log_stretch: logarithm of the prestretch.
            deviation: standard deviation of `log_stretch`.
            known: the known forces.
            progress: called with the completed share.

        Returns:
            The modulus; its standard deviation at this prestretch; its change for one deviation of the prestretch, the larger
            of the two sides and negative, because a membrane under more tension at rest needs a smaller modulus for the same
            force; the moduli on either side; reconstructed and measured magnitudes of forces, `[B, 2]`; and the images whose
            forces contradict the others, as returned by `odd_ones`.
        """
        forces, relative = known.forces, known.relative
        weight = relative**-2.0 / (relative**-2.0).sum()
        modulus = self.reconstructor.sensor.material.modulus
        progress(0.0, "modulus from forces")
        self._refuse_unpressed(float(np.exp(log_stretch)), modulus, np.isfinite(forces).all(1))
        if forces.shape[1] == 3:
            self._refuse_other_directions(float(np.exp(log_stretch)), modulus, forces)
        for _ in range(GAS_ROUNDS if self.reconstructor.estimator.cavity.filling == "gas" else 1):
            ratios, magnitudes = self._ratios(np.exp(log_stretch), modulus, forces)
            modulus = float((weight * ratios).sum() * modulus)
            if abs((weight * ratios).sum() - 1) < MODULUS_SETTLED:
                break
        progress(0.5, "modulus with the prestretch's error")
        sides = [(weight * self._ratios(np.exp(log_stretch + s * deviation), modulus, forces)[0]).sum() for s in (-1, 1)]
        change = -modulus * np.abs(np.array(sides) - 1).max()
        sure, mean = (relative**-2.0).sum() ** -0.5, (weight * ratios).sum()
        scatter = (((ratios / mean - 1) / relative) ** 2).sum() / max(len(ratios) - 1, 1)
        images = np.flatnonzero(np.isfinite(forces).all(1))
        odd = [(int(images[i]), ratio, apart) for i, ratio, apart in odd_ones(ratios, relative)]
        low, high = (modulus * float(side) for side in sides)
        return modulus, modulus * sure * max(1.0, scatter) ** 0.5, change, (low, high), magnitudes, odd

    def _refuse_unpressed(self, stretch: float, modulus: float, known: np.ndarray) -> None:
        """Raise an error if an image of known force (mask `[B]`) hardly shows a force."""
        estimator, it = self.explained(stretch, modulus)
        noise = estimator.equations.bearings.noise
        with torch.no_grad():
            spread = estimator.standard_deviations(it.vertices, it.pressure, it.moved, self.observation, noise)
        force = (it.traction * estimator.membrane.rest_area[:, None]).sum(1)
        unsure = (spread.force.norm(dim=1) > UNSURE * force.norm(dim=1)).numpy()
        for i in np.flatnonzero(known & unsure):
            raise MembraneError(
                f"calibrate material: image {i + 1} shows hardly any force, although a force is given for it; expected presses "
                "that dent the membrane visibly: leave out the image, or its force"
            )

    def _refuse_other_directions(self, stretch: float, modulus: float, forces: np.ndarray) -> None:
        """Raise an error if a known force `[B, 3]` points in another direction than the reconstructed one."""
        found = _forces(self.explained(stretch, modulus))
        lengths = np.linalg.norm(forces, axis=1) * np.linalg.norm(found, axis=1)
        cosines = (forces * found).sum(1) / np.maximum(lengths, np.finfo(float).tiny)
        for i in np.flatnonzero(cosines < np.cos(np.radians(LARGEST_ANGLE))):
            angle = np.degrees(np.arccos(cosines[i].clip(-1, 1)))
            raise MembraneError(
                f"calibrate material: image {i + 1}: the given force points {angle:.0f} degrees away from the force that the "
                f"image shows; expected at most {LARGEST_ANGLE:g}: give the force that acts on the membrane (not the reaction "
                "on the body), in the camera's frame, or its magnitude alone"
            )

    def _ratios(self, stretch: float, modulus: float, forces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return measured over reconstructed force for presses of known force, `[F]`, and reconstructed and measured magnitudes
        of all presses, `[B, 2]`."""
        found = _forces(self.explained(stretch, modulus))
        size, measured = np.linalg.norm(found, axis=1), np.linalg.norm(forces, axis=1)
        along = (forces * found).sum(1) / size if forces.shape[1] == 3 else measured
        return (along / size)[np.isfinite(along)], np.stack([size, measured], -1)


def _forces(explained: Explained) -> np.ndarray:
    """Return the reconstructed forces, `[B, 3]`."""
    estimator, equilibrium = explained
    found: np.ndarray = (equilibrium.traction * estimator.membrane.rest_area[:, None]).sum(1).numpy()
    return found
