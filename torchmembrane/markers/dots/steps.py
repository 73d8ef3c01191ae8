"""Comparison of the steps from every dot to its neighbours with the steps at rest under the measured deformation."""

import numpy as np
import torch
from torch import Tensor, nn

from ..spacing import neighbours, safe_length

NEIGHBOURS = 6  # number of nearest neighbours, to which the steps from a dot are compared with those at rest


class NeighbourSteps(nn.Module):
    """The steps of a pattern. Dots are the last axis throughout.

    Args:
        pixels: centres of the dots at rest, `[D, 2]`, px.
        seen: which of them are in the image at rest, `[D]` bool; only these can be lost.
    """

    near: Tensor
    step: Tensor
    half_step: Tensor
    length: Tensor
    seen: Tensor

    def __init__(self, pixels: np.ndarray, seen: np.ndarray):
        super().__init__()
        near = neighbours(pixels, NEIGHBOURS).T.copy()
        step = np.moveaxis(pixels[near] - pixels, -1, 0).copy()
        self.register_buffer("near", torch.as_tensor(near))
        self.register_buffer("step", torch.as_tensor(step))
        self.register_buffer("half_step", torch.as_tensor(step / 2))
        self.register_buffer("seen", torch.as_tensor(seen[near] / seen[near].sum(0).clip(1)))
        self.register_buffer("length", torch.as_tensor(np.linalg.norm(step, axis=0)))

    def forward(self, pixels: Tensor, sure: Tensor, gradient: Tensor) -> tuple[Tensor, Tensor]:
        """Return the share of found neighbours, and the error of the steps to them.

        Args:
            pixels: positions of the dots, `[B, 2, D]`, px.
            sure: certainty of the dots, `[B, D]`, in 0..1.
            gradient: gradient of the flow, `[B, 2, 2, D]`.

        Returns:
            The share of the neighbours visible at rest that is certain, and the mean relative error of the steps between
            certain dots, `[B, D]` each.
        """
        here = torch.cat([gradient.flatten(1, 2), pixels, sure[:, None]], 1)
        there = here.index_select(2, self.near.flatten()).unflatten(-1, self.near.shape)  # [B, 7, neighbours, D]
        here = here[:, :, None]
        ends = (there[:, :4] + here[:, :4]).unflatten(1, (2, 2))
        change = there[:, 4:6] - here[:, 4:6] - self.step - (ends * self.half_step).sum(2)
        pair = there[:, 6] * here[:, 6]
        error = (pair * safe_length(change, 1) / self.length).sum(1) / pair.sum(1).clamp_min(1e-3)
        return (there[:, 6] * self.seen).sum(1), error
