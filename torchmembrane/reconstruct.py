"""From images to surfaces: `Reconstructor`, an `nn.Module` that holds all constants of one sensor."""

import copy
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from .camera.rig import turns_by_noise
from .control_flow import can_sync, in_inference_mode, traced
from .errors import MembraneError, check_arguments, expect
from .estimators.base import Equilibrium, Estimator, Observation, StandardDeviations
from .estimators.contacts import Contacts
from .estimators.precision import PRECISIONS, FullPrecision, full_precision
from .estimators.registry import built_estimator, estimator_kind, refuse_unfit
from .estimators.sensor_problem import LEAST_ERROR, problem_of
from .files.grayscale import CHANNELS, Channels, to_grayscale_batch
from .files.images import read_image
from .files.tensors import tensor_of
from .markers.coverage import LEAST_COVERAGE, Coverage, facings
from .markers.observer import FOUND_CONFIDENCE, MarkerFlow
from .markers.sightings import sightings
from .mechanics.principal import FIELDS, principal_fields
from .results.frame_status import broken_down, is_seen
from .results.reconstruction import Reconstruction
from .results.status import Status
from .sensor.factories import cavity_filling, elastic_energy
from .sensor.sensor import Sensor
from .sensor.view_images import grey_views, read_views
from .state_dict import drop_derived_buffers
from .surface.bicubic import bicubic_shares
from .surface.levers import Levers
from .torch_modes import on_cpu

MODEL_ERROR = 0.004  # error of the model's marker positions, over the rms displacement of all markers
LARGEST_RESIDUAL = 1.5  # px, largest residual of a plausible solution, however noisy the image


class Reconstructor(FullPrecision):
    """Reconstructs surfaces from the images of one sensor, or with `from_pixels` from markers located elsewhere.

    Args:
        sensor: the `Sensor`; `Reconstructor.from_file` reads it from a file.
        estimator: "force-balance"; "minimum-energy", which finds no tractions and flattens narrow and distant contacts;
            "paper", the paper's linear harmonic method with its contact segmentation; or your own: its registered name,
            "module:Class", or the class.
        settings: an instance of that estimator's `Settings`, such as `ForceBalanceSettings`; default: `Settings()`.
        model: elastic energy, "harmonic" | "neo_hookean" | "mooney_rivlin"; default: the sensor's.
        channels: order of the channels of colour images, "rgb" or "bgr".
        dtype: precision of images and results, torch.float32 or torch.float64; slack sheets are always solved in float64.
        locator: how markers are found in images: "fit", by least squares, or "soft", by soft-argmax of filter responses;
            default: "soft" for the estimator "paper", otherwise "fit".
        check_rest: whether to refuse a rest image that deviates from the model by more than a calibration error could explain.

    Raises:
        MembraneError: the estimator or locator is unknown, the settings belong to another estimator, the camera cannot see the
            membrane or its markers, or the rest image contradicts the sensor.

    Example:
        >>> reconstructor = Reconstructor.from_file("examples/sensor.toml")
        >>> result = reconstructor(reconstructor.read("examples/two_contacts.png"))
        >>> int(result.status[0]), list(result.vertices.shape)
        (0, [1, 1089, 3])
    """

    vertex_pixels: Tensor
    rest_markers: Tensor
    marker_shares: Tensor

    @check_arguments
    @on_cpu
    def __init__(
        self,
        sensor: Sensor,
        estimator: str | type[Estimator] = "force-balance",
        *,
        settings: Any = None,
        model: str | None = None,
        channels: Channels = "rgb",
        dtype: torch.dtype = torch.float32,
        locator: str | None = None,
        check_rest: bool = True,
    ):
        super().__init__()
        name, kind = estimator_kind(estimator)
        locator = locator or kind.default_locator
        if channels not in CHANNELS:
            raise MembraneError(f"Reconstructor: channels = {channels!r}; expected 'rgb' or 'bgr'")
        if dtype not in PRECISIONS:
            raise MembraneError(f"Reconstructor: dtype = {dtype}; expected torch.float32 or torch.float64")
        self.sensor, self.estimator_name, self.locator_name, self.channels = sensor, name, locator, channels
        self.image_size, self.model = sensor.image_size, model or sensor.material.model
        self.range = sensor.range.for_fingerprint(sensor.fingerprint)
        refuse_unfit(sensor, name, kind)
        membrane = copy.deepcopy(sensor.membrane)
        seen = sightings(sensor, locator, dtype, kind.needs_every_vertex, check_rest)
        cavity = cavity_filling(sensor, membrane, warn=True)
        self.observer, self.camera, self.marker_points = seen.observer, seen.camera, seen.markers.points
        positions, levers = torch.from_numpy(seen.markers.positions), seen.markers.levers
        self.levers = None if levers is None else Levers(membrane, self.marker_points, torch.from_numpy(levers))
        problem = problem_of(seen, membrane, elastic_energy(sensor, membrane, model), cavity, sensor.material.friction)
        self.register_buffer("vertex_pixels", seen.vertex_pixels)
        self.register_buffer("rest_markers", positions)
        shares = bicubic_shares(self.marker_points, membrane.grid, membrane.fixed)
        self.register_buffer("marker_shares", torch.from_numpy(shares))
        tips = positions if levers is None else positions + torch.from_numpy(levers)
        facing = self._facings(tips, self.marker_shares @ membrane.rest_normals)
        self.coverage = Coverage(membrane, positions, self.observer.seen_at_rest, facing)
        self.to(dtype)
        self._solve_by(built_estimator(problem, name, kind, settings), dtype)
        drop_derived_buffers(self)

    def _solve_by(self, estimator: Estimator, dtype: torch.dtype) -> None:
        """Use this estimator in precision `dtype`, or in float64 if it requires that (slack sheets), then with inputs in
        float64."""
        self.estimator = estimator if estimator.solves_in_double else estimator.to(dtype)
        if estimator.solves_in_double:
            self.observer.be_exact()

    @classmethod
    @check_arguments
    def from_file(cls, path: str | Path, estimator: str | type[Estimator] = "force-balance", **options: Any) -> "Reconstructor":
        """Return the reconstructor of a sensor file; the options are those of the class."""
        sensor = Sensor.from_file(path)
        try:
            return cls(sensor, estimator, **options)
        except MembraneError as error:
            raise MembraneError(f"{path}: {error}") from error

    @property
    def rest_pixels(self) -> Tensor:
        """Return the pixels of the markers at rest according to the model, `[D, 2]` px; for several views `[W, D, 2]`."""
        return self.observer.by_view(self.observer.rest_pixels[None])[0]

    @property
    def rest_pressure(self) -> Tensor:
        """Return the pressure difference across the membrane at rest, `[]`, force / length^2."""
        return self.estimator.rest_pressure

    @property
    def finds_tractions(self) -> bool:
        """Return whether the estimator finds tractions and standard deviations."""
        return self.estimator.finds_tractions

    @check_arguments
    def read(self, *paths: str | Path) -> Tensor:
        """Read image files as a batch `[B, 1, height, width]` in 0..1, in this module's precision and on its device. If views
        have separate images, pass the first view's, NAME_VIEW; the others lie beside it, and an unreadable one becomes NaN."""
        expect(len(paths) > 0, "Reconstructor.read: paths", list(paths), "one image file or more")
        if self.sensor.views_apart:
            return torch.cat([read_views(Path(path), self.sensor.views, self.rest_pixels).grey for path in paths])
        images = [read_image(path, self.image_size, self.sensor.camera.bits) for path in paths]
        return torch.cat([to_grayscale_batch(image, self.image_size, "rgb", self.rest_pixels) for image in images])

    def forward(
        self,
        images: Tensor | np.ndarray,
        previous: Reconstruction | None = None,
        rest_pixels: Tensor | None = None,
        pressure: Tensor | float | None = None,
    ) -> Reconstruction:
        """Reconstruct a batch of images.

        Args:
            images: torch or numpy, uint8, uint16 or float in 0..1: `[H, W]`, `[H, W, 3]`, `[B, H, W]`, `[B, 1 | 3, H, W]` or
                `[B, H, W, 1 | 3]`; for W views a list of W of these, None if missing. Grey is 0.299 R + 0.587 G + 0.114 B.
            previous: results of the preceding frames, where the search for dots starts; that for texture starts from rest.
            rest_pixels: `[D, 2]`, the markers as `locate` finds them without contact; default: those in the rest image.
            pressure: `[B]` or a number, measured pressure difference across the membrane in the result's unit, NaN where not
                measured (force balance only; noise: `pressure_noise`). To a measured change since rest, add `rest_pressure`.

        Returns:
            A `Reconstruction`. A frame that cannot be reconstructed gets a status and NaN; the others are not affected.

        Raises:
            MembraneError: the size, shape or type is wrong, `previous` belongs to another batch or sensor, or a pressure is
                given for an open cavity or for another estimator.
        """
        with full_precision(self.rest_pixels):
            grey = self.grey(images)
            before = None if previous is None else self.observer.before(previous, len(grey))
            rest = None if rest_pixels is None else self.observer.rest_given(rest_pixels)
            return self.reconstruct_grey(grey, before, rest, pressure)

    def grey(self, images: Tensor | np.ndarray) -> Tensor:
        """Convert images, in any form that `forward` accepts, to grey images `[B, 1, height, width]` in 0..1."""
        if self.sensor.views_apart:
            return grey_views(images, self.sensor.views, self.channels, self.rest_pixels)
        return to_grayscale_batch(images, self.image_size, self.channels, self.rest_pixels, self.sensor.camera.bits)

    def reconstruct_grey(
        self,
        grey: Tensor,
        before: Tensor | None = None,
        rest_pixels: Tensor | None = None,
        pressure: Tensor | float | None = None,
    ) -> Reconstruction:
        """Do the same as `forward` with grey images `[B, 1, height, width]` in 0..1, in this module's precision, and the
        `pixels [B, D, 2]` of the preceding frames; nothing is checked."""
        return in_inference_mode(self._seen, grey, before, rest_pixels, pressure)

    def from_pixels(
        self,
        pixels: Tensor,
        confidence: Tensor | None = None,
        rest_pixels: Tensor | None = None,
        pressure: Tensor | float | None = None,
        noise: float | None = None,
    ) -> Reconstruction:
        """Reconstruct from marker centres located elsewhere; those that contradict their neighbours get confidence 0.

        Args:
            pixels: `[B, D, 2]` or `[D, 2]` in the order of the sensor file, NaN for lost markers; for W views `[B, W, D, 2]`.
            confidence: `[B, D]` or `[D]` in 0..1, for W views `[B, W, D]`; default: 1 where the pixels are finite.
            rest_pixels: `[D, 2]`, for W views `[W, D, 2]`, the same markers at rest; default: the model's rest pixels.
            pressure: measured pressure, as for `forward`.
            noise: standard deviation of a marker's u and v, px; default: 0.05, and at rest that of the rest image.

        Raises:
            MembraneError: the shape is wrong, or a confidence lies outside 0..1.
        """
        with full_precision(self.rest_pixels):
            return in_inference_mode(self._solve, self.observer.from_pixels(pixels, confidence, rest_pixels, noise), pressure)

    def _seen(self, grey: Tensor, before: Tensor | None, rest: Tensor | None, *gauge: Any) -> Reconstruction:
        return self._solve(self.observer(grey, before, rest), *gauge)

    def _solve(self, flow: MarkerFlow, pressure: Tensor | float | None) -> Reconstruction:
        usable, confidence, covariance, status = self.observer.judge(*flow)
        observation = self._gauged(self.observation(usable, confidence, covariance), pressure)
        found = self.estimator(observation)
        if (broken := broken_down(status, found.vertices)) is not None:
            return self._solve(flow._replace(status=broken), pressure)
        return self.result(found, observation, flow.displacement, confidence, status)

    @traced
    def observation(self, displacement: Tensor, confidence: Tensor, covariance: Tensor | None = None) -> Observation:
        """Return the estimator's input, from the markers' displacements `[B, D, 2]` px, confidence `[B, D]` and covariance
        `[B, D, 2, 2]` px^2; default: twice the covariance of the markers in the rest image."""
        covariance = 2 * self.observer.rest_covariance if covariance is None else covariance
        found = (confidence > 0).to(confidence.dtype)
        square = (found * displacement.square().sum(-1)).sum(-1) / found.sum(-1).clamp_min(1)
        one = torch.eye(2, dtype=covariance.dtype, device=covariance.device)
        error = (LEAST_ERROR**2 + MODEL_ERROR**2 * square)[:, None, None, None] * one
        pixels = self.observer.with_rays(self.observer.rest_pixels + displacement, confidence)
        return self.estimator.prepare(self.camera, pixels, confidence, covariance + error)

    @traced
    def result(
        self, found: Equilibrium, observation: Observation, displacement: Tensor, confidence: Tensor, status: Tensor
    ) -> Reconstruction:
        """Return the results of the frames, NaN where no surface was found."""
        membrane, lost, x = self.estimator.membrane, confidence <= FOUND_CONFIDENCE, found.vertices
        u = x - membrane.rest
        markers = self.rest_markers + self.marker_shares @ u.to(self.marker_shares)
        markers = markers if self.levers is None else markers + self.levers(u.to(markers)).levers
        pixels, by_view = self.observer.rest_pixels + displacement, self.observer.by_view
        modelled = self.camera.point_to_pixel(self.observer.seen_by_each(markers)) + self.camera.shift_of(found.moved, pixels)
        miss2 = torch.where(lost, 0.0, ((modelled - pixels) ** 2).sum(-1))
        normals, broken = membrane.normals(x), ~x.flatten(1).isfinite().all(1)
        in_view = self.coverage.in_view(confidence, self._facings(markers, self.marker_shares @ normals.to(markers)))
        residual = (by_view(miss2).sum(-1) / (~by_view(lost)).sum(-1).clamp_min(1)).sqrt()
        gone, status = ~is_seen(status) | broken, self._judged(status, found, normals, residual, in_view, broken)
        contacts, load = self.estimator.contacts(found, normals), found.traction * membrane.rest_area[:, None]
        wrench, record = torch.cat([load, torch.linalg.cross(x, load)], -1).sum(1), self.sensor.record
        deviations = self.estimator.deviations(found, observation, contacts).calibrated(wrench[:, :3], record.uncertainty)
        values = dict(
            vertices=x,
            displacement=u,
            normals=normals,
            markers=markers,
            traction=found.traction,
            contact=contacts.indicator,
            force=wrench[:, :3],
            pressure=found.pressure,
            pressure_change=found.pressure - self.estimator.rest_pressure,
            volume_error=self.estimator.cavity.volume_error(found.volume, found.pressure),
            residual=residual,
            wrench=wrench,
            coverage=self.coverage(confidence),
            camera_motion=self.camera.motion_in_words(found.moved),
            force_deviation=deviations.force,
            depth_deviation=deviations.depth,
            **{f"contact_{name}": getattr(contacts, name) for name in Contacts._fields[1:]},
        )
        kept = {name: value.to(markers) for name, value in values.items()}
        if not (can_sync(gone) and gone.is_cpu and torch.is_inference_mode_enabled()) or bool(gone.any()):
            kept = {k: torch.where(gone.reshape(-1, *(1,) * (value.ndim - 1)), torch.nan, value) for k, value in kept.items()}
        measured = by_view(torch.where(lost[..., None], torch.nan, pixels).to(markers))
        return Reconstruction(pixels=measured, confidence=by_view(confidence), status=status.to(torch.int32), **kept)

    def _judged(
        self, status: Tensor, found: Equilibrium, normals: Tensor, residual: Tensor, coverage: Tensor, broken: Tensor
    ) -> Tensor:
        """Return the final statuses `[B]`: frames already rejected keep theirs; of several that apply, the last one counts."""
        ok, displaced = is_seen(status), self.camera.is_displaced(found.moved)
        unlike = (residual[..., None] > LARGEST_RESIDUAL).flatten(1).any(1)
        for of_this, value in (
            (self.range.is_beyond(found.vertices, normals, found.traction, self.estimator.membrane), Status.OUT_OF_RANGE.value),
            (~self.estimator.is_converged(found), Status.NOT_CONVERGED.value),
            (coverage < LEAST_COVERAGE, Status.HIDDEN.value),
            (~self.estimator.is_explained(found) | unlike | displaced, Status.UNEXPLAINED.value),
            (broken, Status.NO_SOLUTION.value),
        ):
            status = torch.where(ok & of_this, value, status)
        return status

    def _facings(self, points: Tensor, normals: Tensor) -> Tensor:
        """Return, for each sighting, how directly the markers at `points [..., D, 3]` face the camera that sees them."""
        return facings(self.camera.lines_of_sight(self.observer.seen_by_each(points)), self.observer.seen_by_each(normals))

    def _gauged(self, observation: Observation, pressure: Tensor | float | None) -> Observation:
        """Return the observation with the measured pressure, if there is one."""
        return observation if pressure is None else self.estimator.gauged(observation, tensor_of("pressure", pressure))

    def fields(self, result: Reconstruction, names: Sequence[str] = FIELDS) -> dict[str, Tensor]:
        """Return the principal "stretch" and "tension" (force / length) at the vertices of `result`, a dict of `[B, V, 2]` as
        computed by `principal_fields`; NaN where no surface was found.

        Raises:
            MembraneError: a name is unknown, or the estimator has no `elasticity`.
        """
        if unknown := [name for name in names if name not in FIELDS]:
            raise MembraneError(f"Reconstructor.fields: {unknown[0]!r}; expected {', '.join(FIELDS)}")
        elasticity: Any = getattr(self.estimator, "elasticity", None)
        expect(elasticity is not None, "Reconstructor.fields: elasticity of the estimator", None, "force-balance")
        return {name: principal_fields(elasticity, self.estimator.membrane, result.vertices, name) for name in names}

    def standard_deviations(self, result: Reconstruction, pressure: Tensor | float | None = None) -> StandardDeviations:
        """Return the standard deviations of vertices `[B, V, 3]`, total force `[B, 3]` and pressure `[B]` due to the noise of
        the locator and, if `result` was computed with readings `pressure`, of the gauge; NaN without a surface.

        Raises:
            MembraneError: the estimator does not compute standard deviations.
        """
        expect(isinstance(result, Reconstruction), "standard_deviations: result", type(result).__name__, "a tm.Reconstruction")
        observer, confidence = self.observer, self.observer.sighted(result.confidence)
        pixels = observer.sighted(torch.where(result.pixels.isfinite(), result.pixels, self.rest_pixels))
        seen = self.camera, observer.with_rays(pixels, confidence), observer.seen_by_each(result.markers)
        vertices = torch.where(result.vertices.isfinite(), result.vertices, self.estimator.membrane.rest)
        reported = torch.where(result.pressure.isfinite(), result.pressure, self.estimator.rest_pressure)
        with full_precision(self.rest_pixels):
            noise = turns_by_noise(*seen, 2 * observer.rest_covariance)
            observation = self._gauged(self.observation(pixels - observer.rest_pixels, confidence), pressure)
            moved = self.camera.motion_in_pixels(result.camera_motion).nan_to_num()
            found = self.estimator.standard_deviations(vertices, reported, moved, observation, noise)
        return found.known(result.vertices.flatten(1).isfinite().all(1))
