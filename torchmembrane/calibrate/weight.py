"""Newtons from one known weight: the modulus with which the reconstruction says the force that is known."""

from dataclasses import replace
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from ..errors import MembraneError, check_arguments, expect
from ..files.grayscale import to_grayscale_batch
from ..progress import Progress, silent, within
from ..reconstruct import Reconstructor
from ..results.reconstruction import Reconstruction
from ..results.status import Status
from ..sensor.sensor import Sensor
from .gauge import CONTRADICTION, UNSURE
from .material import MaterialFit, material_from_images
from .presses import GAS_ROUNDS

SURE = 0.05  # relative standard deviation of the scale, at most: two of them are a tenth
AT_THE_RIM = 0.1  # share of the force in patches that reach the rim, from which on it is refused

MATERIAL_SHARE = 0.8  # of the time, measured: of `material_from_images`


class WeightFit(NamedTuple):
    """The sensor that says the weight's force.

    Attributes:
        sensor: with prestretch and modulus found.
        material: what `material_from_images` found, before the last scaling.
        forces: `[B]` magnitudes that the reconstruction then says, N.
        deviation: deviation of the scale of all forces, relative.
    """

    sensor: Sensor
    material: MaterialFit
    forces: np.ndarray
    deviation: float


@check_arguments
def material_from_weight(sensor: Sensor, images: Tensor, weight: float, *, progress: Progress = silent) -> WeightFit:
    """Prestretch and modulus from images of presses by one known force.

    Prestretch and a first modulus are `material_from_images`'; the modulus is then scaled until the sensor's own
    reconstruction, on its own grid, says the weight in the mean. Forces are proportional to it, so that the sensor's other
    forces are then right where their kind of press is, also if prestretch and modulus are both wrong.

    Args:
        sensor: the sensor, calibrated but for its material.
        images: `[B, 1, H, W]` grey in 0..1, each under the weight alone.
        weight: the force's magnitude, N.
        progress: is told how far it is.

    Returns:
        The sensor, and how surely its forces are scaled.

    Raises:
        MembraneError: a press reaches the rim, which bears a part of the weight; a force that the markers hardly tell, or a
            scale known worse than `SURE`; images that contradict one another; as of `material_from_images`.

    Limitations:
        The scale is that of presses such as these: pushed by the same weight elsewhere, or ten times as hard, the grid's and
        the material's errors are others (docs/recipes.md).
    """
    expect(0 < weight < np.inf, "calibrate material: weight", weight, "a positive force, N")
    images = to_grayscale_batch(images, sensor.camera.image_size, "rgb", torch.zeros((), dtype=torch.float64))
    known = np.full((len(images), 1), weight)
    material = material_from_images(sensor, images, known, progress=within(progress, 0.0, MATERIAL_SHARE))
    progress(MATERIAL_SHARE, "modulus from the weight")
    made = material.sensor
    gas = made.cavity.filling == "gas"
    for _ in range(GAS_ROUNDS if gas else 1):
        forces, deviations = _told(made, images)
        made = _stiffer(made, weight / _mean(forces, deviations))
    forces, deviations = _told(made, images)
    sigma = deviations * forces
    off = abs(forces - weight) / sigma
    if (off > CONTRADICTION).any():
        apart = abs(forces - np.median(forces)) / sigma
        odd = np.flatnonzero(apart >= min(CONTRADICTION, apart.max()))
        shown = ", ".join(f"image {i + 1} shows {forces[i] / np.median(forces):.3g}" for i in odd)
        raise MembraneError(
            f"calibrate material: the images contradict one another: {shown} times the others' force; expected images "
            "under this weight alone: leave out what is not"
        )
    scatter = float(np.sqrt((((forces - weight) / sigma) ** 2).sum() / max(len(forces) - 1, 1)))
    deviation = float((deviations**-2).sum() ** -0.5 * max(1.0, scatter))
    if deviation > SURE:
        raise MembraneError(
            f"calibrate material: the weight tells the scale of forces to {deviation:.1%} only; expected {SURE:.0%} at most, "
            "for forces right to a tenth: a heavier weight, or several photographs of it"
        )
    return WeightFit(made, material, forces, deviation)


def _mean(forces: np.ndarray, deviations: np.ndarray) -> float:
    return float(np.average(forces, weights=deviations**-2))


def _stiffer(sensor: Sensor, ratio: float) -> Sensor:
    modulus = sensor.material.shear_modulus
    assert modulus is not None  # as `material_from_images` has found it
    return replace(sensor, material=replace(sensor.material, shear_modulus=ratio * modulus))


def _told(sensor: Sensor, images: Tensor) -> tuple[np.ndarray, np.ndarray]:
    """Magnitudes of the forces in the images, `[B]`, and their relative deviations; refused where they tell no scale."""
    with torch.no_grad():
        found_now = replace(sensor, record=sensor.record._replace(uncertainty=None))  # of the scale, which is looked for
        result: Reconstruction = Reconstructor(found_now)(images)
    forces = result.force.norm(dim=1).double().numpy()
    along = (result.force_deviation * result.force).norm(dim=1).double().numpy() / forces.clip(1e-12)
    deviations = along / forces.clip(1e-12)
    for i, status in enumerate(result.status.tolist()):
        if status != Status.OK:
            raise MembraneError(f"calibrate material: image {i + 1}: {Status(status).text}; leave it out")
        at_rim = (result.contact_at_rim[i] > 0) * result.contact_force[i].norm(dim=1).nan_to_num()
        if at_rim.sum() > AT_THE_RIM * forces[i]:
            raise MembraneError(
                f"calibrate material: image {i + 1}: the press reaches the rim, which bears a part of the weight; expected the "
                "weight in the middle of the membrane, and the rest surface where the file has it (`calibrate rest`)"
            )
        if not deviations[i] < UNSURE:
            raise MembraneError(
                f"calibrate material: image {i + 1} shows a force that is known to {100 * deviations[i]:.0f} % only; expected "
                "a weight that dents the membrane visibly: a heavier one"
            )
    return forces, deviations
