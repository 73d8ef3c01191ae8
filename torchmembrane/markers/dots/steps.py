"""Steps from every dot to its neighbours: whether they are what the deformation measured makes of those at rest."""

import numpy as np
import torch
from torch import Tensor, nn

from ..spacing import neighbours, safe_length

NEIGHBOURS = 6
STRAY = 0.07  # share of the neighbours lost, times the relative error of the steps to the others


class NeighbourSteps(nn.Module):
    """The steps of a pattern. Dots are the last axis throughout.

    Args:
        pixels: centres `[D, 2]` of the dots at rest, px.
    """

    near: Tensor
    step: Tensor
    half_step: Tensor
    length: Tensor

    def __init__(self, pixels: np.ndarray):
        super().__init__()
        near = neighbours(pixels, NEIGHBOURS).T.copy()
        step = np.moveaxis(pixels[near] - pixels, -1, 0).copy()
        self.register_buffer("near", torch.as_tensor(near))
        self.register_buffer("step", torch.as_tensor(step))
        self.register_buffer("half_step", torch.as_tensor(step / 2))
        self.register_buffer("length", torch.as_tensor(np.linalg.norm(step, axis=0)))

    def forward(self, pixels: Tensor, sure: Tensor, gradient: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """How wrong the steps are.

        Args:
            pixels: of the dots `[B, 2, D]`, px.
            sure: how sure they are `[B, D]`, in 0..1.
            gradient: of the flow `[B, 2, 2, D]`.

        Returns:
            The sum of the relative errors of the steps to sure neighbours, the sure neighbours, and the share of the neighbours
            that is lost, `[B, D]` each.
        """
        here = torch.cat([gradient.flatten(1, 2), pixels, sure[:, None]], 1)
        there = here.index_select(2, self.near.flatten()).unflatten(-1, self.near.shape)  # [B, 7, neighbours, D]
        here = here[:, :, None]
        ends = (there[:, :4] + here[:, :4]).unflatten(1, (2, 2))
        change = there[:, 4:6] - here[:, 4:6] - self.step - (ends * self.half_step).sum(2)
        pair = there[:, 6] * here[:, 6]
        return (pair * safe_length(change, 1) / self.length).sum(1), pair.sum(1), 1 - there[:, 6].mean(1)


def trust(error: Tensor, pairs: Tensor, lost: Tensor) -> Tensor:
    """1, or towards 0 for a dot on another's blob: that one is lost beside it, and the steps to the others are wrong; `[B, D]`,
    of what `NeighbourSteps` gives."""
    return torch.sigmoid(8 * (1 - lost * error / (pairs + 1e-3) / STRAY))
