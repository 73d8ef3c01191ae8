"""Markers seen by several views: each view has its own locator, rest image and noise, and the results are listed view by view.

Of W views of D markers there are `N = W D` sightings: all markers in the first view, then all in the second, and so on.
"""

from collections.abc import Sequence
from itertools import combinations
from typing import Any

import torch
from torch import Tensor, nn

from ..camera.rig import Rig
from ..control_flow import Value, traced
from ..errors import MembraneError
from ..files.tensors import tensor_of
from ..results.status import Status
from ..user_warnings import warn_user
from .observer import MarkerFlow, MarkerObserver, RestState

BY_GRAVITY = (Status.BAD_VALUES, Status.BLANK, Status.TOO_FEW_MARKERS, Status.UNLIKE_REST)
"""Statuses in order of precedence if all views fail: the frame gets the first of these that a view has."""


MEETING = 1.0
"""px by which the point closest to two views' rays may miss the marker in either image."""


class ViewsObserver(nn.Module):
    """Measures the markers in the images of all views, like `MarkerObserver` but for all sightings.

    Args:
        observers: observers of the views.
        names: names of the views, for messages.
        regions: left, top, width and height of each view in the image that they share; None: each has a channel of its own.
        rig: cameras of the views.
    """

    principal: Tensor

    def __init__(
        self,
        observers: Sequence[MarkerObserver],
        names: Sequence[str],
        regions: Sequence[tuple[int, int, int, int]] | None,
        rig: Rig,
    ):
        super().__init__()
        self.each, self.names, self.regions = nn.ModuleList(observers), list(names), regions
        self.count, self.views = len(observers[0].rest_pixels), len(observers)
        principal = torch.stack([camera.centre.double() for camera in rig.cameras])  # type: ignore[misc]
        self.register_buffer("principal", principal.repeat_interleave(self.count, 0))
        self.rig = rig

    def _joined(self, name: str) -> Tensor:
        return torch.cat([getattr(observer, name) for observer in self.each])

    @property
    def rest_pixels(self) -> Tensor:
        """Return the model's pixels of the markers at rest, `[N, 2]`."""
        return self._joined("rest_pixels")

    @property
    def measured_rest(self) -> Tensor:
        """Return the pixels of the markers in the rest images, `[N, 2]`."""
        return self._joined("measured_rest")

    @property
    def rest_covariance(self) -> Tensor:
        """Return the covariance of their noise in the rest images, `[N, 2, 2]` px^2."""
        return self._joined("rest_covariance")

    @property
    def seen_at_rest(self) -> Tensor:
        """Return which sightings exist at rest, `[N]` bool."""
        return self._joined("seen_at_rest")

    def with_rays(self, pixels: Tensor, confidence: Tensor) -> Tensor:
        """Return pixels `[B, N, 2]`, with the principal point for those without confidence `[B, N]`: a view may have no ray for
        a marker that it does not see, and a weight of zero would not remove the resulting NaN."""
        return torch.where((confidence > 0)[..., None], pixels, self.principal.to(pixels))

    @property
    def follows(self) -> bool:
        """Return whether the search for markers starts at their pixels in the preceding frame."""
        return all(observer.follows for observer in self.each)

    def be_exact(self) -> None:
        """Locate in double precision."""
        for observer in self.each:
            observer.be_exact()  # type: ignore[operator]

    def by_view(self, values: Tensor) -> Tensor:
        """Reshape values `[B, N, ...]` to `[B, W, D, ...]`."""
        return values.unflatten(1, (self.views, self.count))

    @traced
    def sighted(self, values: Tensor) -> Tensor:
        """Reshape values `[B, W, D, ...]` to `[B, N, ...]`."""
        return values.flatten(1, 2)

    def seen_by_each(self, values: Tensor) -> Tensor:
        """Repeat values of the markers, `[..., D, C]`, for each sighting, `[..., N, C]`."""
        return torch.cat([values] * self.views, -2)

    def images(self, grey: Tensor | Sequence[Tensor]) -> Sequence[Tensor]:
        """Return each view's images `[B, 1, height, width]`, from grey images `[B, 1, ...]` of the regions or `[B, W, ...]`; a
        sequence of images is returned unchanged."""
        return self._parts(grey) if isinstance(grey, (Tensor, Value)) else grey

    @traced
    def _parts(self, grey: Tensor) -> list[Tensor]:
        if self.regions is None:
            sizes = [observer.image_size for observer in self.each]
            return [grey[:, w : w + 1, :height, :width] for w, (width, height) in enumerate(sizes)]  # type: ignore[misc]
        return [grey[:, :, v : v + height, u : u + width] for u, v, width, height in self.regions]

    def forward(
        self, images: Tensor | Sequence[Tensor], previous: Tensor | None = None, rest_pixels: Tensor | None = None
    ) -> MarkerFlow:
        """Measure the markers in grey images, as `MarkerObserver`; `status [B, W]` has one entry for each view."""
        befores, rests = self._split(previous, 1), self._split(rest_pixels, 0)
        each = zip(self.each, self.images(images), befores, rests, strict=True)
        return self._together([observer(*given) for observer, *given in each])

    def from_pixels(self, pixels: Any, confidence: Any, rest_pixels: Any, noise: float | None = None) -> MarkerFlow:
        """Measure markers located elsewhere; `pixels [B, W, D, 2]` or `[W, D, 2]`, `confidence` and `rest_pixels` likewise.

        A marker keeps its confidence if its neighbours in the view confirm it, or if another view confirms that it is the same
        point.
        """
        pixels, shape = tensor_of("from_pixels: pixels", pixels), (self.views, self.count, 2)
        pixels = pixels[None] if pixels.ndim == 3 else pixels
        if tuple(pixels.shape[1:]) != shape:
            expected = f"[B, {self.views}, {self.count}, 2], of each view one for each marker"
            raise MembraneError(f"from_pixels: pixels {list(pixels.shape)}; expected {expected}")
        sure = [None] * self.views if confidence is None else tensor_of("from_pixels: confidence", confidence).unbind(-2)
        rests = self._split(None if rest_pixels is None else self.rest_given(rest_pixels), 0)
        each = zip(self.each, pixels.unbind(1), sure, rests, strict=True)
        flows = [observer.as_given(*given, noise) for observer, *given in each]  # type: ignore[operator]
        pairs = zip(self.each, flows, strict=True)
        screened = torch.cat([observer.screen(flow.displacement, flow.confidence) for observer, flow in pairs], 1)  # type: ignore[operator]
        flow = self._together(flows)
        shown = self.with_rays(self.rest_pixels + flow.displacement, flow.confidence)
        is_met = met_by_another(self.rig, self.by_view(shown), self.by_view(flow.confidence > 0))
        return flow._replace(confidence=torch.where(self.sighted(is_met), flow.confidence, screened))

    @traced
    def judge(self, displacement: Tensor, confidence: Tensor, covariance: Tensor, status: Tensor) -> MarkerFlow:
        """Return displacements, confidence and status `[B]`. A view that fails is left out if another one does not, and so are
        markers that a view does not see at rest, whose displacement is unknown to it."""
        confidence = confidence * self.seen_at_rest
        parts = zip(
            *(self.by_view(each).unbind(1) for each in (displacement, confidence, covariance)), status.unbind(1), strict=True
        )
        judged = [observer.judge(*part) for observer, part in zip(self.each, parts, strict=True)]  # type: ignore[operator]
        flow = self._together([part._replace(confidence=part.confidence * (part.status == 0)[:, None]) for part in judged])
        fails = flow.status != Status.OK.value
        gravest = torch.zeros_like(flow.status[:, 0])
        for failure in reversed(BY_GRAVITY):
            gravest = torch.where((flow.status == failure.value).any(1), failure.value, gravest)
        left_out = torch.where(fails.any(1), Status.VIEW_LEFT_OUT.value, Status.OK.value)
        return flow._replace(status=torch.where(fails.all(1), gravest, left_out))

    def rest_of(self, images: Tensor) -> RestState:
        """Return the markers of all sightings in grey images without contact, as `MarkerObserver.rest_of`. A view whose images
        do not show the markers keeps those of its rest image, with a warning.

        Raises:
            MembraneError: the images of no view show the markers.
        """
        rests, failed = [], []
        for name, observer, part in zip(self.names, self.each, self.images(images), strict=True):
            try:
                rests.append(observer.rest_of(part))  # type: ignore[operator]
            except MembraneError as error:
                rests.append(RestState(observer.measured_rest, observer.rest_covariance))  # type: ignore[arg-type]
                failed.append(f"view {name}: {error}")
        if len(failed) == self.views:
            raise MembraneError("; ".join(failed))
        for said in failed:
            warn_user(f"{said}; this view keeps the rest state of its rest image")
        return RestState(*map(torch.cat, zip(*rests, strict=True)))

    def locate(self, images: Tensor) -> tuple[Tensor, Tensor]:
        """Return the pixels `[B, N, 2]` of the markers in grey images, and which of them are found, `[B, N]`."""
        found = [observer.locate(part) for observer, part in zip(self.each, self.images(images), strict=True)]  # type: ignore[operator]
        pixels, is_found = zip(*found, strict=True)
        return torch.cat(pixels, 1), torch.cat(is_found, 1)

    def check_rest(self, name: str) -> None:
        """Refuse a rest image that deviates from the model by more than a calibration error could explain."""
        for view, observer in zip(self.names, self.each, strict=True):
            observer.check_rest(f"{name}, view {view}")  # type: ignore[operator]

    def rest_given(self, rest_pixels: Any) -> Tensor:
        """Convert the markers at rest given by a caller, `[W, D, 2]` or `[N, 2]` px, to sightings."""
        rest = tensor_of("rest_pixels", rest_pixels).to(self.rest_pixels)
        if rest.shape[-1:] != (2,) or rest.numel() != 2 * self.views * self.count:
            raise MembraneError(f"rest_pixels {list(rest.shape)}; expected [{self.views}, {self.count}, 2], of each view")
        return rest.reshape(-1, 2)

    def before(self, previous: Any, frames: int) -> Tensor:
        """Return the pixels `[B, N, 2]` of a previous result, after checking that it fits these frames."""
        given, expected = getattr(previous, "pixels", None), [frames, self.views, self.count, 2]
        if not isinstance(given, Tensor) or list(given.shape) != expected:
            came = f"pixels {list(given.shape)}" if isinstance(given, Tensor) else f"no pixels: a {type(previous).__name__}"
            raise MembraneError(f"Reconstructor: previous has {came}; expected {expected}: an earlier result for each image")
        return self.sighted(given.to(self.rest_pixels))

    @traced
    def _split(self, values: Tensor | None, axis: int) -> Sequence[Tensor | None]:
        return [None] * self.views if values is None else values.chunk(self.views, axis)

    @traced
    def _together(self, flows: Sequence[MarkerFlow]) -> MarkerFlow:
        displacement, confidence, covariance, status = zip(*flows, strict=True)
        return MarkerFlow(
            torch.cat(displacement, 1), torch.cat(confidence, 1), torch.cat(covariance, 1), torch.stack(status, 1)
        )


def met_by_another(rig: Rig, pixels: Tensor, is_seen: Tensor) -> Tensor:
    """Return which sightings show the same point as another view, because their rays meet.

    A mistaken marker rarely passes: its pixel would have to lie close to the other view's epipolar line.

    Args:
        rig: cameras of the W views.
        pixels: `[B, W, D, 2]`, all with a viewing ray.
        is_seen: `[B, W, D]` bool.

    Returns:
        `[B, W, D]` bool.

    Example:
        >>> import numpy as np
        >>> from torchmembrane.camera.model import Camera
        >>> from torchmembrane.pose import ViewPose
        >>> camera = Camera("pinhole", (640, 480), (400, 400), (320, 240))
        >>> rig = Rig([camera, camera], [ViewPose(np.eye(3), np.array([x, 0.0, 0.0])) for x in (0.0, 20.0)])
        >>> pixels = torch.tensor([[[[360.0, 240.0], [360.0, 240.0]], [[320.0, 240.0], [320.0, 260.0]]]]).double()
        >>> met_by_another(rig, pixels, torch.ones(1, 2, 2) > 0)[0].tolist()
        [[True, False], [True, False]]
    """
    views = pixels.shape[1]
    origins, directions = (value.unflatten(1, (views, -1)) for value in rig.pixel_to_ray(pixels.flatten(1, 2)))
    is_met = torch.zeros_like(is_seen)
    for a, b in combinations(range(views), 2):
        point = _nearest_point(origins[:, a], directions[:, a], origins[:, b], directions[:, b])
        missed = (rig.point_to_pixel(torch.cat([point] * views, 1)).unflatten(1, (views, -1)) - pixels).norm(dim=-1)
        is_one = is_seen[:, a] & is_seen[:, b] & (missed[:, a] < MEETING) & (missed[:, b] < MEETING)
        is_met[:, a] |= is_one
        is_met[:, b] |= is_one
    return is_met


def _nearest_point(o: Tensor, d: Tensor, p: Tensor, e: Tensor) -> Tensor:
    """Return the midpoint `[..., 3]` of the shortest segment between lines through `o` and `p` along unit vectors `d` and
    `e`."""
    along = (d * e).sum(-1, keepdim=True)
    from_o, from_p = ((p - o) * d).sum(-1, keepdim=True), ((p - o) * e).sum(-1, keepdim=True)
    apart = (1 - along**2).clamp_min(torch.finfo(d.dtype).eps)
    s, t = (from_o - along * from_p) / apart, (along * from_o - from_p) / apart
    middle: Tensor = (o + s * d + p + t * e) / 2
    return middle
