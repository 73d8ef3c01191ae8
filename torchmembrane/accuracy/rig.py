"""A sensor in silico and its reconstructor: presses to images, images to results, results beside what is true."""

import warnings
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from ..markers.noise import pixel_noise
from ..reconstruct import Reconstructor
from ..results.reconstruction import Reconstruction
from ..results.status import Status
from ..sensor.sensor import Sensor
from ..sensor.working_range import UNLIMITED, turn_cosine
from ..simulate.appearance import Appearance, noisy
from ..simulate.quasi_static import Press, carried
from ..simulate.simulator import Simulator
from .presses import PairPress
from .spec_sheet import PairTrial, PressTrial, RestTrial

USUAL_NOISE = 40.0  # dB, where a rest image does not say
QUIETEST = 45.0  # dB, of a single frame, also where a rest image averages many


def image_noise(sensor: Sensor) -> float:
    """Noise of a sensor's images: white over its standard deviation, dB.

    As in its rest image, `QUIETEST` at most; `USUAL_NOISE` without one, and for texture, whose grain looks like noise.

    Example:
        >>> from torchmembrane.presets import preset
        >>> round(image_noise(preset("bubble")))
        39
    """
    image = sensor.markers.rest_image
    if image is None or sensor.markers.kind == "texture":
        return USUAL_NOISE
    deviation = max(float(pixel_noise(torch.from_numpy(image)[None, None])), 1e-9)
    return min(-20 * float(np.log10(deviation)), QUIETEST)


class Rig:
    """What trials of one sensor need.

    The simulator stands on a grid of its own, finer than the reconstructor's, with no line in common but the rim. The rest
    image is simulated as the presses are, in the same light.

    Args:
        sensor: the sensor.
        noise: noise of all images, dB below white.

    Attributes:
        simulator: that presses it and takes the images.
        reconstructor: that does not know what was pressed.
        seen: `[V]` bool, which of the reconstructor's vertices the camera sees at rest.

    Raises:
        MembraneError: the sensor cannot be simulated, or reconstructed.
    """

    def __init__(self, sensor: Sensor, noise: float):
        sensor.refuse_views("check --accuracy")
        self.simulator = Simulator(sensor, appearance=Appearance(noise=noise))
        simulated = replace(sensor.markers, rest_image=self.simulator.rest_image())
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # what is to be said of the sensor, its own reconstructor says
            self.reconstructor = Reconstructor(replace(sensor, markers=simulated, range=UNLIMITED))
        self.seen = self._in_image()

    def rest_trials(self, frames: int, seed: int) -> list[RestTrial]:
        """So many frames at rest, each with noise of its own."""
        rng = np.random.default_rng([seed, 0])
        with torch.no_grad():
            clean = self.simulator.renderer(self.simulator.membrane.rest)
            images = noisy(clean.expand(frames, *clean.shape), self.simulator.appearance.noise, rng)
            result = self.reconstructor((255 * images).round().byte())
        return rest_trials(result, self.seen)

    def press_trials(self, states: Sequence[Press], stroke: int, seed: int) -> list[PressTrial]:
        """One stroke's equilibria, photographed, reconstructed and compared."""
        result = self._reconstructed(states, np.random.default_rng([seed, 3, stroke]))
        return press_trials(stroke, states, self._displacement(states), result, self._normals(), self.seen, self._found())

    def pair_trials(self, pairs: Sequence[PairPress], direction: int, seed: int) -> list[PairTrial]:
        """One direction's pairs, photographed, reconstructed and compared."""
        result = self._reconstructed([pair.state for pair in pairs], np.random.default_rng([seed, 4, direction]))
        return pair_trials(direction, pairs, result)

    def _reconstructed(self, states: Sequence[Press], rng: np.random.Generator) -> Reconstruction:
        images = np.stack([self.simulator.image(state.vertices, rng) for state in states])
        with torch.no_grad():
            found: Reconstruction = self.reconstructor(images)
        return found

    def _displacement(self, states: Sequence[Press]) -> Tensor:
        """The true displacement `[F, V, 3]` at the reconstructor's vertices."""
        rest = self.reconstructor.sensor.membrane.rest.double()
        return carried(torch.stack([state.vertices for state in states]), self.simulator.membrane, rest) - rest

    def _normals(self) -> Tensor:
        return self.reconstructor.sensor.membrane.rest_normals.double()

    def _found(self) -> Tensor:
        """`[D]` bool, which markers are found at rest."""
        return self.reconstructor.observer.seen_at_rest

    def _in_image(self) -> Tensor:
        pixels = self.reconstructor.vertex_pixels
        inside = (pixels > -0.5) & (pixels < pixels.new_tensor(self.reconstructor.image_size) - 0.5)
        return inside.all(-1)


def rest_trials(result: Reconstruction, seen: Tensor) -> list[RestTrial]:
    """What frames at rest give.

    Args:
        result: result of B frames.
        seen: `[V]` bool, the vertices in view.
    """
    rms = result.displacement[:, seen].double().square().sum(-1).mean(-1).sqrt()
    contacts = result.contact_points[..., 0].isfinite().sum(-1)
    columns = rms, torch.linalg.vector_norm(result.force, dim=-1), result.pressure_change.abs(), contacts, result.status
    return [RestTrial(*row) for row in zip(*(column.tolist() for column in columns), strict=True)]


def press_trials(
    stroke: int,
    states: Sequence[Press],
    displacement: Tensor,
    result: Reconstruction,
    normals: Tensor,
    seen: Tensor,
    found: Tensor,
) -> list[PressTrial]:
    """What the results of one stroke are off by.

    Args:
        stroke: its number.
        states: the B true equilibria, of one indenter.
        displacement: true, at the result's vertices, `[B, V, 3]`.
        result: result of the B images.
        normals: outward at rest, `[V, 3]`.
        seen: `[V]` bool, the vertices in view.
        found: `[D]` bool, the markers found at rest.
    """
    true_force, centre = (torch.stack(values) for values in zip(*((s.force, s.contact_points[0]) for s in states), strict=True))
    size, off = torch.linalg.vector_norm(true_force, dim=-1), result.force.double() - true_force
    estimate, u = result.displacement.double()[:, seen], displacement[:, seen]
    depth, deep = (-(values * normals[seen]).sum(-1).amin(-1) for values in (u, estimate))
    miss = torch.linalg.vector_norm((estimate - u).flatten(1), dim=-1) / torch.linalg.vector_norm(u.flatten(1), dim=-1)
    place = torch.linalg.vector_norm(result.contact_points[:, 0].double() - centre, dim=-1)
    lost = (result.confidence[:, found] <= 0).double().mean(-1)
    columns = (
        size,
        depth,
        torch.linalg.vector_norm(off, dim=-1) / size,
        (deep - depth).abs(),
        place.nan_to_num(nan=torch.inf),
        miss,
        lost,
        (result.contact_at_rim == 1).any(-1),
        result.status,
        turn_cosine(result.normals.double(), normals).clamp(-1, 1).acos().rad2deg(),
    )
    return [PressTrial(stroke, *row) for row in zip(*(column.tolist() for column in columns), strict=True)]


def pair_trials(direction: int, pairs: Sequence[PairPress], result: Reconstruction) -> list[PairTrial]:
    """Which pairs are resolved.

    Args:
        direction: its number.
        pairs: B of them.
        result: result of the B images.
    """
    trials = []
    for pair, points, status in zip(pairs, result.contact_points.double(), result.status, strict=True):
        reported = points[points[:, 0].isfinite()]
        near = torch.cdist(pair.state.contact_points, reported) < pair.distance / 2
        told = bool(near.any(1).all()) and int(status) == Status.OK
        trials.append(PairTrial(direction, pair.distance, told))
    return trials
