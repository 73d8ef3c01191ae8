"""The flow at every dot as the dots around it have it."""

import numpy as np
import torch
from torch import Tensor, nn

from ..spacing import spacing

RIDGE = 0.5  # draws the flow's gradient to the one measured, where neighbours do not fix it
SUPPORT = 0.8  # sure nodes, weighted by distance, that a prediction needs
MINORS = (  # adjugate [9] of a symmetric matrix from its entries 00 01 02 11 12 22: products a b - c d
    (3, 4, 1, 4, 0, 1, 1, 1, 0),
    (5, 2, 4, 2, 5, 2, 4, 2, 3),
    (4, 1, 3, 1, 2, 0, 3, 0, 1),
    (4, 5, 2, 5, 2, 4, 2, 4, 1),
)


class FlowAverages(nn.Module):
    """Moving averages of the flow around every dot, over its neighbours, itself left out.

    Weights `w_n exp(-|x_n - x_d|^2 / 2 h_d^2)`, `h_d` the local pitch times `width`. The last nodes, the anchors, have no
    flow and weight 1. Dots are the last axis throughout: weight `[B, D]`, flow `[B, 2, D]`, gradient `[B, 2, 2, D]`.

    Args:
        pixels: centres `[D, 2]` of the dots at rest, px.
        nodes: `[N, 2]`, the dots and after them the anchors, px.
        width: of the average, pitches.
    """

    moments: Tensor
    first_moments: Tensor
    still: Tensor
    raised: Tensor
    minors: Tensor
    h: Tensor

    def __init__(self, pixels: np.ndarray, nodes: np.ndarray, width: float):
        super().__init__()
        count, h = len(pixels), width * spacing(pixels)[1]
        y = (nodes[:, None] - pixels) / h[None, :, None]  # [N, D, 2]
        self.kernel = np.exp(-0.5 * (y**2).sum(-1))
        self.kernel[np.arange(count), np.arange(count)] = 0
        u, v = y[..., 0], y[..., 1]
        moments = self.kernel * np.stack([np.ones_like(u), u, v, u * u, u * v, v * v])  # [6, N, D]
        moments_of_dots = np.moveaxis(moments[:, :count], 0, 1)
        self.register_buffer("moments", torch.as_tensor(moments_of_dots.reshape(count, -1).copy()))
        self.register_buffer("first_moments", torch.as_tensor(moments_of_dots[:, :3].reshape(count, -1).copy()))
        self.register_buffer("still", torch.as_tensor(moments[:, count:].sum(1)))
        self.register_buffer("raised", self.still + torch.tensor([1e-3, 0, 0, RIDGE, 0, RIDGE])[:, None])
        self.register_buffer("minors", torch.tensor(MINORS))
        self.register_buffer("h", torch.as_tensor(h))

    def rings(self, weight: np.ndarray) -> int:
        """How many steps it takes the growth from the nodes `weight [S, N]` to reach every dot it can reach."""
        count, reached, steps = self.kernel.shape[1], weight, 0
        while True:
            grown = np.maximum(reached[:, :count], reached @ self.kernel * 0.7 > SUPPORT)
            if (grown == reached[:, :count]).all():
                return steps
            reached, steps = np.column_stack([grown, reached[:, count:]]), steps + 1

    def gradient(self, weight: Tensor, flow: Tensor, prior: Tensor) -> Tensor:
        """Gradient `[B, 2, 2, D]` of the least-squares affine flow, drawn to `prior` where neighbours do not fix it."""
        weight = weight[:, None]
        rows = torch.cat([weight, weight * flow], 1)
        sums = (rows @ self.moments).unflatten(-1, (6, -1))  # [B, 3, 6, D]
        load = torch.cat([sums[:, 1:, :1], sums[:, 1:, 1:3] + RIDGE * self.h * prior], 2)
        normal = sums[:, 0] + self.raised  # of the symmetric 3 x 3 matrix: 00 01 02 11 12 22
        a, b, c, d = (normal.index_select(1, entries) for entries in self.minors)
        adjugate = (a * b - c * d).unflatten(1, (3, 3))
        determinant = (normal[:, :3] * adjugate[:, 0]).sum(1) * self.h
        return (load[:, :, None] * adjugate[:, None, 1:]).sum(3) / determinant[:, None, None]

    def along(self, weight: Tensor, flow: Tensor, gradient: Tensor) -> tuple[Tensor, Tensor]:
        """The flow predicted from the neighbours' flow and gradient.

        `f_d = mean_n f_n + (J_n + J_d) / 2 (x_d - x_n)` where the gradient is known at the dots; anchors take the gradient
        of the dot.

        Returns:
            Flow `[B, 2, D]` and support `[B, D]`: the sure nodes around, weighted by distance.
        """
        weight = weight[:, None]
        rows = torch.cat([weight, weight * torch.cat([flow, gradient.flatten(1, 2) / 2], 1)], 1)
        sums = (rows @ self.first_moments).unflatten(-1, (3, -1))  # [B, 7, 3, D]
        support = sums[:, 0, 0] + self.still[0]
        own = sums[:, 0, 1:] / 2 + self.still[1:3]
        theirs = sums[:, 3::2, 1] + sums[:, 4::2, 2]
        mine = (gradient * own[:, None]).sum(2)
        return (sums[:, 1:3, 0] - self.h * (theirs + mine)) / (support + 1e-3)[:, None], support
