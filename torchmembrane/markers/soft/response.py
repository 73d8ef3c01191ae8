"""Similarity of an image to dots, each at its own scale: differences of Gaussians on a pyramid."""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from kornia.filters import gaussian_blur2d
from torch import Tensor, nn

from ...control_flow import traced
from ...torch_modes import on_cpu
from ..texture.pyramid import low_pass

LEVELS = 5  # of the pyramid, by halves
LEAST_RADIUS = 1.5  # px, least radius of a dot on the coarsest level that still shows its shape
SIGMA_RATIO = 1.6**0.5  # ratio of neighbouring Gaussians; a response is the difference of two that are two rungs apart
LEAST_SHARE = 0.02  # of a Gaussian that is on the membrane, where its mean is taken for one
MOST_TAKEN_OFF = 0.75  # share of the other size's response that is taken off at most
DISC_RESPONSE = 2 / np.e  # Laplacian of Gaussian at the centre of a disc of radius `2^0.5 sigma`, its largest


class Windows(NamedTuple):
    """Responses `value [B, D, n, n]` about `middle [B, D, 2]`, px."""

    value: Tensor
    middle: Tensor


def disc_response(radius: np.ndarray, sigma: np.ndarray) -> np.ndarray:
    """Return `sigma^2` times the Laplacian of Gaussian at the centre of a disc of contrast 1.

    Example:
        >>> bool(np.isclose(disc_response(np.array(3.0), np.array(3 / 2**0.5)), DISC_RESPONSE))
        True
    """
    ratio = np.square(radius / sigma)
    return ratio * np.exp(-ratio / 2)


def pyramid(image: Tensor) -> list[Tensor]:
    """Return the image and `LEVELS` - 1 low-passed halvings of it: pixel `p` of level `k` is at `2^k p` of the image.

    Example:
        >>> [list(level.shape) for level in pyramid(torch.zeros(1, 1, 64, 80))][2:]
        [[1, 1, 16, 20], [1, 1, 8, 10], [1, 1, 4, 5]]
    """
    levels = [image]
    for _ in range(LEVELS - 1):
        levels.append(low_pass(levels[-1], 2))
    return levels


class DotResponse(nn.Module):
    """Difference of Gaussians at each dot's own scale, minus the response of the other dot size.

    The scale is `radius / 2^0.5`, where the response to a disc is largest. A pattern of two sizes has two scales about each
    place: of the other size's response as much is taken off as makes this one vanish at its dots.

    Args:
        radii: radii of the dots, `[D]`, px.
        others: radii of dots of the other size at the same places, `[D]`, px; NaN if there is one size only.
        coarser: number of pyramid levels above the coarsest that still shows a dot's shape (negative: below).
        reach: half side of the windows, `[D]`, px.
        inside: `[1, 1, H, W]`, 1 on the membrane, else 0: pixels outside have zero weight in the Gaussians.
    """

    order: Tensor
    stride: Tensor
    share: Tensor

    def __init__(self, radii: np.ndarray, others: np.ndarray, coarser: int, reach: np.ndarray, inside: Tensor):
        super().__init__()
        level = (np.floor(np.log2(np.maximum(radii / LEAST_RADIUS, 1))).astype(int) + coarser).clip(max(coarser, 0), LEVELS - 1)
        stride, masks = 2.0**level, pyramid(inside.double())
        self.levels = [int(k) for k in np.unique(level)]
        fits = min((min(masks[k].shape[-2:]) - 1) // 2 for k in self.levels)
        self.half_width = max(1, min(int(np.ceil((reach / stride).max())), fits))
        sigma, other = (r / 2**0.5 / stride for r in (radii, np.where(np.isfinite(others), others, radii)))
        share = np.minimum(disc_response(2**0.5 * other, sigma) / DISC_RESPONSE, MOST_TAKEN_OFF)
        self.rungs: dict[int, list[int]] = {}
        dots = [np.flatnonzero(level == k) for k in self.levels]
        for k, on_level in zip(self.levels, dots, strict=True):
            self._register_level(k, on_level, sigma, other, masks[k])
        self.register_buffer("order", torch.as_tensor(np.argsort(np.concatenate(dots))))
        self.register_buffer("stride", torch.as_tensor(stride))
        self.register_buffer("share", torch.as_tensor(np.where(np.isfinite(others), share, 0.0)))

    def _register_level(self, k: int, dots: np.ndarray, sigma: np.ndarray, other: np.ndarray, mask: Tensor) -> None:
        """Register which dots have their response on level `k`, in which of its maps, and where their windows' pixels are in
        them."""
        own, its_other = (np.round(np.log(s[dots]) / np.log(SIGMA_RATIO)).astype(int) for s in (sigma, other))
        self.rungs[k] = sorted({*own.tolist(), *its_other.tolist()})
        height, width = mask.shape[-2:]
        step = np.arange(-self.half_width, self.half_width + 1)
        channels = [np.searchsorted(self.rungs[k], rung) * height * width for rung in (own, its_other)]
        self.register_buffer(f"dots{k}", torch.as_tensor(dots))
        self.register_buffer(f"step{k}", torch.as_tensor((step[:, None] * width + step).ravel()))
        self.register_buffer(f"channel{k}", torch.as_tensor(np.stack(channels)[..., None]))
        self.register_buffer(f"mask{k}", mask)
        self.register_buffer(f"covered{k}", 1 / (gaussians(mask, self.rungs[k]) + LEAST_SHARE))
        self.register_buffer(f"limit{k}", torch.as_tensor(np.array([width, height]) - 1 - self.half_width))

    @traced
    def maps(self, levels: list[Tensor]) -> list[Tensor]:
        """Return the responses to dark discs on each level in use, one map for each scale: `[B, scales, h, w]`.

        Args:
            levels: pyramid of an image that is zero outside the membrane.
        """
        return [self._dark_blobs(k, levels[k]) for k in self.levels]

    def _dark_blobs(self, k: int, level: Tensor) -> Tensor:
        """Return differences of the means over Gaussians two rungs apart on level `k [B, 1, h, w]`: positive on dark blobs."""
        rungs = self.rungs[k]
        mean, at = gaussians(level, rungs) * self.get_buffer(f"covered{k}"), _with_neighbours(rungs)
        above, below = ([at.index(rung + side) for rung in rungs] for side in (1, -1))
        return (mean[:, above] - mean[:, below]) * self.get_buffer(f"mask{k}")

    def windows(self, maps: Sequence[Tensor], centre: Tensor) -> Windows:
        """Return each dot's response around `centre [B, D, 2]` px; near the border, windows are clipped."""
        values, middles = [], []
        for k, each in zip(self.levels, maps, strict=True):
            near = centre.detach().index_select(1, self.get_buffer(f"dots{k}")) / 2**k
            pixel = near.round().to(torch.int64).clamp_min(self.half_width)
            pixel = torch.minimum(pixel, self.get_buffer(f"limit{k}"))
            first = pixel[..., :1] + each.shape[-1] * pixel[..., 1:] + self.get_buffer(f"step{k}")
            own, other = (each.flatten(1).gather(1, (first + c).flatten(1)) for c in self.get_buffer(f"channel{k}"))
            pair = torch.stack([own, other], -1).unflatten(1, first.shape[1:])
            values.append(pair)
            middles.append(pixel.to(centre.dtype) * 2**k)
        pair, middle = (torch.cat(parts, 1)[:, self.order] for parts in (values, middles))
        value = pair[..., 0] - self.share[:, None] * pair[..., 1]
        side = 2 * self.half_width + 1
        return Windows(value.unflatten(-1, (side, side)), middle)


def gaussians(image: Tensor, rungs: list[int]) -> Tensor:
    """Return blurred images `[B, scales, h, w]` of `image [B, 1, h, w]`, by `SIGMA_RATIO ** rung` for the neighbours of
    `rungs`."""
    return torch.cat([_blurred(image, SIGMA_RATIO**rung) for rung in _with_neighbours(rungs)], 1)


def _with_neighbours(rungs: list[int]) -> list[int]:
    """Return `rungs` and their neighbours.

    >>> _with_neighbours([1, 3])
    [0, 2, 4]
    """
    return sorted({rung + side for rung in rungs for side in (1, -1)})


@on_cpu  # of kornia's sigma, which it checks on the host
def _blurred(image: Tensor, sigma: float) -> Tensor:
    half = min(max(1, math.ceil(3 * sigma)), min(image.shape[-2:]) - 1)
    return gaussian_blur2d(image, 2 * half + 1, (sigma, sigma), "replicate")
