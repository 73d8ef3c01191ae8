"""The flow at every dot, predicted from the surrounding dots."""

import numpy as np
import torch
from torch import Tensor, nn

from ..native_frames import found_by, is_native
from ..spacing import faded, spacing
from .native_flow import flows, gradients
from .scales import RIDGE

SUPPORT = 0.5  # smallest number of confident nodes, weighted by distance, for a prediction


class FlowAverages(nn.Module):
    """Moving averages of the flow around every dot, over its neighbours without the dot itself.

    The weights are `w_n exp(-|x_n - x_d|^2 / 2 h_d^2)`, with the local pitch `h_d`. The last nodes, the anchors, have no flow
    and weight 1. Dots are the last axis throughout: weight `[B, D]`, flow `[B, 2, D]`, gradient `[B, 2, 2, D]`.

    Args:
        pixels: centres of the dots at rest, `[D, 2]`, px.
        nodes: the dots followed by the anchors, `[N, 2]`, px.
    """

    moments: Tensor
    first_moments: Tensor
    still: Tensor
    raised: Tensor
    pull: Tensor
    h: Tensor

    def __init__(self, pixels: np.ndarray, nodes: np.ndarray):
        super().__init__()
        count, h = len(pixels), spacing(pixels)[1]
        y = (nodes[:, None] - pixels) / h[None, :, None]  # [N, D, 2]
        self.kernel = faded(-0.5 * (y**2).sum(-1))
        self.kernel[np.arange(count), np.arange(count)] = 0
        u, v = y[..., 0], y[..., 1]
        moments = self.kernel * np.stack([np.ones_like(u), u, v, u * u, u * v, u * v, v * v])  # [7, N, D]
        moments_of_dots = np.moveaxis(moments[:, :count], 0, 1)
        self.register_buffer("moments", torch.as_tensor(moments_of_dots.reshape(count, -1).copy()))
        self.register_buffer("first_moments", torch.as_tensor(moments_of_dots[:, :3].reshape(count, -1).copy()))
        still = torch.as_tensor(moments[:, count:].sum(1))
        twice = torch.tensor([[1.0], [2.0], [2.0]], dtype=torch.float32)  # anchors take the dot's gradient
        ridge = torch.tensor([1e-3, 0, 0, RIDGE, 0, 0, RIDGE], dtype=torch.float32)
        self.register_buffer("still", still[:3] * twice)
        self.register_buffer("raised", still + ridge[:, None])
        self.register_buffer("pull", torch.as_tensor(RIDGE * h))
        self.register_buffer("h", torch.as_tensor(h))

    def gradient(self, weight: Tensor, flow: Tensor, prior: Tensor) -> Tensor:
        """Return the gradient `[B, 2, 2, D]` of the least-squares affine flow; it tends to `prior` where the neighbours do not
        determine it."""
        if is_native(weight, flow, prior, self.h):
            return found_by(gradients, self.constants(), (weight, flow, prior), 2, 2, len(self.h))
        weight = weight[:, None]
        rows = torch.cat([weight, weight * flow], 1)
        sums = (rows @ self.moments).unflatten(-1, (7, -1))  # [B, 3, 7, D]
        normal = sums[:, 0] + self.raised
        mean = normal[:, 1:3] / normal[:, :1]
        matrix = normal[:, 3:].unflatten(1, (2, 2)).addcmul(normal[:, 1:3, None], mean[:, None], value=-1)
        load = sums[:, 1:, 1:3].addcmul(self.pull, prior).addcmul(sums[:, 1:, :1], mean[:, None], value=-1)
        (uu, uv), (_, vv) = (row.unbind(1) for row in matrix.unbind(1))
        determinant = (uu * vv).addcmul(uv, uv, value=-1) * self.h
        solved = (load * torch.stack([vv, uu], 1)[:, None]).addcmul(load.flip(2), uv[:, None, None], value=-1)
        return solved / determinant[:, None, None]

    def along(self, weight: Tensor, flow: Tensor, gradient: Tensor) -> tuple[Tensor, Tensor]:
        """Predict the flow from the neighbours' flow and gradient.

        `f_d = mean_n f_n + (J_n + J_d) / 2 (x_d - x_n)` if the gradient is known at the dots; for anchors the gradient at the
        dot is used.

        Returns:
            Flow `[B, 2, D]` and support `[B, D]`: the sum of the confident nodes around, weighted by distance.
        """
        if is_native(weight, flow, gradient, self.h):
            found = found_by(flows, self.constants(), (weight, flow, gradient), 3, len(self.h))
            return found[:, :2], found[:, 2]
        weight = weight[:, None]
        rows = torch.cat([weight, weight * torch.cat([flow, gradient.flatten(1, 2)], 1)], 1)
        sums = (rows @ self.first_moments).unflatten(-1, (3, -1))  # [B, 7, 3, D]
        near = sums[:, 0] + self.still
        support = near[:, 0]
        theirs = sums[:, 3::2, 1] + sums[:, 4::2, 2]
        mine = (gradient * near[:, None, 1:]).sum(2)
        total = sums[:, 1:3, 0].addcmul(self.h, theirs + mine, value=-0.5)
        return total / (support + 1e-3)[:, None], support

    def constants(self) -> tuple[np.ndarray, ...]:
        """Return the buffers, as machine code takes them."""
        buffers = self.moments, self.first_moments, self.still, self.raised, self.pull, self.h
        return tuple(buffer.numpy() for buffer in buffers)
