"""A simulated sensor and its reconstructor: presses to images, images to results, and results compared with the truth."""

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

USUAL_NOISE = 40.0  # dB, if a rest image does not show it
QUIETEST = 45.0  # dB, lowest noise assumed for a frame, as a rest image may be a mean of many frames


def image_noise(sensor: Sensor) -> float:
    """Return the noise of a sensor's images, white level over standard deviation, dB.

    It is estimated from the rest image and limited to `QUIETEST`. Without a rest image, and for texture, whose grain resembles
    noise, it is `USUAL_NOISE`.

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
    """Simulator and reconstructor for the trials of one sensor, with one camera or several views.

    The simulator's grid is finer than the reconstructor's and shares no line with it except the rim. The rest image is
    simulated like the presses, with the same illumination.

    Args:
        sensor: the sensor.
        noise: noise of all images, dB below white.

    Attributes:
        simulator: the simulator, which presses the membrane and renders images.
        reconstructor: the reconstructor, which has no access to the true presses.
        seen: which of the reconstructor's vertices any camera sees at rest, `[V]` bool.

    Raises:
        MembraneError: the sensor cannot be simulated, or reconstructed.
    """

    def __init__(self, sensor: Sensor, noise: float):
        self.simulator = Simulator(sensor, appearance=Appearance(noise=noise))
        at_rest = self.simulator.at_rest()
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # a user's reconstructor of the sensor issues these warnings
            self.reconstructor = Reconstructor(replace(at_rest, range=UNLIMITED))
        self.seen = self._in_image()

    def rest_trials(self, frames: int, seed: int) -> list[RestTrial]:
        """Reconstruct frames at rest with independent noise."""
        rng = np.random.default_rng([seed, 0])
        if self.simulator.sensor.views:
            at_rest = self.simulator.membrane.rest
            return rest_trials(self._found_in([self.simulator.images(at_rest, rng) for _ in range(frames)]), self.seen)
        with torch.no_grad():
            clean = self.simulator.renderer(self.simulator.membrane.rest)
            images = noisy(clean.expand(frames, *clean.shape), self.simulator.appearance.noise, rng)
            result = self.reconstructor((255 * images).round().byte())
        return rest_trials(result, self.seen)

    def press_trials(self, states: Sequence[Press], stroke: int, seed: int) -> list[PressTrial]:
        """Render the equilibria of one stroke, reconstruct them and compare the results with the truth."""
        result = self._reconstructed(states, np.random.default_rng([seed, 3, stroke]))
        return press_trials(stroke, states, self._displacement(states), result, self._normals(), self.seen, self._found())

    def pair_trials(self, pairs: Sequence[PairPress], direction: int, seed: int) -> list[PairTrial]:
        """Render the pairs of one direction, reconstruct them and compare the results with the truth."""
        result = self._reconstructed([pair.state for pair in pairs], np.random.default_rng([seed, 4, direction]))
        return pair_trials(direction, pairs, result)

    def _reconstructed(self, states: Sequence[Press], rng: np.random.Generator) -> Reconstruction:
        return self._found_in([self.simulator.images(state.vertices, rng) for state in states])

    def _found_in(self, frames: Sequence[Sequence[np.ndarray]]) -> Reconstruction:
        """Reconstruct frames, each of which is one image, or one image per view."""
        images = [np.stack(of_view) for of_view in zip(*frames, strict=True)]
        with torch.no_grad():
            found: Reconstruction = self.reconstructor(images if self.simulator.sensor.views_apart else images[0])
        return found

    def _displacement(self, states: Sequence[Press]) -> Tensor:
        """Return the true displacements at the reconstructor's vertices, `[F, V, 3]`."""
        rest = self.reconstructor.sensor.membrane.rest.double()
        return carried(torch.stack([state.vertices for state in states]), self.simulator.membrane, rest) - rest

    def _normals(self) -> Tensor:
        return self.reconstructor.sensor.membrane.rest_normals.double()

    def _found(self) -> Tensor:
        """Return which markers any view finds at rest, `[D]` bool."""
        seen = self.reconstructor.observer.seen_at_rest
        return seen.view(-1, len(self.reconstructor.rest_markers)).any(0)

    def _in_image(self) -> Tensor:
        sensor, pixels = self.reconstructor.sensor, self.reconstructor.vertex_pixels
        inside = _within(pixels, sensor.camera.image_size)
        for view in sensor.views[1:]:
            at_rest = view.camera.point_to_pixel(view.pose.inverse.points(sensor.membrane.rest))
            inside |= _within(at_rest.to(pixels), view.camera.image_size)
        return inside


def _within(pixels: Tensor, image_size: tuple[int, int]) -> Tensor:
    return ((pixels > -0.5) & (pixels < pixels.new_tensor(image_size) - 0.5)).all(-1)


def rest_trials(result: Reconstruction, seen: Tensor) -> list[RestTrial]:
    """Evaluate frames at rest.

    Args:
        result: reconstruction of B frames.
        seen: mask of the vertices in view, `[V]` bool.
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
    """Compute the errors of the results of one stroke.

    Args:
        stroke: number of the stroke.
        states: the B true equilibria, with one indenter.
        displacement: true displacement of the result's vertices, `[B, V, 3]`.
        result: reconstruction of the B images.
        normals: outward normals at rest, `[V, 3]`.
        seen: mask of the vertices in view, `[V]` bool.
        found: mask of the markers found at rest, `[D]` bool.
    """
    true_force, centre = (torch.stack(values) for values in zip(*((s.force, s.contact_points[0]) for s in states), strict=True))
    size, off = torch.linalg.vector_norm(true_force, dim=-1), result.force.double() - true_force
    estimate, u = result.displacement.double()[:, seen], displacement[:, seen]
    depth, deep = (-(values * normals[seen]).sum(-1).amin(-1) for values in (u, estimate))
    miss = torch.linalg.vector_norm((estimate - u).flatten(1), dim=-1) / torch.linalg.vector_norm(u.flatten(1), dim=-1)
    place = torch.linalg.vector_norm(result.contact_points[:, 0].double() - centre, dim=-1)
    confidence = result.confidence.reshape(len(size), -1, len(found)).amax(1)  # of the view with the highest confidence
    lost = (confidence[:, found] <= 0).double().mean(-1)
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
    """Determine which pairs are resolved.

    Args:
        direction: number of the direction.
        pairs: the B pairs.
        result: reconstruction of the B images.
    """
    trials = []
    for pair, points, status in zip(pairs, result.contact_points.double(), result.status, strict=True):
        reported = points[points[:, 0].isfinite()]
        near = torch.cdist(pair.state.contact_points, reported) < pair.distance / 2
        told = bool(near.any(1).all()) and int(status) == Status.OK
        trials.append(PairTrial(direction, pair.distance, told))
    return trials
