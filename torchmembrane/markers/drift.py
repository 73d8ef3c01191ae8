"""Detection of drift: whether the markers without contact are still where the rest image shows them.

Temperature, creep, swelling, pressure or a moved camera displace all markers slightly, as a smooth field. The running mean of
the displacements in frames without contact is whitened by the noise of the rest image, which is the same in all frames, and
projected on polynomials of the image position. `S` is the sum of squares of the `k` coefficients, and `U` is that of the
remainder. With noise alone, `S / v` follows a chi-squared distribution with k degrees of freedom, where
`v = 1 + share x scatter` adds the noise that remains in the mean of the frames: `scatter` is the variance of a coefficient from
frame to frame, and `share` is the part of it that the mean keeps. With a harmless drift of `LEAST_DRIFT`, the distribution is
noncentral, with parameter `lambda`. Therefore

    z = (S / v - k - lambda) / sqrt(2 k + 4 lambda)

is the number of standard deviations by which `S` exceeds what noise and a harmless drift explain. A contact that is too light
to be detected moves only the markers near it and leaves a large `U`.
"""

from typing import NamedTuple

import torch
from torch import Tensor

from ..camera.motion import motion_of_pixels

POLYNOMIAL_ORDER = 4
"""Degree of the polynomials; lower if there are fewer than `MARKERS_PER_TERM` markers for each term."""
MARKERS_PER_TERM = 3
FRAMES_OF_MEAN = 15
"""Number of frames of the running mean."""
FEWEST_FRAMES = 10
"""Number of frames before a drift is reported."""
LEAST_DRIFT = 0.02
"""px, rms: a drift that does not matter; some sensors mistake three times as much for a contact."""
NEAR_REST = 0.05
"""px, rms: largest deviation of the markers from their positions without contact at which a contact is ascribed to drift."""
LEAST_CERTAINTY = 6.0
"""Standard deviations from which a drift is reported."""
LARGEST_ROUGHNESS = 0.04
"""Largest share of a drift's squared mean displacement, beyond noise, that a smooth field does not explain; a contact leaves
more."""


class Drift(NamedTuple):
    """The drift in a stream's frames without contact.

    Attributes:
        size: px, rms over the markers of the smooth field, beyond what noise explains; NaN before `FEWEST_FRAMES` frames.
        certainty: z, standard deviations beyond the noise and a harmless drift.
        roughness: share of the squared mean displacement that no smooth field explains, after subtracting noise.
    """

    size: float
    certainty: float
    roughness: float

    @property
    def is_certain(self) -> bool:
        """Return whether the drift is significant."""
        return self.certainty > LEAST_CERTAINTY and self.roughness < LARGEST_ROUGHNESS


class DriftWatch:
    """The markers' mean displacement over the latest frames without contact.

    Args:
        rest_pixels: `[D, 2]`, the markers at rest, px; with several views those of the first, then those of the second, and so
            on.
        rest_covariance: covariance of the frozen noise in the rest state, `[D, 2, 2]` px^2.
        seen: `[D]` bool, which markers were seen at rest.
        image_sizes: width and height of each view's image; each view has its own polynomials and camera motion.

    Limitations:
        A contact held for tens of frames that is too light or too wide to exceed `LARGEST_ROUGHNESS` looks like a drift.

    Example:
        >>> u, v = torch.meshgrid(torch.arange(0.0, 100, 10), torch.arange(0.0, 100, 10), indexing="ij")
        >>> pixels, everywhere = torch.stack([u, v], -1).reshape(-1, 2), torch.ones(100)
        >>> watch = DriftWatch(pixels, 0.05**2 * torch.eye(2).expand(100, 2, 2), everywhere > 0, (100, 100))
        >>> for _ in range(10):
        ...     watch.add(torch.full((100, 2), 0.1), everywhere)
        >>> round(watch.drift().size, 2), watch.drift().is_certain
        (0.14, True)
    """

    def __init__(self, rest_pixels: Tensor, rest_covariance: Tensor, seen: Tensor, *image_sizes: tuple[int, int]):
        self.seen = seen.cpu()
        root = torch.linalg.cholesky(rest_covariance.cpu().double()[self.seen])
        of_views = zip(rest_pixels.cpu().double().chunk(len(image_sizes)), self.seen.chunk(len(image_sizes)), strict=True)
        views = list(zip((pixels[seen] for pixels, seen in of_views), image_sizes, strict=True))
        terms = torch.block_diag(*(_polynomials(*view) for view in views))
        self.whitening = torch.linalg.inv(root)
        motion = torch.block_diag(*(motion_of_pixels(*view).flatten(0, 1) for view in views))
        moved_camera = self.whitening @ motion.unflatten(0, (-1, 2))
        self.rigid: Tensor = torch.linalg.qr(moved_camera.flatten(0, 1)).Q  # [2 D, 4 W]
        whitened = (self.whitening[..., None] * terms[:, None, None]).flatten(-2).flatten(0, 1)
        self.smooth: Tensor = torch.linalg.qr(whitened).Q  # [2 D, k]
        self.fields = root @ self.smooth.unflatten(0, (len(root), 2))  # [D, 2, k], px
        self.forget()

    def forget(self) -> None:
        """Start again."""
        self.frames, self.share, self.square = 0, 0.0, 0.0
        self.mean = self.fields.new_zeros(len(self.fields), 2)
        self.weight = torch.zeros_like(self.mean[:, :1])
        self.free: Tensor | None = None

    def add(self, displacement: Tensor, confidence: Tensor, is_free: bool = True) -> None:
        """Add a frame.

        Args:
            displacement: displacement of the markers from rest, `[D, 2]` px, NaN where lost.
            confidence: confidence of the markers, `[D]`.
            is_free: whether the frame itself shows no contact; otherwise a contact in it is ascribed to drift.
        """
        moved, found = self._moved(displacement, confidence), (confidence > 0).cpu()[self.seen, None].double()
        self.free = moved if is_free else self.free
        self.frames += 1
        gain = 1 / min(self.frames, FRAMES_OF_MEAN)
        self.weight = self.weight + gain * (found - self.weight)
        self.mean = self.mean + gain / self.weight.clamp_min(gain) * (moved - self.mean)
        self.square += gain * (float(self._coefficients(moved).square().sum()) - self.square)
        self.share = (1 - gain) ** 2 * self.share + gain**2

    def is_near(self, displacement: Tensor, confidence: Tensor) -> bool:
        """Return whether a frame's markers are close to their mean positions so far, or to those in the latest frame that
        itself shows no contact; arguments as for `add`."""
        if self.frames < FEWEST_FRAMES:
            return False
        moved, places = self._moved(displacement, confidence), (self.mean, self.free)
        return any(self._size(self._coefficients(moved - place)) < NEAR_REST for place in places if place is not None)

    def is_rigid(self, displacement: Tensor, confidence: Tensor) -> bool:
        """Return whether a frame's displacements are explained by a camera motion and noise alone, without contact; arguments
        as for `add`. The frame's noise is assumed to equal that of the rest state."""
        whitened = self._whitened(self._moved(displacement, confidence)) / 2**0.5
        S = float((whitened @ self.rigid).square().sum())
        terms = self.rigid.shape[1]
        rough = max(0.0, float(whitened.square().sum()) - S - (len(whitened) - terms))
        return (S - terms) / (2 * terms) ** 0.5 > LEAST_CERTAINTY and rough < LARGEST_ROUGHNESS * (rough + S - terms)

    def drift(self) -> Drift:
        """Return the drift in the frames so far."""
        if self.frames < FEWEST_FRAMES:
            return Drift(float("nan"), 0.0, 0.0)
        coefficients, (D, _, k) = self._coefficients(self.mean), self.fields.shape
        S = float(coefficients.square().sum())
        U = float(self._whitened(self.mean).square().sum()) - S
        scatter = max(0.0, self.square - S) / k
        v = 1 + self.share * scatter
        least = LEAST_DRIFT**2 * float(self.whitening.square().sum()) / 2
        certainty = (S / v - k - least) / (2 * k + 4 * least) ** 0.5
        rough, smooth = max(0.0, U - v * (2 * D - k)), max(0.0, S - v * k)
        roughness = rough / (rough + smooth) if rough > 0 else 0.0
        noise = v * float(self.fields.square().sum()) / D
        return Drift(max(0.0, self._size(coefficients) ** 2 - noise) ** 0.5, certainty, roughness)

    def _moved(self, displacement: Tensor, confidence: Tensor) -> Tensor:
        """Return the displacement of the markers seen at rest; for lost ones, the mean so far."""
        found = (confidence > 0).cpu()[self.seen, None]
        return torch.where(found, displacement.detach().cpu().double()[self.seen], self.mean)

    def _size(self, coefficients: Tensor) -> float:
        """Return the rms of a smooth field, px."""
        return float((self.fields @ coefficients).square().sum(-1).mean().sqrt())

    def _whitened(self, displacement: Tensor) -> Tensor:
        """Whiten displacements `[D, 2]` px to `[2 D]`, for which the frozen noise has unit covariance."""
        return (self.whitening @ displacement[..., None]).flatten()

    def _coefficients(self, displacement: Tensor) -> Tensor:
        return self._whitened(displacement) @ self.smooth


def _polynomials(pixels: Tensor, image_size: tuple[int, int]) -> Tensor:
    """Return the monomials of `pixels [D, 2]` about the image's centre, over half its longer side, `[D, T]`."""
    order = max(n for n in range(POLYNOMIAL_ORDER + 1) if n == 0 or MARKERS_PER_TERM * (n + 1) * (n + 2) / 2 <= len(pixels))
    size = pixels.new_tensor(image_size)
    u, v = ((2 * pixels - size) / size.max()).unbind(-1)
    return torch.stack([u**i * v**j for i in range(order + 1) for j in range(order + 1 - i)], -1)
