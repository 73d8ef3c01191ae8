"""Dots located softly: large ones coarse to fine, small ones where the large ones predict them."""

import numpy as np
import torch
from scipy.spatial import cKDTree
from torch import Tensor, nn

from ...control_flow import traced
from ...errors import MembraneError
from ..dots.ellipse import draw_dots, log_radii
from ..dots.flow import FlowAverages
from ..dots.locator import membrane_mask
from ..dots.pattern import DotPattern
from ..locator import LocatedMarkers, isotropic
from ..neighbourhood import NeighbourFlow, Neighbourhood
from ..spacing import spacing, thin_out
from .response import pyramid
from .search import DotGrowth, DotSearch, Found, predict

LOCATION_NOISE = 0.05  # px, of a dot in an image
FINE_PREDICTION_ERROR = 1.0  # radii, standard deviation of where a dot is expected on the fine level

REFERENCE_GREY = 0.5  # grey of which the logarithm is taken for 0
LEAST_GREY_SHARE = 0.15  # of it, what the darkest has at least: noise in the dark weighs no more than that
REFINEMENTS = 2  # soft-argmaxes on the fine level after the first, each about what the neighbours make of the one before
LEAST_DOT_CONTRAST = 0.2  # of a drawn dot's contrast, of a dot that is half believed
LEAST_RELATIVE_CONTRAST = 0.45  # of the mean contrast of the frame's clearer half
LEAST_LED_SHARE = 0.4  # share of the large dots around a small one that are found, where it is half believed
FLOW_TOLERANCE = 0.12  # of the distance to the nearest dot, what is expected between a flow and its neighbours'
LEAST_MEAN_CONFIDENCE = 0.2  # mean confidence of a frame that is half trusted
LOST_CONFIDENCE = 0.05  # confidence below which a dot is lost


class SoftLocator(nn.Module):
    """Pixels of dots of one size or two by soft-argmax: a piecewise smooth function of the image.

    Large dots are grown from the rim inwards on a coarse level, small ones looked for where the large ones around predict
    them (the paper's multi-scale matching, section 5); then all are refined on a fine level. A dot's weight in a window is
    a power of its response, a difference of Gaussians at its scale (`search.FINE_TEMPERATURE`: a fixed temperature).

    Args:
        pattern: the markers in the rest image.
        image_size: width, height.
        polarity: "dark" or "light".
        anchors: pixels `[A, 2]` of the rim, where nothing moves; without them dots are looked for about where they rest.

    Attributes:
        follows: True; the growth may start from the dots of the frame before.

    Raises:
        MembraneError: another polarity, fewer than 6 dots, or dots that are not finite.

    Limitations:
        The error is about 1.6 times that of `DotLocator`, whose ellipses follow the dots' outline; elongated dots near the
        rim are worst. Where the flow is more than about the spacing of neighbouring dots, or turns or shrinks fast, regions
        are lost, or found one spacing off and believed. A frame before that is one spacing off is followed. Large dots that
        are hidden cost the small ones between them. Gradients take the windows' whole pixels, the order in medians and what
        is lost as constant.

    Example:
        >>> rest = 20.0 * np.stack(np.meshgrid([1, 2, 3, 4], [1, 2, 3]), -1).reshape(-1, 2)
        >>> pattern = DotPattern(rest, np.tile(4.0 * np.eye(2), (12, 1, 1)), np.ones(12, int))
        >>> image = draw_dots(rest + [2.5, -1.5], pattern.shapes, (100, 80)).float()
        >>> pixels, confidence, _ = SoftLocator(pattern, (100, 80), "dark")(image)
        >>> (pixels[0] - torch.tensor(rest)).mean(0).round(decimals=1).tolist(), bool(confidence.min() > 0.9)
        ([2.5, -1.5], True)
    """

    follows = True
    rest: Tensor
    inside: Tensor
    large: Tensor
    small: Tensor
    order: Tensor
    lead: Tensor
    led_by_rim: Tensor
    is_small: Tensor
    tolerance: Tensor

    def __init__(self, pattern: DotPattern, image_size: tuple[int, int], polarity: str, anchors: np.ndarray | None = None):
        super().__init__()
        if polarity not in ("dark", "light"):
            raise MembraneError(f'SoftLocator: polarity is {polarity!r}, expected "dark" or "light"')
        pixels, shapes, sizes = (np.asarray(field) for field in pattern)
        if len(pixels) < 6 or not (np.isfinite(pixels).all() and np.isfinite(shapes).all()):
            raise MembraneError(
                f"SoftLocator: {len(pixels)} dots, {int(np.isnan(pixels).any(1).sum())} of them NaN, expected at least "
                "6, all finite; leave out dots that are not visible in the rest image"
            )
        anchors = np.zeros((0, 2)) if anchors is None else np.asarray(anchors, float)
        self.polarity = polarity
        inside = membrane_mask(pixels, anchors if len(anchors) else None, image_size)
        radii, largest = np.exp(log_radii(shapes)), sizes == sizes.max()
        others = _other_radii(pixels, radii, largest)
        nearest, mean = spacing(pixels)
        large, small = np.flatnonzero(largest), np.flatnonzero(~largest)
        self.growth = DotGrowth(pixels[large], radii[large], others[large], anchors, inside)
        self.by_large = DotSearch(radii[small], others[small], 1, 0.2 * nearest[small], inside) if len(small) else None
        self.refine = DotSearch(radii, others, -1, FINE_PREDICTION_ERROR * radii, inside)
        nodes = np.concatenate([pixels, thin_out(anchors, 0.7 * float(np.median(mean)))])
        self.averages = FlowAverages(pixels, nodes)
        self.neighbourhood = Neighbourhood(pixels, nodes[len(pixels) :])
        lead = self.averages.kernel[np.append(largest, np.ones(len(nodes) - len(pixels), bool))]
        lead, of_rim = np.split(lead / lead.sum(0), [len(large)])
        self.register_buffer("rest", torch.as_tensor(np.asarray(pixels, float)))
        self.register_buffer("inside", inside)
        self.register_buffer("large", torch.as_tensor(large))
        self.register_buffer("small", torch.as_tensor(small))
        self.register_buffer("order", torch.as_tensor(np.argsort(np.concatenate([large, small]))))
        self.register_buffer("lead", torch.as_tensor(lead))
        self.register_buffer("led_by_rim", torch.as_tensor(of_rim.sum(0)))
        self.register_buffer("is_small", torch.as_tensor(~largest))
        self.register_buffer("tolerance", torch.as_tensor(FLOW_TOLERANCE * nearest)[:, None])
        self._calibrate(draw_dots(pixels, shapes, image_size))
        self.float()

    def be_exact(self) -> None:
        """As of `Locator`: nothing changes."""

    def _calibrate(self, drawn: Tensor) -> None:
        """Take the drawn pattern `[1, 1, H, W]` for what sure dots look like."""
        self.double()
        levels = self.levels(drawn)
        self.growth.search.calibrate(levels, self.growth.pixels)
        if self.by_large is not None:
            self.by_large.calibrate(levels, self.rest[self.small])
        self.refine.calibrate(levels, self.rest)

    def forward(self, image: Tensor, previous: Tensor | None = None) -> LocatedMarkers:
        """Locate the dots in a batch of frames.

        Args:
            image: `[B, 1, H, W]`, grey in 0..1.
            previous: pixels `[B, D, 2]` in the preceding frames, NaN for lost dots, from which the search grows; without it,
                the search grows from the rim.

        Returns:
            The dots. If a frame contains a value that is not finite, all its confidences are 0.
        """
        levels, usable = self.begin(image)
        place, weight = self.growth(levels, None if previous is None else self.of_large(previous))
        if self.by_large is not None:
            place = self.join(place, self.find_small(levels, self.predict_small(place, weight)))
        return self.judge(self.fit(levels, place), usable)

    @traced
    def begin(self, image: Tensor) -> tuple[list[Tensor], Tensor]:
        """Return the pyramid, and which frames are usable, `[B]`."""
        finite = image.isfinite()
        dark = torch.where(finite, 1 - image if self.polarity == "light" else image, 0.0)
        return self.levels(dark), finite.flatten(1).all(1)

    @traced
    def of_large(self, values: Tensor) -> Tensor:
        """Return the values of the large dots, `[B, L, ...]`, from those of all dots, `[B, D, ...]`."""
        return values[:, self.large]

    def levels(self, dark: Tensor) -> list[Tensor]:
        """Return the pyramid, from fine to coarse, of the logarithm of images `dark [B, 1, H, W]`, zero off the membrane.

        In the logarithm, uneven light is a smooth summand.
        """
        return pyramid((dark.clamp(0, 1) / REFERENCE_GREY + LEAST_GREY_SHARE).log() * self.inside)

    @traced
    def join(self, large: Tensor, small: Tensor) -> Tensor:
        """Return values of all dots in the pattern's order, from those of the large and of the small dots, `[B, ...]`."""
        return torch.cat([large, small], 1)[:, self.order]

    @traced
    def predict_small(self, place: Tensor, weight: Tensor) -> Tensor:
        """Predict the pixels of the small dots, `[B, S, 2]`, from the large ones at `place [B, L, 2]` with `weight [B, L]`."""
        none = self.rest[self.small].expand(place.shape[0], -1, -1)
        flow, weight = self.join(place, none) - self.rest, self.join(weight, torch.zeros_like(none[..., 0]))
        gradient = torch.zeros_like(flow)[..., None].expand(-1, -1, -1, 2)
        for _ in range(2):  # the first draws the gradient to zero
            predicted, gradient, _ = predict(self.averages, weight, flow, gradient)
        return (self.rest + predicted)[:, self.small]

    @traced
    def find_small(self, levels: list[Tensor], predicted: Tensor) -> Tensor:
        """Return the pixels `[B, S, 2]` of the small dots, found on a coarse level around `predicted [B, S, 2]` px."""
        assert self.by_large is not None
        return self.by_large(self.by_large.response.maps(levels), predicted).place

    def fit(self, levels: list[Tensor], place: Tensor) -> Found:
        """All dots about `place [B, D, 2]` px on a fine level, each then again about where it and its neighbours put it."""
        maps = self.refine.response.maps(levels)
        found: Found = self.refine(maps, place)
        for _ in range(REFINEMENTS):
            found = self.refine(maps, self.settle(found))
        return found

    def settle(self, found: Found) -> Tensor:
        """Pixels `[B, D, 2]` of the dots that belong with their neighbours, of the others where these put them."""
        return self.mix(found.place, *self.compare(found))

    def judge(self, found: Found, usable: Tensor) -> LocatedMarkers:
        """What `forward` returns; `usable [B]` says which frames are."""
        return self.decide(found.place, *self.compare(found), usable)

    @traced
    def compare(self, found: Found) -> tuple[Tensor, Tensor]:
        """Where its neighbours put each dot `[B, D, 2]` px, and how much it looks like one and belongs with them `[B, D]`."""
        flow, quality = found.place - self.rest, self.quality(found)
        local: NeighbourFlow = self.neighbourhood(flow, quality, self.tolerance)
        return self.rest + local.flow, quality * local.trust(flow)

    @traced
    def mix(self, place: Tensor, expected: Tensor, trust: Tensor) -> Tensor:
        """Between `place` and `expected`, by `trust [B, D]` in the former."""
        return trust[..., None] * place + (1 - trust[..., None]) * expected

    def quality(self, found: Found) -> Tensor:
        """How much each dot looks like one, `[B, D]` in 0..1: dark as drawn and as the others, and sharp."""
        level = found.response.topk(found.response.shape[1] // 2, 1).values.mean(1, keepdim=True)
        alike = torch.sigmoid(20 * (found.response / (level + 1e-3) - LEAST_RELATIVE_CONTRAST))
        return torch.sigmoid(30 * (found.response - LEAST_DOT_CONTRAST)) * alike * found.sharpness

    @traced
    def decide(self, place: Tensor, expected: Tensor, confidence: Tensor, usable: Tensor) -> LocatedMarkers:
        """As `judge`, from what `compare` gives."""
        if self.by_large is not None:
            led = torch.sigmoid(20 * (confidence[:, self.large] @ self.lead + self.led_by_rim - LEAST_LED_SHARE))
            confidence = confidence * torch.where(self.is_small, led, 1.0)
        confidence = (
            confidence * torch.sigmoid(40 * (confidence.mean(-1, keepdim=True) - LEAST_MEAN_CONFIDENCE)) * usable[:, None]
        )
        confidence = ((confidence - LOST_CONFIDENCE) / (1 - LOST_CONFIDENCE)).relu()
        pixels = torch.where(confidence[..., None] > 0, place, expected)
        return LocatedMarkers(pixels, confidence, isotropic(confidence, LOCATION_NOISE))


def _other_radii(pixels: np.ndarray, radii: np.ndarray, largest: np.ndarray) -> np.ndarray:
    """Radii `[D]` that dots of the other size have near each dot, px; NaN where there is one size only."""
    others = np.full(len(pixels), np.nan)
    for of in (True, False) if not largest.all() else ():
        other = np.flatnonzero(largest != of)
        near = cKDTree(pixels[other]).query(pixels[largest == of], k=[1, 2, 3, 4][: len(other)])[1]
        others[largest == of] = np.exp(np.log(radii[other])[near].mean(1))
    return others
