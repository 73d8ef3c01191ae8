"""Force scale from one known weight: the modulus with which the reconstructed force equals the known force."""

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
from ..torch_modes import on_cpu
from .gauge import CONTRADICTION, UNSURE
from .material import MaterialFit, material_from_images
from .presses import GAS_ROUNDS

SURE = 0.05  # largest relative standard deviation of the scale; twice this is a tenth
AT_THE_RIM = 0.1  # largest share of the force in contacts that reach the rim

MATERIAL_SHARE = 0.8  # share of the time that `material_from_images` takes, measured


class WeightFit(NamedTuple):
    """The sensor whose reconstructed force equals the weight.

    Attributes:
        sensor: the sensor with prestretch and modulus.
        material: result of `material_from_images`, before the final scaling.
        forces: magnitudes of the forces reconstructed with this sensor, `[B]`, N.
        deviation: relative standard deviation of the scale of forces.
    """

    sensor: Sensor
    material: MaterialFit
    forces: np.ndarray
    deviation: float


@check_arguments
@on_cpu
def material_from_weight(sensor: Sensor, images: Tensor, weight: float, *, progress: Progress = silent) -> WeightFit:
    """Infer prestretch and modulus from images of presses by one known force.

    `material_from_images` gives the prestretch and an initial modulus. The modulus is then scaled until the mean force that the
    sensor reconstructs on its own grid equals the weight. Forces are proportional to the modulus, so other forces of similar
    presses are then accurate even if prestretch and modulus are both wrong.

    Args:
        sensor: the sensor, calibrated except for its material.
        images: grey images, `[B, 1, H, W]`, in 0..1; in each, only the weight touches the membrane.
        weight: magnitude of the force, N.
        progress: called with the completed share.

    Returns:
        The `WeightFit`, with the uncertainty of the force scale.

    Raises:
        MembraneError: a press reaches the rim, which bears a part of the weight; a force hardly shows in the markers; the scale
            is less accurate than `SURE`; images contradict one another; or as for `material_from_images`.

    Limitations:
        The scale is valid for similar presses: with the same weight at another place, or ten times the force, the errors of
        grid and material differ (docs/recipes.md).
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
            f"calibrate material: the images contradict each other: {shown} times the others' force; expected images "
            "under this weight alone: leave out what is not"
        )
    scatter = float(np.sqrt((((forces - weight) / sigma) ** 2).sum() / max(len(forces) - 1, 1)))
    deviation = float((deviations**-2).sum() ** -0.5 * max(1.0, scatter))
    if deviation > SURE:
        raise MembraneError(
            f"calibrate material: the weight determines the scale of forces only to {deviation:.1%}; expected {SURE:.0%} at "
            "most, so that forces are accurate to 10%: use a heavier weight, or take several photographs of it"
        )
    return WeightFit(made, material, forces, deviation)


def _mean(forces: np.ndarray, deviations: np.ndarray) -> float:
    return float(np.average(forces, weights=deviations**-2))


def _stiffer(sensor: Sensor, ratio: float) -> Sensor:
    modulus = sensor.material.shear_modulus
    assert modulus is not None  # `material_from_images` has set it
    return replace(sensor, material=replace(sensor.material, shear_modulus=ratio * modulus))


def _told(sensor: Sensor, images: Tensor) -> tuple[np.ndarray, np.ndarray]:
    """Return magnitudes of reconstructed forces, `[B]`, and their relative standard deviations; raise an error if a press is
    unsuitable."""
    with torch.no_grad():
        found_now = replace(sensor, record=sensor.record._replace(uncertainty=None))  # the scale is what is sought
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
                f"calibrate material: image {i + 1} shows a force whose relative error is {100 * deviations[i]:.0f} %; "
                "expected a weight that dents the membrane visibly: a heavier one"
            )
    return forces, deviations
