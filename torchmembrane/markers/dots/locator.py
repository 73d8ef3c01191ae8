"""Location of dots in a batch of frames: blobs at the pattern's scales, matched, then fitted to sub-pixel accuracy."""

from functools import partial

import numpy as np
import torch
from scipy import ndimage
from scipy.spatial import Delaunay, cKDTree
from torch import Tensor, nn

from ...control_flow import traced
from ...errors import MembraneError
from ..locator import LocatedMarkers
from ..native_frames import KEPT_STEPS, Constants, found_by, is_native
from ..noise import pixel_noise
from ..spacing import partly_in_view, spacing
from .detect import BlobDetector
from .ellipse import draw_dots, size_tolerance
from .fit import EllipseFit, FittedDots
from .match import DotMatcher
from .native_blobs import validities
from .native_fit import kept_fits
from .native_verdict import constants, outlines, verdicts
from .pattern import DotPattern
from .probability import LEAST, alone, among_neighbours, contrast_evidence, whole_evidence
from .pyramid import mean_pyramid
from .scales import FAINT, REACH, STEPS
from .seams import Seams

DIGITS = 8.0  # added to a value in 0..1, it leaves float32 with 20 binary digits after the point
BLOB, SHARE, NOISE, PIXEL, CONFIDENCE = 1 / 8, 1 / 64, 2.0**-18, 2.0**-14, 1 / 256
"""Steps to which the blobs' centres (px), shares of one, the noise (grey), the fitted dots' centres (px) and the confidence are
rounded. None of them is known more finely, and after rounding they are the same in every runtime. The confidence is rounded for
every sensor: its last bits depend on the place of the frame in its batch, and would change the frame's result."""
LARGEST_STRAIN = 0.5  # largest strain of the outlines from which the fit starts
SPARE = 1.3  # number of blobs searched per dot


def membrane_mask(pixels: np.ndarray, anchors: np.ndarray | None, image_size: tuple[int, int]) -> Tensor:
    """Return the mask `[1, 1, H, W]` of the pixels where dots can be: 1 more than 2 pixels inside the rim, else 0.

    It covers the short triangles between dots and anchors, and the vicinity of the dots in the long triangles of a dot.

    Raises:
        MembraneError: the whole mask lies outside the image.
    """
    width, height = image_size
    if anchors is None:
        return torch.ones(1, 1, height, width, dtype=torch.float64)
    points = np.concatenate([pixels, anchors])
    triangulation = Delaunay(points)
    corners = points[triangulation.simplices]
    longest = np.linalg.norm(corners - np.roll(corners, 1, 1), axis=-1).max(1)
    pitch = np.append(spacing(pixels)[1], np.zeros(len(anchors)))[triangulation.simplices].max(1)
    kept = np.append(longest < REACH * pitch, False)
    place = np.stack(np.meshgrid(np.arange(width), np.arange(height)), -1)
    triangle = triangulation.find_simplex(place)
    of_dot = np.append((triangulation.simplices < len(pixels)).any(1), False)
    inside, long = kept[triangle], (of_dot & ~kept)[triangle]
    distance, dot = cKDTree(pixels).query(place[long])
    inside[long] = distance < REACH * spacing(pixels)[1][dot]
    inside = ndimage.binary_erosion(ndimage.binary_closing(inside, iterations=2), iterations=2)
    if not inside.any():
        raise MembraneError(
            f"the membrane and its {len(pixels)} dots are not in the image of {width} x {height} px; expected it in the "
            "camera's view: check the camera's pose, centre and focal length"
        )
    return torch.as_tensor(inside, dtype=torch.float64)[None, None]


def is_inside(pixels: Tensor, image_size: tuple[int, int]) -> Tensor:
    """Return which of `pixels [..., 2]` lie in an image of this width and height, bool.

    A dot that its neighbours expect outside the image is not visible; a fit at the border in its place is something else.

    Example:
        >>> is_inside(torch.tensor([[0.0, 0.0], [3.0, 1.0], [3.0, 2.0], [-1.0, 0.0]]), (4, 2)).tolist()
        [True, True, False, False]
    """
    (u, v), (width, height) = pixels.unbind(-1), image_size
    return (u > -0.5) & (u < width - 0.5) & (v > -0.5) & (v < height - 0.5)


def short(image: Tensor) -> Tensor:
    """Round an image in 0..1 to so few digits that float32 sums over 4 x 4 pixels are exact, whatever their order.

    Example:
        >>> bool(short(torch.tensor(0.7)) == round(0.7 * 2**20) / 2**20)
        True
    """
    return (image + DIGITS) - DIGITS


def rounded(value: Tensor, step: float) -> Tensor:
    """Round to the nearest multiple of a step; gradients are those of the unrounded value.

    Example:
        >>> rounded(torch.tensor([0.3, 7.0]), 0.125).tolist()
        [0.25, 7.0]
    """
    fixed = value.detach()
    return (fixed / step).round() * step + (value - fixed)


def in_few_digits(value: Tensor) -> Tensor:
    """Round a value in double precision to 12 binary digits.

    Example:
        >>> bool(in_few_digits(torch.tensor(0.7).double()) == round(0.7 * 2**12) / 2**12)
        True
    """
    far = value * (2.0**41 + 1)
    return far - (far - value)


class DotLocator(nn.Module):
    """Locates the pattern's dots in each frame of a batch, with a confidence.

    Blobs are detected at the pattern's scales and matched, from the previous positions of the dots or else by a smooth flow on
    which neighbours agree. A blurred ellipse on a sloping background is then fitted to each. A lost dot has confidence 0 and
    its predicted pixel.

    Args:
        pattern: the markers in the rest image.
        image_size: width, height.
        polarity: "dark" or "light".
        anchors: pixels of the rim, `[A, 2]`, closer together than the dots; no dot is searched beyond them; default: dots
            are searched in the whole image.

    Attributes:
        follows: True; dots are followed from frame to frame.

    Raises:
        MembraneError: the polarity is unknown, there are fewer than 6 dots, or dots are not finite.

    Limitations:
        The flow may change by at most about half a pitch from one dot to the next. Matches are wrong where the spacing is below
        about half of that at rest, where the middle of the pattern turns by more than about 30 degrees relative to its outline,
        or where a part of it moves by more than 2.5 pitches. Most such regions end in a seam and are lost with their vicinity.
        The others are off by a whole pitch with high confidence; this is more frequent if all dots have the same size. If a
        lattice moves as a whole by one lattice step, only its outline shows the motion: dots are lost on one side, and blobs
        without a dot appear on the other. A blob beside a missing dot may be mistaken for it if it has the same size. If many
        dots are missing (20 %) and there are as many false ones, correct dots are lost as well.

    Example:
        >>> rest = 20.0 * np.stack(np.meshgrid([1, 2, 3, 4], [1, 2, 3]), -1).reshape(-1, 2)
        >>> pattern = DotPattern(rest, np.tile(4.0 * np.eye(2), (12, 1, 1)), np.ones(12, int))
        >>> image = draw_dots(rest + [2.5, -1.5], pattern.shapes, (100, 80)).float()
        >>> pixels, confidence, _ = DotLocator(pattern, (100, 80), "dark")(image)
        >>> (pixels[0] - torch.tensor(rest)).mean(0).round(decimals=1).tolist(), bool(confidence.min() > 0.9)
        ([2.5, -1.5], True)
    """

    follows = True
    strength: Tensor
    rest: Tensor
    shapes: Tensor

    def __init__(self, pattern: DotPattern, image_size: tuple[int, int], polarity: str, anchors: np.ndarray | None = None):
        super().__init__()
        if polarity not in ("dark", "light"):
            raise MembraneError(f'DotLocator: polarity is {polarity!r}, expected "dark" or "light"')
        pixels, shapes = np.asarray(pattern.pixels, float), np.asarray(pattern.shapes, float)
        if len(pixels) < 6 or not (np.isfinite(pixels).all() and np.isfinite(shapes).all()):
            raise MembraneError(
                f"DotLocator: {len(pixels)} dots, {int(np.isfinite(pixels).all(1).sum())} of them at finite pixels; expected "
                "at least 6, all with finite pixels and shapes: leave out dots that are not visible in the rest image"
            )
        self.polarity, self.image_size, self.is_exact = polarity, tuple(image_size), False
        tolerance = size_tolerance(shapes, np.asarray(pattern.sizes))
        self.fit = EllipseFit(pixels, shapes, image_size, tolerance)
        inside = membrane_mask(pixels, anchors, image_size)
        radii = np.sqrt(np.abs(np.linalg.det(shapes)))
        self.detect = BlobDetector(radii, spacing(pixels)[0].min(), int(SPARE * len(pixels)), inside)
        drawn = mean_pyramid(draw_dots(pixels, shapes, image_size))
        blobs, log_radius, strength = (x[0].numpy() for x in self.detect.double()(drawn))
        blobs, log_radius, strength = (x[strength > 1e-6] for x in (blobs, log_radius, strength))  # the rest fill up the count
        own = cKDTree(blobs).query(pixels)[1]
        self.match = DotMatcher(pixels, log_radius[own], tolerance, partly_in_view(pixels, shapes, image_size))
        self.seams = Seams(pixels, log_radius[own], tolerance)
        self.constants = Constants(partial(constants, confidence=CONFIDENCE, largest=LARGEST_STRAIN))
        self.register_buffer("strength", torch.as_tensor(strength[own]))
        self.register_buffer("rest", torch.as_tensor(pixels))
        self.register_buffer("shapes", torch.as_tensor(shapes))
        self.float()

    def be_exact(self) -> None:
        """As in `Locator`: the fit runs in double precision, from a rounded start."""
        self.is_exact = True
        self.fit.double()
        self.shapes = self.shapes.double()

    @property
    def is_compiled(self) -> bool:
        """Whether machine code of the fit and of the matching steps exists already."""
        return all(each.is_compiled(np.dtype(np.float32)) for each in (kept_fits, *KEPT_STEPS.values()))

    def forward(self, image: Tensor, previous: Tensor | None = None) -> LocatedMarkers:
        """Locate the dots in a batch of frames.

        Args:
            image: images, `[B, 1, H, W]`, grey in 0..1.
            previous: pixels in the previous frames, `[B, D, 2]`, from which the dots are followed, NaN for lost dots;
                without it dots are followed from rest.
        """
        level_0, level_1, level_2, blobs, log_radius, valid = self.begin(image)
        place, certainty, strain = self.match(blobs, log_radius, valid, previous)
        return self.end(level_0, level_1, level_2, blobs, log_radius, valid, place, certainty, strain)

    @traced
    def begin(self, image: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor, Tensor]:
        """Return the levels of the pyramid, and the blobs: centres `[B, K, 2]`, log radii `[B, K]`, and the probability that
        each is a dot."""
        image = 1 - image if self.polarity == "light" else image
        levels = mean_pyramid(short(image) if self.is_exact else image)
        blobs, log_radius, strength = self.detect(levels)
        valid = self.validity(blobs, strength)
        level_0, level_1, level_2 = levels
        start = self._alike(blobs, BLOB), self._alike(log_radius, SHARE), self._alike(valid, SHARE)
        return level_0, level_1, level_2, *start

    def validity(self, blobs: Tensor, strength: Tensor) -> Tensor:
        """Return the probability `[B, K]` that each of the blobs is a dot, from their strength relative to that at rest."""
        if is_native(blobs, strength, self.strength):
            return found_by(validities, (self.rest.numpy(), self.strength.numpy()), (blobs, strength), blobs.shape[1])
        relative = strength / self.strength[self.match.nearest_dots(blobs)]
        level = relative[:, : self.rest.shape[0] // 2].mean(1, keepdim=True).clamp_min(LEAST)
        return torch.sigmoid(contrast_evidence(relative / level, FAINT))

    @traced
    def end(
        self,
        level_0: Tensor,
        level_1: Tensor,
        level_2: Tensor,
        blobs: Tensor,
        log_radius: Tensor,
        valid: Tensor,
        place: Tensor,
        certainty: Tensor,
        strain: Tensor,
    ) -> LocatedMarkers:
        """Return the dots, fitted around the positions from the matcher."""
        noise = self._alike(pixel_noise(level_0.detach()), NOISE)
        fitted = self.fit([level_0, level_1, level_2], place, self.outlines(certainty, place, strain), noise, STEPS)
        size = level_0.shape[-1], level_0.shape[-2]
        pixels, confidence = self.judged(fitted, strain, blobs, log_radius, valid, size)
        covariance = in_few_digits(fitted.covariance) if self.is_exact else fitted.covariance
        return LocatedMarkers(self._alike(pixels, PIXEL), confidence, covariance)

    def outlines(self, certainty: Tensor, place: Tensor, strain: Tensor) -> Tensor:
        """Return the outlines `[B, D, 2, 2]` from which the fits start: those at rest under the gradient of the flow."""
        rest, shapes = self.rest, self.shapes
        if not self.is_exact and is_native(certainty, place, strain, shapes):
            given = certainty, place, strain.movedim(1, -1)
            return found_by(outlines, self.constants.of(self, rest), given, len(rest), 2, 2)
        gradient = self._alike(self.match.gradient(certainty, place - rest, strain).movedim(-1, 1), SHARE)
        return shapes + gradient.clamp(-LARGEST_STRAIN, LARGEST_STRAIN).to(shapes) @ shapes

    def judged(
        self,
        fitted: FittedDots,
        strain: Tensor,
        blobs: Tensor,
        log_radius: Tensor,
        valid: Tensor,
        image_size: tuple[int, int],
    ) -> tuple[Tensor, Tensor]:
        """Return the pixels `[B, D, 2]` of fitted dots, where they are found, and the confidence `[B, D]` in them."""
        rest, scene = self.rest, (blobs, log_radius, valid)
        if not self.is_exact and is_native(*fitted, strain, *scene, rest):
            given = fitted.centre, fitted.explained, fitted.contrast, fitted.misfit, strain.movedim(1, -1), *scene
            found = found_by(verdicts, (self.constants.of(self, rest), image_size), given, 3, len(rest))
            return found[:, 1:].mT, found[:, 0]
        dots = FittedDots(*(value.to(rest) for value in fitted))
        by_itself = alone(dots)
        found, error = self.match.neighbour_steps(dots.centre.mT, by_itself, strain.movedim(1, -1))
        whole = whole_evidence(self.seams(dots.centre, by_itself, error, *scene))
        share = (by_itself @ self.match.seen.to(by_itself) / self.match.seen.sum())[:, None]
        confidence = rounded(among_neighbours(dots, share * found, error, whole), CONFIDENCE)
        flow, _, _ = self.match.predict(confidence, dots.centre - rest, strain)
        confidence = confidence * is_inside(rest + flow, image_size).to(confidence)
        return torch.where(confidence[..., None] > 0.5, fitted.centre, rest + flow), confidence

    def _alike(self, value: Tensor, step: float) -> Tensor:
        """Return the value, or its nearest multiple of a step if every runtime must compute the same."""
        return rounded(value, step) if self.is_exact else value
