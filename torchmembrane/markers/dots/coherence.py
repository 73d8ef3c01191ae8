"""Whether matches hang together: seams and rivals."""

import numpy as np
import torch
from torch import Tensor, nn

from ..spacing import FADED, faded, safe_length, spacing, square_distance
from .native_coherence import trust_of
from .native_flow import is_native
from .steps import STRAY, NeighbourSteps, trust

SEAM = 2.0  # width of the neighbourhood in which a seam is looked for, pitches
TEAR = 0.045  # root of the share of dots lost and blobs left over, times the relative error of steps
CLAIM = 0.35  # a blob so near to a dot is the dot's, pitches
RIVAL = 0.05  # a blob left over is as near to the prediction as the dot's own, pitches


class Coherence(nn.Module):
    """Whether the matches around every dot hang together: 1, or towards 0 where the pattern is torn.

    A region matched one pitch off ends in a seam, where dots are lost, blobs of their size are left over, and the step
    from a dot to its neighbour is not what the deformation measured at both makes of it at rest. Lost dots or blobs left
    over alone, or a field that varies fast, are no seam. A single dot on another's blob is a seam of its own: its neighbour is
    lost, and the steps to the others are wrong. A blob left over as near to the prediction as the dot's own is its rival: then
    neither is believed.

    Args:
        pixels: centres `[D, 2]` of the dots at rest, px.
        log_radius: `[D]`, as the blob detector finds it at rest.
        size_tolerance: standard deviation of a dot's log radius.
    """

    share: Tensor
    total: Tensor
    narrowness: Tensor
    origin: Tensor
    claim: Tensor
    rival: Tensor
    decision: Tensor
    log_radius: Tensor

    def __init__(self, pixels: np.ndarray, log_radius: np.ndarray, size_tolerance: float):
        super().__init__()
        self.size_tolerance = size_tolerance
        self.steps = NeighbourSteps(pixels)
        nearest, mean = spacing(pixels)
        square = ((pixels[:, None] - pixels) ** 2).sum(-1)
        kernel = faded(-square / (2 * (SEAM * mean) ** 2))  # [from, to]
        self.register_buffer("share", torch.as_tensor(kernel / kernel.sum(0)))
        self.register_buffer("total", torch.as_tensor(kernel.sum(0)))
        self.register_buffer("narrowness", torch.as_tensor(-0.5 / (SEAM * mean) ** 2))
        self.register_buffer("origin", torch.as_tensor(pixels.mean(0)))
        self.register_buffer("claim", torch.as_tensor((CLAIM * nearest) ** 2))
        self.register_buffer("rival", torch.as_tensor(RIVAL * nearest))
        self.register_buffer("decision", torch.as_tensor(20 / nearest))
        self.register_buffer("log_radius", torch.as_tensor(log_radius))

    def forward(
        self,
        pixels: Tensor,
        confidence: Tensor,
        gradient: Tensor,
        predicted: Tensor,
        blobs: Tensor,
        log_radius: Tensor,
        valid: Tensor,
    ) -> Tensor:
        """Trust `[B, D]` in 0..1 in the matches of a frame.

        Args:
            pixels: of the dots as found `[B, D, 2]`, px.
            confidence: `[B, D]` in 0..1.
            gradient: of the flow `[B, D, 2, 2]`.
            predicted: where its neighbours predict each dot `[B, D, 2]`, px.
            blobs: `[B, K, 2]`, px; log_radius, valid: `[B, K]`, as for `DotMatcher`.
        """
        given = pixels, confidence, gradient, predicted, blobs, log_radius, valid
        if is_native(*given, self.share):
            return trust_of(self, (-0.5 / self.size_tolerance**2, TEAR, STRAY), *given)
        sure = torch.sigmoid(20 * (confidence - 0.5))
        places = torch.cat([pixels, predicted], 1) - self.origin
        square, other = square_distance(blobs - self.origin, places).chunk(2, -1)  # [B, K, D]
        claimed = ((square < self.claim) * sure[:, None]).amax(-1)
        misfit = log_radius - self.log_radius[square.argmin(-1)]
        left = valid * torch.exp(misfit.square() * (-0.5 / self.size_tolerance**2)) * (1 - claimed)
        nearer = safe_length(pixels - predicted, -1) + self.rival
        margin = nearer[:, None] - other.clamp_min(1e-12).sqrt()
        alone = 1 - (left[..., None] * torch.sigmoid(margin * self.decision)).amax(1)
        left = (left[:, None] @ torch.exp((square * self.narrowness).clamp_min(-FADED))).squeeze(1) / self.total
        lost = (1 - sure) @ self.share
        error, pairs, beside = self.steps(pixels.mT, sure, gradient.movedim(1, -1))
        around = (error @ self.share) / (pairs @ self.share + 1e-3)
        tear = torch.minimum(lost, left).clamp_min(1e-12).sqrt() * around
        return alone * torch.sigmoid(8 * (1 - tear / TEAR)) * trust(error, pairs, beside)
