"""What a batch of images shows of the markers: displacements, confidence, and a status for each frame."""

from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor, nn

from ..control_flow import can_sync, traced
from ..errors import MembraneError, expect
from ..files.levels import too_few_bits
from ..files.tensors import tensor_of
from ..machine_code import is_used, using
from ..results.status import Status
from ..torch_modes import without_autocast
from .locator import Locator, isotropic
from .native_frames import found_by, is_native
from .native_image import statuses
from .placement import FEWEST_MARKERS, PlacedMarkers
from .screening import MismatchScreen

LOCATION_NOISE = 0.05
"""px, assumed standard deviation of a marker's pixel if nothing else is known."""
MOST_NOISE = 100.0  # px
FOUND_CONFIDENCE = 0.5
"""Confidence above which a marker counts as found."""
FEWEST_SHARE, ALIKE_SHARE = 0.1, 0.5  # shares of markers found below which there are too few, or the image is unlike rest
LARGEST_OFFSET = 0.005  # largest rms distance of the markers at rest from the model's, over the image's diagonal
LEAST_CONTRAST, SATURATED_SHARE = 0.02, 0.98
SATURATION_STRIDE = 4  # px between the rows and columns that are tested for saturation


class MarkerFlow(NamedTuple):
    """The markers in a batch: `displacement [B, D, 2]` px, `confidence [B, D]` in 0..1, `covariance [B, D, 2, 2]` px^2 of the
    displacements, and the preliminary `status [B]`."""

    displacement: Tensor
    confidence: Tensor
    covariance: Tensor
    status: Tensor


class RestState(NamedTuple):
    """The markers without contact: `pixels [D, 2]` and the `covariance [D, 2, 2]` px^2 of their noise."""

    pixels: Tensor
    covariance: Tensor


class MarkerObserver(nn.Module):
    """Measures the displacements of one sensor's markers in images.

    Args:
        markers: the markers on the rest surface, with their locator.
        rim_pixels: pixels of the fixed rim in the rest image, `[R, 2]`.
        name: name of the sensor, for messages.
        dtype: precision of the pixels.
        rest_image: `[height, width]` grey, or None: displacements are then relative to the model's pixels of the markers.
        image_size: width and height; markers outside according to the model count as not visible, not as lost.
        check_rest: whether to refuse a rest image that disagrees with the model.

    Raises:
        MembraneError: most markers in view are not found in the rest image, or they lie far from their pixels in the model.
    """

    rest_pixels: Tensor
    measured_rest: Tensor
    rest_covariance: Tensor
    seen_at_rest: Tensor

    def __init__(
        self,
        markers: PlacedMarkers,
        rim_pixels: np.ndarray,
        name: str,
        dtype: torch.dtype,
        rest_image: np.ndarray | None,
        image_size: tuple[int, int],
        check_rest: bool = True,
    ):
        super().__init__()
        self.locator: Locator = markers.locator
        self.image_size = image_size
        self.screen = MismatchScreen(markers.model_pixels, rim_pixels)
        self.register_buffer("rest_pixels", torch.from_numpy(markers.model_pixels))
        self.register_buffer("measured_rest", torch.from_numpy(markers.model_pixels))
        self.register_buffer("rest_covariance", isotropic(self.rest_pixels[:, 0], LOCATION_NOISE))
        in_view = torch.from_numpy(markers.in_view)
        if in_view.sum() < FEWEST_MARKERS:
            raise MembraneError(
                f"sensor {name!r}: {int(in_view.sum())} of {len(in_view)} markers are in the camera's view; expected at least "
                f"{FEWEST_MARKERS}: check the camera's pose and focal length"
            )
        self.register_buffer("seen_at_rest", in_view)
        self.to(dtype)
        if rest_image is not None:
            self.measured_rest, self.rest_covariance, self.seen_at_rest = self._in_rest_image(
                torch.from_numpy(rest_image).to(dtype), name
            )
        self.largest_offset = LARGEST_OFFSET * float(np.hypot(*image_size))
        if check_rest:
            self.check_rest(name)

    @property
    def follows(self) -> bool:
        """Return whether the search for markers starts at their pixels in the preceding frame."""
        return self.locator.follows

    def be_exact(self) -> None:
        """Locate in double precision."""
        self.locator.be_exact()

    def by_view(self, values: Tensor) -> Tensor:
        """Return values `[B, D, ...]` unchanged; `ViewsObserver` returns those of several views as `[B, W, D, ...]`."""
        return values

    def sighted(self, values: Tensor) -> Tensor:
        """Undo `by_view`."""
        return values

    def seen_by_each(self, values: Tensor) -> Tensor:
        """Return values of the markers for each view that sees them."""
        return values

    def with_rays(self, pixels: Tensor, confidence: Tensor) -> Tensor:
        """Return pixels `[B, D, 2]` unchanged; `ViewsObserver` replaces those without a viewing ray."""
        return pixels

    def _in_rest_image(self, image: Tensor, name: str) -> tuple[Tensor, Tensor, Tensor]:
        """Return the markers in the rest image, their covariance, and which are found; subtracting these pixels from those of
        every frame cancels offsets at rest (5.2)."""
        with torch.no_grad(), using(is_used() and getattr(self.locator, "is_compiled", True)):
            pixels, confidence, covariance = self.locator(image[None, None])
        found = (
            confidence > FOUND_CONFIDENCE
        ) & self.seen_at_rest  # what the model has outside cannot be one of the dots in view
        in_view = int(self.seen_at_rest.sum())
        if found.sum() < max(FEWEST_MARKERS, ALIKE_SHARE * in_view):
            raise MembraneError(
                f"sensor {name!r}: only {int(found.sum())} of {in_view} markers in view are found in the rest image; "
                "expected most: check the marker file, the polarity and the camera against the image"
                f"{too_few_bits(image.cpu().numpy())}"
            )
        return torch.where(found[0, :, None], pixels[0], self.measured_rest), covariance[0], found[0]

    def rest_offset(self) -> float:
        """Return the rms distance of the markers in the rest image from their pixels in the model, px."""
        off2 = (self.measured_rest - self.rest_pixels).square().sum(-1)
        return float(off2[self.seen_at_rest].mean().sqrt())

    def check_rest(self, name: str) -> None:
        """Refuse a rest image that deviates from the model by more than a calibration error could explain."""
        largest = self.largest_offset
        if (offset := self.rest_offset()) > largest:
            raise MembraneError(
                f"sensor {name!r}: in the rest image the markers lie {offset:.1f} px (rms) from where the model has them; "
                f"expected at most {largest:.1f}: check that camera, surface and rest image are of one sensor, and that the "
                "camera has not moved; `torchmembrane calibrate rest` fits the rest surface to the image"
            )

    def rest_of(self, images: Tensor) -> RestState:
        """Return the mean markers of grey images `[B, 1, height, width]` without contact; markers found in none of them keep
        their pixels and noise from the sensor's rest image.

        Raises:
            MembraneError: an image does not show the markers.
        """
        with torch.no_grad(), without_autocast(images.device.type):
            displacement, confidence, covariance, status = self.judge(*self(images))
        if (status != Status.OK.value).any():
            bad = int(status.ne(Status.OK.value).nonzero()[0])
            raise MembraneError(f"rest image {bad}: {Status(int(status[bad])).text}; expected a frame without contact")
        found = (confidence > 0).to(displacement.dtype)[..., None]
        count = found.sum(0).clamp_min(1)
        own = (found[..., None] * (covariance - self.rest_covariance)).sum(0) / count[..., None] ** 2
        seen = found.any(0)[..., None]
        return RestState(
            self.measured_rest + (found * displacement).sum(0) / count, torch.where(seen, own, self.rest_covariance)
        )

    def locate(self, images: Tensor) -> tuple[Tensor, Tensor]:
        """Return the pixels `[B, D, 2]` of the markers in grey images `[B, 1, height, width]`, and which are found,
        `[B, D]`."""
        with torch.no_grad(), without_autocast(images.device.type):
            pixels, confidence, _ = self.locator(images)
        return pixels, confidence > FOUND_CONFIDENCE

    def forward(self, images: Tensor, previous: Tensor | None = None, rest_pixels: Tensor | None = None) -> MarkerFlow:
        """Measure the markers in grey images `[B, 1, height, width]`.

        Args:
            images: grey values in 0..1.
            previous: `[B, D, 2]`, `pixels` of the preceding frames, from which dots are followed if the locator can do so.
            rest_pixels: `[D, 2]`, the markers as `locate` finds them without contact; default: those in the rest image.
        """
        status = self.check(images)
        before = None if previous is None else self.located(previous)
        return MarkerFlow(*self.displaced(*self.locator(images, before), status, rest_pixels), status)

    @traced
    def check(self, images: Tensor) -> Tensor:
        """Return the status `[B]` of images."""
        if is_native(images):
            limits = LEAST_CONTRAST, SATURATED_SHARE, SATURATION_STRIDE
            codes = Status.BLANK.value, Status.BAD_VALUES.value
            return found_by(statuses, (*limits, *codes), (images[:, 0],)).to(torch.int64)
        flat, sparse = images.flatten(1), images[..., ::SATURATION_STRIDE, ::SATURATION_STRIDE]
        mean, low, high = flat.mean(1), flat.amin(1), flat.amax(1)
        bad = ~((mean < torch.inf) & (low > -1e-3) & (high < 1.001))  # one value that is not finite makes the mean so
        saturated = ((sparse - 0.5).abs() > 0.495).to(sparse.dtype).mean((1, 2, 3))
        blank = (high - low < LEAST_CONTRAST) | ((saturated > SATURATED_SHARE) & (mean > 0.5))
        return (Status.BLANK.value * blank.to(torch.int64)).masked_fill(bad, Status.BAD_VALUES.value)

    @traced
    def located(self, pixels: Tensor) -> Tensor:
        """Convert the `pixels` of a result back to pixels as the locator found them."""
        return pixels - self.rest_pixels + self.measured_rest

    @traced
    def displaced(
        self, pixels: Tensor, confidence: Tensor, covariance: Tensor, status: Tensor, rest_pixels: Tensor | None = None
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Return displacements, confidence and covariance from the locator's output; displacements and
        confidence are zero in frames with invalid values."""
        bad = (status == Status.BAD_VALUES.value)[:, None]
        rest = self.measured_rest if rest_pixels is None else rest_pixels
        displacement, confidence = (pixels - rest).masked_fill(bad[..., None], 0.0), confidence.masked_fill(bad, 0.0)
        return displacement, confidence, self.rest_covariance + covariance.masked_fill(bad[..., None, None], 0.0)

    def from_pixels(
        self, pixels: Tensor, confidence: Tensor | None, rest_pixels: Tensor | None, noise: float | None = None
    ) -> MarkerFlow:
        """Return the displacements of markers located elsewhere; those that contradict their neighbours get confidence 0.

        Arguments and errors as for `Reconstructor.from_pixels`.
        """
        flow = self.as_given(pixels, confidence, rest_pixels, noise)
        return flow._replace(confidence=self.screen(flow.displacement, flow.confidence))

    def as_given(
        self, pixels: Tensor, confidence: Tensor | None, rest_pixels: Tensor | None, noise: float | None
    ) -> MarkerFlow:
        """Do the same as `from_pixels`, but keep the given confidence of each marker."""
        pixels = tensor_of("from_pixels: pixels", pixels).to(self.rest_pixels)
        pixels = pixels[None] if pixels.ndim == 2 else pixels
        if pixels.shape[1:] != self.rest_pixels.shape:
            raise MembraneError(
                f"from_pixels: pixels of shape {list(pixels.shape)}; expected [B, {len(self.rest_pixels)}, 2] or "
                f"[{len(self.rest_pixels)}, 2], one pixel for each marker"
            )
        rest = self.rest_pixels if rest_pixels is None else self.rest_given(rest_pixels)
        finite = pixels.isfinite().all(-1)
        confidence = torch.where(finite, _checked_confidence(confidence, pixels), 0.0)
        displacement = torch.where(finite[..., None], pixels - rest, 0.0)
        status = torch.zeros_like(confidence[:, 0], dtype=torch.long)
        return MarkerFlow(displacement, confidence, self.covariance_of(noise, confidence), status)

    def covariance_of(self, noise: float | None, confidence: Tensor) -> Tensor:
        """Return the covariance `[B, D, 2, 2]` px^2 of displacements between pixels located elsewhere, now and at rest, each
        with this standard deviation in u and v, px. By default it is `LOCATION_NOISE` now, and that of the rest image's markers
        at rest."""
        if noise is None:
            return self.rest_covariance + isotropic(confidence, LOCATION_NOISE)
        expect(0 < noise < MOST_NOISE, "noise of pixels", noise, f"more than 0 and less than {MOST_NOISE:g} px")
        return isotropic(confidence, 2**0.5 * noise)

    def rest_given(self, rest_pixels: Any) -> Tensor:
        """Check the markers at rest given by a caller, and return them as `[D, 2]` px."""
        rest = tensor_of("rest_pixels", rest_pixels).to(self.rest_pixels)
        if rest.shape != self.rest_pixels.shape:
            raise MembraneError(
                f"from_pixels: rest_pixels of shape {list(rest.shape)}; expected {list(self.rest_pixels.shape)}, one pixel for "
                "each marker"
            )
        return rest

    def before(self, previous: Any, frames: int) -> Tensor:
        """Return the pixels `[B, D, 2]` of a previous result, after checking that it fits these frames."""
        given, expected = getattr(previous, "pixels", None), [frames, *self.rest_pixels.shape]
        came = f"pixels {list(given.shape)}" if isinstance(given, Tensor) else f"no pixels, it is a {type(previous).__name__}"
        if not isinstance(given, Tensor) or list(given.shape) != expected:
            raise MembraneError(f"Reconstructor: previous has {came}; expected {expected}: an earlier result for each image")
        return given.to(self.rest_pixels)

    @traced
    def judge(self, displacement: Tensor, confidence: Tensor, covariance: Tensor, status: Tensor) -> MarkerFlow:
        """Return displacements, zero in unusable frames, confidence, zero for lost markers, covariance, and status."""
        found = confidence > FOUND_CONFIDENCE
        count, D = found.sum(-1), self.seen_at_rest.sum().float()
        unlike = Status.UNLIKE_REST.value * (count < ALIKE_SHARE * D).to(torch.int64)
        few = count < (FEWEST_SHARE * D).clamp_min(FEWEST_MARKERS)
        status = torch.where(status == Status.OK.value, unlike.masked_fill(few, Status.TOO_FEW_MARKERS.value), status)
        usable = (status == Status.OK.value)[:, None, None]
        return MarkerFlow(displacement * usable, confidence * found, covariance, status)


def _checked_confidence(confidence: Tensor | None, pixels: Tensor) -> Tensor:
    if confidence is None:
        return torch.ones_like(pixels[..., 0])
    confidence, shape = tensor_of("from_pixels: confidence", confidence).to(pixels), pixels.shape[:2]
    if confidence.shape not in (shape, shape[1:]):
        raise MembraneError(f"from_pixels: confidence {list(confidence.shape)}; expected {list(shape)}, one for each marker")
    if can_sync(confidence) and not ((confidence >= 0) & (confidence <= 1)).all():
        raise MembraneError("from_pixels: confidence outside 0..1; expected 0 for a lost marker, up to 1 for a sure one")
    return confidence.expand(shape)
