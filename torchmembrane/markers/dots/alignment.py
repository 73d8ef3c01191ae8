"""Position of a pattern as a whole: the shift on which most dots agree, then an affine map."""

import numpy as np
import torch
from torch import Tensor, nn

from ...control_flow import traced
from ...solve.elimination import solve_dense
from ..neighbourhood import weighted_median
from ..spacing import spacing, square_distance
from .probability import LEAST
from .scales import CANDIDATES, NONE, REACH, STEPS

VOTE = 0.4  # pitches: width of a vote, spacing of the shifts, and initial search radius of the affine map


class Alignment(nn.Module):
    """Aligns a pattern as a whole with the blobs of a frame.

    There are two starts: the previous positions of the dots, and the rest pattern under the median of the deformation measured
    at the blobs. For each start, all pairs of a dot and a blob vote for a shift; small shifts have more weight. The start with
    the most votes is then aligned with the blobs by an affine map, in a few expectation-maximisation steps (after Myronenko and
    Song 2010).

    Args:
        pixels: centres of the dots at rest relative to their mean, `[D, 2]`, px.
        seen: which of them are in the image at rest, `[D]` bool; only these vote.
    """

    pixels: Tensor
    unit: Tensor
    shifts: Tensor
    home: Tensor
    ridge: Tensor
    seen: Tensor

    def __init__(self, pixels: np.ndarray, seen: np.ndarray):
        super().__init__()
        shifts = np.linspace(-REACH, REACH, 1 + 2 * round(REACH / VOTE))
        self.register_buffer("pixels", torch.as_tensor(pixels))
        self.register_buffer("unit", torch.as_tensor(np.median(spacing(pixels)[0])))
        self.register_buffer("shifts", torch.as_tensor(shifts))
        self.register_buffer("home", torch.as_tensor(np.exp(-(shifts[:, None] ** 2 + shifts**2) / (2 * REACH) ** 2)))
        self.register_buffer("seen", torch.as_tensor(seen.astype(float))[:, None])
        self.register_buffer("ridge", 1e-3 * torch.eye(3, dtype=torch.float64))

    @traced
    def forward(self, before: Tensor, blobs: Tensor, misfit: Tensor, deformation: Tensor, valid: Tensor) -> Tensor:
        """Return the expected positions of the dots.

        Args:
            before: previous positions, `[B, D, 2]`, px; all positions here are relative to the pattern's mean at rest.
            blobs: positions of the blobs, `[B, K, 2]`, px.
            misfit: misfit of the blobs' sizes, `[B, D, K]`, squared standard deviations.
            deformation: deformation gradient at the blobs, `[B, 2, 2, K]`.
            valid: probability that each blob is a dot, `[B, K]`, in 0..1.

        Returns:
            `[B, D, 2]`, px.
        """
        weight = torch.exp(-0.5 * misfit) * self.seen
        typical = weighted_median(deformation.flatten(1, 2).mT, valid).unflatten(-1, (2, 2))
        before, votes = self.shifted(before, blobs, weight)
        mapped, others = self.shifted(self.pixels @ typical.mT, blobs, weight)
        place = torch.where((others > votes)[:, None, None], mapped, before)
        for _ in range(STEPS):
            place = self.mapped(place, blobs, weight, VOTE * self.unit)
        return place

    def shifted(self, place: Tensor, blobs: Tensor, weight: Tensor) -> tuple[Tensor, Tensor]:
        """Return `place [B, D, 2]` after the shift with the most votes, and the number of these votes `[B]`."""
        square = square_distance(place, blobs)
        near = square / (2 * (REACH * self.unit) ** 2) - weight.clamp_min(LEAST).log()
        index = near.topk(min(CANDIDATES, blobs.shape[1]), largest=False).indices
        there = blobs.gather(1, index.flatten(1)[..., None].expand(-1, -1, 2)).unflatten(1, index.shape[1:])
        offset = ((there - place[:, :, None]) / self.unit).flatten(1, 2)
        along_u, along_v = torch.exp(-((offset[..., None] - self.shifts) / VOTE).square() / 2).unbind(2)
        votes = ((along_u * weight.gather(2, index).flatten(1)[..., None]).mT @ along_v * self.home).flatten(1)
        most, best = votes.max(-1)
        count = len(self.shifts)
        shift = self.shifts[torch.stack([best // count, best % count], -1)]
        return place + self.unit * shift[:, None], most

    def mapped(self, place: Tensor, blobs: Tensor, weight: Tensor, width: Tensor) -> Tensor:
        """Return `place [B, D, 2]` after one step of an affine map onto the blobs within about `width` px."""
        near = torch.exp(-square_distance(place, blobs) / (2 * width**2)) * weight
        near = near / (near.sum(-1, keepdim=True) + NONE)
        near = near / near.sum(1, keepdim=True).clamp_min(1)  # a blob is one dot's
        total = near.sum(-1, keepdim=True)
        away = near @ blobs - total * place
        one = torch.cat([place / self.unit, torch.ones_like(total)], -1)
        normal = (total * one).mT @ one + self.ridge * total.sum(1, keepdim=True).clamp_min(1)
        return place + one @ solve_dense(normal, one.mT @ away)
