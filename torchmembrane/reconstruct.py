"""From images to surfaces: `Reconstructor`, an `nn.Module` that holds everything constant of one sensor."""

import copy
import warnings
from pathlib import Path

import numpy as np
import torch
from torch import Tensor, nn

from .camera.model import Rays
from .errors import MembraneError
from .estimators.contact_patches import contact_indicator, contact_points
from .estimators.covariance import StandardDeviations
from .estimators.flow import FlowInterpolation
from .estimators.force_balance import ForceBalance
from .estimators.minimum_energy import MinimumEnergy
from .io import results
from .io.images import read_image
from .io.results import CONTACT_POINTS, Reconstruction
from .markers.dots import DotLocator
from .markers.placement import FEWEST_MARKERS, place_markers
from .markers.screening import MismatchScreen
from .mechanics.cavity import Equilibrium
from .mechanics.hyperelastic import ElasticEnergy
from .sensor.model import Sensor

ESTIMATORS = ("force-balance", "minimum-energy")
FOUND = 0.5
"""Confidence above which a marker counts as found."""
FEWEST_SHARE, ALIKE_SHARE = 0.1, 0.5
MARKER_NOISE = {"dots": 0.1, "texture": 0.2}  # px, assumed by force balance: twice the locator's, and the grid's error
LOCATOR_NOISE = 0.5  # of MARKER_NOISE: the locator's own, of which standard deviations speak
LEAST_CONTRAST, SATURATED_SHARE = 0.02, 0.98
SPARSE = 4  # px: every so many rows and columns are asked whether they are saturated


class Reconstructor(nn.Module):
    """Images of one sensor to surfaces.

    Arguments
        sensor      a `Sensor` (`Reconstructor.from_file` reads one)
        estimator   "force-balance", or "minimum-energy": the paper's; finds no contacts and flattens what is narrow and far
        model       the membrane's energy, default the sensor's: "harmonic" | "neo_hookean" | "mooney_rivlin"
        element     "triangle", or "quadrilateral": the paper's affine quadrilaterals (harmonic), with `smoothing` (eq. 28)
        volume      "exact", or "linear": the paper's linearised constraint (eq. 21)
        flow        "smooth", or "bilinear" between the dots (section 5); minimum energy only, as element and volume
        dtype       torch.float32 or torch.float64

    Calling it with images gives a `Reconstruction`; `from_pixels` starts from markers located elsewhere.

    >>> reconstructor = Reconstructor.from_file("examples/sensor.toml")
    >>> result = reconstructor(reconstructor.read("examples/two_contacts.png"))
    >>> int(result.status[0]), list(result.vertices.shape)
    (0, [1, 1089, 3])
    """

    def __init__(self, sensor: Sensor, estimator="force-balance", *, model=None, element="triangle", smoothing=None,
                 volume="exact", flow="smooth", dtype=torch.float32):  # fmt: skip
        super().__init__()
        if estimator not in ESTIMATORS:
            raise MembraneError(f"Reconstructor: estimator = {estimator!r}; expected one of {', '.join(ESTIMATORS)}")
        self.sensor, self.image_size = sensor, tuple(sensor.camera.image_size)
        self.camera, membrane = copy.deepcopy(sensor.camera), copy.deepcopy(sensor.membrane)
        vertex_pixels = self.camera.point_to_pixel(membrane.rest)
        if not torch.isfinite(vertex_pixels).all():
            raise MembraneError(
                f"sensor {sensor.name!r}: parts of the rest surface cannot be imaged by its camera; check the poses"
            )
        markers = place_markers(sensor, vertex_pixels)
        self.locator = markers.locator
        self.screen = MismatchScreen(markers.model_pixels, vertex_pixels[membrane.fixed].numpy())
        self.finds_contacts = estimator == "force-balance"
        elasticity, cavity = self._elasticity(membrane, model), self._cavity(membrane)
        if self.finds_contacts:
            if element != "triangle" or volume != "exact" or smoothing:
                raise MembraneError(
                    "Reconstructor: force-balance has linear triangles, exact volume, no smoother; leave those options out"
                )
            noise = MARKER_NOISE[sensor.markers.kind] / float(self.camera.focal.mean())
            self.estimator = ForceBalance(membrane, elasticity, markers.points, markers.positions, noise, *cavity)
        else:
            smoothing = (0.1 if element == "quadrilateral" else 0.0) if smoothing is None else smoothing
            rays = self.camera.pixel_to_ray(vertex_pixels)
            self.flow = FlowInterpolation(membrane, markers.points, flow)
            self.estimator = MinimumEnergy(membrane, elasticity, rays, element, smoothing, *cavity, volume)
        self.register_buffer("vertex_pixels", vertex_pixels)
        self.register_buffer("rest_markers", torch.from_numpy(markers.positions))
        self.register_buffer("rest_pixels", torch.from_numpy(markers.model_pixels))
        self.register_buffer("measured_rest", torch.from_numpy(markers.model_pixels))
        self.register_buffer("marker_vertices", torch.from_numpy(markers.points.vertices.astype(np.int64)))
        self.register_buffer("marker_weights", torch.from_numpy(markers.points.weights.copy()))
        self.to(dtype)
        if sensor.markers.rest_image is not None:
            self._measure_rest(sensor.markers.rest_image)

    @classmethod
    def from_file(cls, path: str | Path, **options) -> "Reconstructor":
        """The reconstructor of a sensor file; options as for the class."""
        return cls(Sensor.from_file(path), **options)

    def _elasticity(self, membrane, model: str | None) -> ElasticEnergy:
        material = self.sensor.material
        return ElasticEnergy(membrane, model or material.model, material.prestretch, material.modulus, material.c2_ratio or 0.0)

    def _cavity(self, membrane) -> tuple[str, tuple[float, float] | None]:
        """The cavity's filling, and a gas' pressure and volume."""
        sensor = self.sensor
        if sensor.cavity.filling != "gas":
            return sensor.cavity.filling, None
        if sensor.force_unit == "relative":
            warnings.warn(
                f"sensor {sensor.name!r}: a gas without shear_modulus and thickness acts as a liquid (volume kept)",
                stacklevel=3,
            )
            return "liquid", None
        return "gas", (sensor.gas_pressure, sensor.cavity.volume or membrane.cavity_volume)

    def _measure_rest(self, image: np.ndarray) -> None:
        """Null rest offsets (section 5.2): the same locator's rest pixels are subtracted from every frame's."""
        with torch.no_grad():
            pixels, confidence = self.locator(torch.from_numpy(image).to(self.rest_pixels.dtype)[None, None])
        found = confidence[0] > FOUND
        if found.sum() < max(FEWEST_MARKERS, ALIKE_SHARE * len(found)):
            raise MembraneError(
                f"sensor {self.sensor.name!r}: only {int(found.sum())} of {len(found)} markers are found in the rest image; "
                "expected most: check the marker file, the polarity and the camera against the image"
            )
        self.measured_rest = torch.where(found[:, None], pixels[0], self.measured_rest)

    def read(self, *paths: str | Path) -> Tensor:
        """Image files as a batch `[B, 1, height, width]` in 0..1, in this module's precision and on its device."""
        images = [torch.from_numpy(read_image(path)) for path in paths]
        for path, image in zip(paths, images, strict=True):
            self._check_size(image.shape, f"{path}: ")
        return torch.stack(images)[:, None].to(self.rest_pixels)

    def forward(self, images, previous: Reconstruction | None = None) -> Reconstruction:
        """Reconstruct a batch of images; `previous`: of the frames before, to start from (force balance): a few steps then do.

        Argument: `[B, 1, height, width]` (also `[B, height, width]`, `[height, width]`, or `[B, 3, height, width]` RGB), float
        in 0..1 or uint8. Grey is 0.299 R + 0.587 G + 0.114 B. Raises `MembraneError` for another size; a frame that cannot be
        reconstructed gets a status and NaN, the others are not touched.
        """
        seen = self.observe(self._as_batch(images), None if previous is None else previous.pixels)
        return self._reconstruct(*seen, previous)

    def observe(self, images: Tensor, previous: Tensor | None = None) -> tuple[Tensor, Tensor, Tensor]:
        """Marker displacements `[B, D, 2]` px, confidence `[B, D]` and status `[B]` of grey images `[B, 1, height, width]`.

        `previous [B, D, 2]`: `pixels` of the frames before, from which dots are followed where that is possible.
        """
        status = self.check(images)
        before = () if previous is None or not self.follows else (self.located(previous),)
        return *self.seen(*self.locator(images, *before), status), status

    @property
    def follows(self) -> bool:
        """Whether markers are followed from frame to frame: dots are."""
        return isinstance(self.locator, DotLocator)

    def located(self, pixels: Tensor) -> Tensor:
        """`pixels` of a result as the locator found them."""
        return pixels - self.rest_pixels + self.measured_rest

    def seen(self, pixels: Tensor, confidence: Tensor, status: Tensor) -> tuple[Tensor, Tensor]:
        """Displacements and confidence from what the locator makes of images; zero where these hold bad values."""
        bad = (status == results.BAD_VALUES)[:, None]
        displacement = torch.where(bad[..., None], 0.0, pixels - self.measured_rest)
        return displacement, torch.where(bad, 0.0, confidence)

    def check(self, images: Tensor) -> Tensor:
        """Status `[B]` of images."""
        flat, sparse = images.flatten(1), images[..., ::SPARSE, ::SPARSE].flatten(1)
        mean, low, high = flat.mean(1), flat.amin(1), flat.amax(1)
        bad = ~(mean.isfinite() & (low > -1e-3) & (high < 1.001))  # one value that is not finite makes the mean so
        saturated = ((sparse - 0.5).abs() > 0.495).to(sparse.dtype).mean(1)
        blank = (high - low < LEAST_CONTRAST) | ((saturated > SATURATED_SHARE) & (mean > 0.5))
        return torch.where(bad, results.BAD_VALUES, torch.where(blank, results.BLANK, results.OK))

    def from_pixels(
        self,
        pixels: Tensor,
        confidence: Tensor | None = None,
        rest_pixels: Tensor | None = None,
        previous: Reconstruction | None = None,
    ) -> Reconstruction:
        """Reconstruct from marker centres located elsewhere; those that belong with no neighbour get confidence 0.

        Arguments: `pixels [B, D, 2]` in the sensor file's order, NaN where lost; `confidence [B, D]` (default: 1 where finite);
        `rest_pixels [D, 2]`: the same markers located in the rest image (default: the model's rest pixels); `previous` as for
        images.
        """
        pixels = torch.as_tensor(pixels).to(self.rest_pixels)
        if pixels.ndim == 2:
            pixels = pixels[None]
        if pixels.shape[1:] != self.rest_pixels.shape:
            raise MembraneError(
                f"from_pixels: pixels {list(pixels.shape)}; expected [B, {len(self.rest_pixels)}, 2], one for each marker"
            )
        finite = pixels.isfinite().all(-1)
        confidence = torch.ones_like(pixels[..., 0]) if confidence is None else torch.as_tensor(confidence).to(pixels)
        rest = self.rest_pixels if rest_pixels is None else torch.as_tensor(rest_pixels).to(pixels)
        confidence = torch.where(finite, confidence.expand(finite.shape), 0.0)
        displacement = torch.where(finite[..., None], pixels - rest, 0.0)
        confidence = self.screen(displacement, confidence)
        status = torch.zeros_like(confidence[:, 0], dtype=torch.long)
        return self._reconstruct(displacement, confidence, status, previous)

    def _reconstruct(self, displacement, confidence, status, previous: Reconstruction | None) -> Reconstruction:
        usable, confidence, status = self.judge(displacement, confidence, status)
        rays = self.rays(usable, confidence)
        if not self.finds_contacts:
            if previous is not None:
                raise MembraneError("Reconstructor: minimum-energy starts from rest always; leave previous out")
            return self.result(self.estimator(*rays), displacement, confidence, status)
        start = None if previous is None else self.start(previous.vertices, previous.pressure)
        return self.result(self.estimator(*rays, confidence, start), displacement, confidence, status)

    def standard_deviations(self, result: Reconstruction) -> StandardDeviations:
        """Of vertices, total force and pressure of `result`, caused by the locator's noise; NaN where there is no surface."""
        if not self.finds_contacts:
            raise MembraneError("Reconstructor: standard deviations of minimum-energy; expected estimator = 'force-balance'")
        pixels = torch.where(result.pixels.isfinite(), result.pixels, self.rest_pixels)
        origins, directions = self.camera.pixel_to_ray(pixels)
        distance = torch.linalg.vector_norm(result.markers - origins, dim=-1)[..., None, None]
        half = 0.5 * torch.eye(2, dtype=pixels.dtype, device=pixels.device)
        after, before = (self.camera.pixel_to_ray(pixels[..., None, :] + step) for step in (half, -half))
        turn = (after.origin - before.origin) / distance + after.direction - before.direction
        noise = LOCATOR_NOISE * MARKER_NOISE[self.sensor.markers.kind] * turn
        found = Equilibrium(result.vertices, result.pressure, None, result.traction, None)
        return self.estimator.standard_deviations(found, origins, directions, result.confidence, noise)

    def start(self, vertices: Tensor, pressure: Tensor) -> tuple[Tensor, Tensor]:
        """Vertices `[B, V, 3]` and pressure `[B]` of the frames before, those of rest where there are none (NaN)."""
        vertices = torch.where(vertices.isfinite(), vertices, self.estimator.membrane.rest)
        return vertices, torch.where(pressure.isfinite(), pressure, self.estimator.rest_pressure)

    def judge(self, displacement: Tensor, confidence: Tensor, status: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Displacements, zero where the frame is of no use; confidence, zero where a marker is lost; status."""
        found = confidence > FOUND
        status = torch.where(status == results.OK, _marker_status(found), status)
        return displacement * (status == results.OK)[:, None, None], torch.where(found, confidence, 0.0), status

    def rays(self, displacement: Tensor, confidence: Tensor) -> Rays:
        """What the estimator is given: rays of the markers (force balance), or of the grid's vertices."""
        if self.finds_contacts:
            return self.camera.pixel_to_ray(self.rest_pixels + displacement)
        return self.camera.pixel_to_ray(self.vertex_pixels + self.flow(displacement, confidence))

    def result(self, equilibrium, displacement, confidence, status) -> Reconstruction:
        membrane, lost = self.estimator.membrane, confidence <= FOUND
        x, pressure = equilibrium.vertices, equilibrium.pressure
        u = x - membrane.rest
        corner_u = u[:, self.marker_vertices.ravel()].unflatten(1, (-1, 3))
        markers = self.rest_markers + (self.marker_weights[..., None] * corner_u).sum(-2)
        pixels = self.rest_pixels + displacement
        target = self.estimator.cavity.target_volume(equilibrium.volume, pressure)
        volume_error = (equilibrium.volume - target) / membrane.rest_volume
        miss2 = torch.where(lost, 0.0, ((self.camera.point_to_pixel(markers) - pixels) ** 2).sum(-1))
        residual = (miss2.sum(-1) / (~lost).sum(-1).clamp_min(1)).sqrt()
        unsettled = (equilibrium.relative_step > self.estimator.largest_relative_step) | (
            volume_error.abs() > self.estimator.largest_volume_error
        )
        ok, broken = status == results.OK, ~x.flatten(1).isfinite().all(1)
        status = torch.where(ok & unsettled, results.NOT_CONVERGED, status)
        status = torch.where(ok & broken, results.NO_SOLUTION, status)
        gone = (status != results.OK) & (status != results.NOT_CONVERGED)
        blank = lambda a: torch.where(gone.reshape(-1, *(1,) * (a.ndim - 1)), torch.nan, a)  # noqa: E731
        normals, traction = membrane.normals(x), equilibrium.traction
        contact, points = self._contacts(x, normals, traction)
        force = (traction * membrane.rest_area[:, None]).sum(1)
        return Reconstruction(
            blank(x), blank(u), blank(normals), blank(markers),
            torch.where(lost[..., None], torch.nan, pixels), confidence,
            blank(traction), blank(contact), blank(points), blank(force),
            blank(pressure), blank(pressure - self.estimator.rest_pressure), blank(volume_error), blank(residual),
            status.to(torch.int32),
        )  # fmt: skip

    def _contacts(self, x: Tensor, normals: Tensor, traction: Tensor) -> tuple[Tensor, Tensor]:
        if not self.finds_contacts:
            return torch.zeros_like(x[..., 0]), x.new_full((x.shape[0], CONTACT_POINTS, 3), torch.nan)
        membrane, reference = self.estimator.membrane, self.estimator.reference
        contact = contact_indicator(traction, normals, reference)
        inward = (contact > 0.5) * (-(traction * normals).sum(-1)).clamp_min(0) * membrane.rest_area
        return contact, contact_points(x, membrane.rest, inward, self.estimator.size, CONTACT_POINTS)

    def _as_batch(self, images) -> Tensor:
        images = torch.as_tensor(images)
        if images.dtype == torch.uint8:
            images = images / 255.0
        images = images.to(self.rest_pixels)
        if images.ndim == 2:
            images = images[None]
        if images.ndim == 3:
            images = images[:, None]
        if images.ndim == 4 and images.shape[1] == 3:
            red, green, blue = images.unbind(1)
            images = (0.299 * red + 0.587 * green + 0.114 * blue)[:, None]
        if images.ndim != 4 or images.shape[1] != 1:
            raise MembraneError(f"Reconstructor: images {list(images.shape)}; expected [B, 1, height, width]")
        self._check_size(images.shape[2:], "")
        return images

    def _check_size(self, shape, where: str) -> None:
        width, height = self.image_size
        if tuple(shape) != (height, width):
            raise MembraneError(
                f"{where}the image is {shape[1]} x {shape[0]} px, sensor {self.sensor.name!r} expects {width} x {height}; "
                "use images of this sensor's camera at its calibrated resolution"
            )


def _marker_status(found: Tensor) -> Tensor:
    count, D = found.sum(-1), found.shape[-1]
    few = count < max(FEWEST_MARKERS, FEWEST_SHARE * D)
    unlike = count < ALIKE_SHARE * D
    return torch.where(few, results.TOO_FEW_MARKERS, torch.where(unlike, results.UNLIKE_REST, results.OK))
