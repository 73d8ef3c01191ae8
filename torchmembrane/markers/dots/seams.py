"""Seams of the matching: borders of regions that are matched one pitch off."""

import numpy as np
import torch
from torch import Tensor, nn

from ..spacing import FADED, faded, spacing, square_distance
from .scales import PREDICTION, REACH

LEAST = 1e-3


class Seams(nn.Module):
    """Measures how torn the matched pattern is around every dot.

    A region matched one pitch off ends in a seam. There dots are lost, blobs of their size are left over, and the step from a
    dot to its neighbour differs from the step at rest under the deformation measured at both. Lost dots or left-over blobs
    alone, or a flow that varies fast, are not a seam.

    Args:
        pixels: centres of the dots at rest, `[D, 2]`, px.
        log_radius: log radii from the blob detector at rest, `[D]`.
        size_tolerance: standard deviation of a dot's log radius.
    """

    share: Tensor
    total: Tensor
    narrowness: Tensor
    origin: Tensor
    claim: Tensor
    log_radius: Tensor

    def __init__(self, pixels: np.ndarray, log_radius: np.ndarray, size_tolerance: float):
        super().__init__()
        self.size_narrowness = -0.5 / size_tolerance**2
        nearest, mean = spacing(pixels)
        kernel = faded(-((pixels[:, None] - pixels) ** 2).sum(-1) / (2 * (REACH * mean) ** 2))  # [from, to]
        self.register_buffer("share", torch.as_tensor(kernel / kernel.sum(0)))
        self.register_buffer("total", torch.as_tensor(kernel.sum(0)))
        self.register_buffer("narrowness", torch.as_tensor(-0.5 / (REACH * mean) ** 2))
        self.register_buffer("origin", torch.as_tensor(pixels.mean(0)))
        self.register_buffer("claim", torch.as_tensor((PREDICTION * nearest) ** 2))
        self.register_buffer("log_radius", torch.as_tensor(log_radius))

    def forward(self, pixels: Tensor, sure: Tensor, wrong: Tensor, blobs: Tensor, log_radius: Tensor, valid: Tensor) -> Tensor:
        """Return the root of the share of lost dots and left-over blobs, times the relative error of steps, `[B, D]`.

        Args:
            pixels: positions of the found dots, `[B, D, 2]`, px.
            sure: certainty of the dots, `[B, D]` in 0..1.
            wrong: relative error of the steps to their neighbours, `[B, D]`.
            blobs: positions of the blobs, `[B, K, 2]`, px.
            log_radius: log radii of the blobs, `[B, K]`, as for `DotMatcher`.
            valid: probability that each blob is a dot, `[B, K]`, as for `DotMatcher`.
        """
        square = square_distance(blobs - self.origin, pixels - self.origin)  # [B, K, D]
        claimed = ((square < self.claim) * sure[:, None]).amax(-1)
        misfit = log_radius - self.log_radius[square.argmin(-1)]
        left = valid * torch.exp(misfit.square() * self.size_narrowness) * (1 - claimed)
        left = (left[:, None] @ torch.exp((square * self.narrowness).clamp_min(-FADED))).squeeze(1) / self.total
        lost = (1 - sure) @ self.share
        around = ((sure * wrong) @ self.share) / (sure @ self.share).clamp_min(LEAST)
        return torch.minimum(lost, left).clamp_min(LEAST**4).sqrt() * around
