"""Presses of the preset sensors for the figures: simulated on a finer grid, rendered with 30 dB noise, reconstructed."""

from functools import cache
from typing import NamedTuple

import numpy as np
import torch

from torchmembrane import Reconstruction, Reconstructor, Status
from torchmembrane.estimators.minimum_energy.segmentation import ContactRegions
from torchmembrane.estimators.paper.estimator import Segmented
from torchmembrane.presets import preset_file
from torchmembrane.simulate import Appearance, Cylinder, Simulator, Sphere, press

NOISE_LEVEL = 30.0  # dB below white
PAPER, ENERGY, BALANCE = "the paper", "minimum energy", "force balance"
ESTIMATORS = {
    PAPER: {"estimator": "paper", "locator": "soft"},
    ENERGY: {"estimator": "minimum-energy"},
    BALANCE: {"estimator": "force-balance"},
}

TOP = ((1.2, (0, 0, 6), (-0.35, -0.1, -1.0), 2.5),)
TWO = ((1.5, (0, 0, 6), (-0.7, -0.2, -1.0), 1.8), (1.5, (0, 0, 6), (0.7, 0.3, -1.0), 1.5))
SIDE = ((3.0, (0, 0, 24), (0.0, -0.8, -0.6), 2.5, (1, 0, 0)),)
BOTH_SIDES = tuple((3.0, (0, 0, 24), (0.0, side, -0.6), 1.2, (1, 0, 0)) for side in (-0.8, 0.8))
BUBBLE = ((7.0, (0, 0, 45), (-0.3, 0.2, -1.0), 6.0),)


class Shown(NamedTuple):
    """One simulated press: image `[H, W]` in 0..1, the dots' true places and pixels `[D, ...]`, the true contacts `[I, 3]`."""

    sensor: str
    image: np.ndarray
    rest_dots: np.ndarray
    dots: np.ndarray
    pixels: np.ndarray
    contacts: np.ndarray


@cache
def simulator(sensor: str) -> Simulator:
    return Simulator(reconstructor(sensor).sensor, appearance=Appearance(noise=NOISE_LEVEL))


@cache
def reconstructor(sensor: str, title: str = ENERGY) -> Reconstructor:
    return Reconstructor.from_file(preset_file(sensor), **ESTIMATORS[title])


@cache
def pressed(sensor: str, *strokes) -> Shown:
    """Bodies `(radius, from, travel, depth)` or `(radius, from, travel, depth, axis)` pressed at once, without friction."""
    sim, paths = simulator(sensor), []
    for radius, start, travel, depth, *axis in strokes:
        unit = torch.nn.functional.normalize(torch.tensor(travel, dtype=torch.float64), dim=0)
        body = Cylinder(radius, axis=axis[0], translation=start) if axis else Sphere(radius, translation=start)
        body = body.touching(sim.membrane, unit)
        paths.append([body, body.moved(depth * unit)])
    state = press(sim.membrane, sim.elasticity, paths, **sim.cavity)
    dots, rest = sim.renderer.dots(state.vertices), sim.rest_dots
    image = sim.image(state.vertices, np.random.default_rng(0)) / 255
    arrays = (rest.positions, dots.positions, dots.pixels, state.contact_points)
    return Shown(sensor, image.astype(np.float32), *(np.asarray(a) for a in arrays))


@cache
def reconstructed(sensor: str, strokes, title: str) -> Reconstruction:
    with torch.no_grad():
        return reconstructor(sensor, title)(torch.from_numpy(pressed(sensor, *strokes).image))


def from_flow(r: Reconstructor, flow: torch.Tensor, trust: torch.Tensor) -> Reconstruction:
    """Displacements `[B, D, 2]` px and confidence `[B, D]`, as they are given: no screen."""
    with torch.no_grad():
        covariance = r.observer.rest_covariance.expand(len(flow), -1, -1, -1)
        usable, trust, _, status = r.observer.judge(flow, trust, covariance, torch.full((len(flow),), Status.OK.value))
        return r.result(r.estimator(r.observation(usable, trust)), flow, trust, status)


def measured_flow(shown: Shown, result: Reconstruction) -> torch.Tensor:
    """Displacements of the dots `[D, 2]` px, NaN where lost."""
    return result.pixels[0] - reconstructor(shown.sensor).rest_pixels


def segmented(shown: Shown, result: Reconstruction) -> Segmented:
    """What the paper's loop of reconstruction and segmentation ends with, from the markers of its result."""
    r = reconstructor(shown.sensor, PAPER)
    with torch.no_grad():
        rays = r.observation((result.pixels - r.rest_pixels).nan_to_num(), result.confidence)
        return r.estimator.reconstruct_and_segment(rays, r.estimator.settings.rounds)


def contact_regions(shown: Shown, result: Reconstruction) -> ContactRegions:
    """Where the surface of minimum energy lies inside the rest surface."""
    with torch.no_grad():
        return reconstructor(shown.sensor, ENERGY).estimator.segmentation.by_normals(result.vertices)


def error_words(shown: Shown, result: Reconstruction) -> str:
    """The error at the dots and their displacement, in words, and the status of a frame that is not well."""
    words = relative_words(result.markers[0].numpy() - shown.dots, shown.dots - shown.rest_dots)
    status = Status(int(result.status[0]))
    return words if status == Status.OK else f"{words}; {status.text.partition(':')[0]}"


def relative_words(error: np.ndarray, moved: np.ndarray) -> str:
    """Rms of errors and of displacements, `[D, ...]`, in words."""
    error, moved = (float(np.sqrt((a**2).sum(1).mean())) for a in (error, moved))
    return f"error {error:.3f} of {moved:.3f} mm ({100 * error / moved:.0f} %)"


def contact_words(found: np.ndarray, true: np.ndarray) -> str:
    """How many contacts `[P, 3]` were found, NaN where none, and how far from the true ones `[I, 3]`, in words."""
    found = found[np.isfinite(found).all(1)]
    if not len(found):
        return "none found"
    gap = np.linalg.norm(found[:, None] - true, axis=2)
    return f"{len(found)} found; in space {max(gap.min(0).mean(), gap.min(1).mean()):.2f} mm from the true"
