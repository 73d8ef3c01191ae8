"""Whether matches hang together: seams and rivals."""

import numpy as np
import torch
from torch import Tensor, nn

from ..spacing import FADED, faded, neighbours, safe_length, spacing, square_distance

NEIGHBOURS = 6
SEAM = 2.0  # width of the neighbourhood in which a seam is looked for, pitches
TEAR = 0.045  # root of the share of dots lost and blobs left over, times the relative error of steps
STRAY = 0.07  # share of the neighbours lost, times the relative error of the steps to the others
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

    near: Tensor
    step: Tensor
    half_step: Tensor
    length: Tensor
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
        near = neighbours(pixels, NEIGHBOURS).T.copy()
        step = np.moveaxis(pixels[near] - pixels, -1, 0).copy()
        nearest, mean = spacing(pixels)
        square = ((pixels[:, None] - pixels) ** 2).sum(-1)
        kernel = faded(-square / (2 * (SEAM * mean) ** 2))  # [from, to]
        self.register_buffer("near", torch.as_tensor(near))
        self.register_buffer("step", torch.as_tensor(step))
        self.register_buffer("half_step", torch.as_tensor(step / 2))
        self.register_buffer("length", torch.as_tensor(np.linalg.norm(step, axis=0)))
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
        error, around, beside = self._error_of_steps(pixels, sure, gradient)
        tear = torch.minimum(lost, left).clamp_min(1e-12).sqrt() * around / TEAR
        stray = beside * error / STRAY
        return alone * torch.sigmoid(8 * (1 - tear)) * torch.sigmoid(8 * (1 - stray))

    def _error_of_steps(self, pixels: Tensor, sure: Tensor, gradient: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Relative error of the steps from every dot to its neighbours against the gradient, the same averaged around, and the
        share of the neighbours that is lost, `[B, D]` each."""
        here = torch.cat([gradient.flatten(2), pixels, sure[..., None]], -1)
        there = here.index_select(1, self.near.flatten()).mT.unflatten(-1, self.near.shape)  # [B, 7, neighbours, D]
        here = here.mT[:, :, None]
        ends = (there[:, :4] + here[:, :4]).unflatten(1, (2, 2))
        change = there[:, 4:6] - here[:, 4:6] - self.step - (ends * self.half_step).sum(2)
        pair = there[:, 6] * here[:, 6]
        error, pairs = (pair * safe_length(change, 1) / self.length).sum(1), pair.sum(1)
        return error / (pairs + 1e-3), (error @ self.share) / (pairs @ self.share + 1e-3), 1 - there[:, 6].mean(1)
