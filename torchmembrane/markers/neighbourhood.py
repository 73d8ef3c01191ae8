"""Prediction of the flow at every marker from its neighbours by a robust local affine fit."""

from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional as F

from .spacing import neighbours

NEIGHBOURS = 16
ROBUST_STEPS = 4
RIDGE = 0.05  # damping of the affine part of a fit, over the neighbours' spread


class NeighbourFlow(NamedTuple):
    """The flow at every marker as predicted by its neighbours, px."""

    flow: Tensor  # [B, D, 2]
    gradient: Tensor  # [B, D, 2, 2], d flow / d rest pixel
    scale: Tensor  # [B, D], px, distance up to which a flow is credible
    support: Tensor  # [B, D], share of the neighbours that agree, 0..1

    def trust(self, flow: Tensor) -> Tensor:
        """Return the confidence `[B, D]`, 0..1, that a flow `[B, D, 2]`, px, agrees with the prediction."""
        distance = ((flow - self.flow).square().sum(-1) + 1e-12).sqrt()
        return (2.5 - distance / self.scale).clamp(0, 1) * (self.support > 0.25)


class Neighbourhood(nn.Module):
    """Predict the flow at every marker from its neighbours, without the marker itself, by a robust local affine fit.

    Iteratively reweighted least squares with weights `prior exp(-|offset|^2 / 2 h^2) / (1 + r^2 / s^2)^2` of the residuals `r`
    (Geman-McClure); their scale `s` combines the median residual of the neighbourhood and the tolerance for noise.

    Args:
        pixels: pixels of the markers at rest, `[D, 2]`.
        anchors: fixed pixels on the rim, `[A, 2]`.

    Limitations:
        The prediction is wrong where a third of the neighbours have wrong flows that agree with one another.

    Example:
        >>> pixels = np.stack(np.meshgrid(np.arange(5.0), np.arange(5.0)), -1).reshape(-1, 2)
        >>> flow = torch.full((1, 25, 2), 0.5)
        >>> flow[0, 12] = 3.0  # an outlier
        >>> local = Neighbourhood(pixels, np.zeros((0, 2))).float()(flow, torch.ones(1, 25), 0.1)
        >>> local.flow[0, 12].round(decimals=3).tolist(), local.trust(flow)[0, 11:14].tolist()
        ([0.5, 0.5], [1.0, 0.0, 1.0])
    """

    index: Tensor
    offset: Tensor
    near: Tensor

    def __init__(self, pixels: np.ndarray, anchors: np.ndarray):
        super().__init__()
        nodes = np.concatenate([pixels, anchors])
        index = neighbours(nodes, NEIGHBOURS)[: len(pixels)]
        offset = nodes[index] - pixels[:, None]
        squared = (offset**2).sum(-1)
        near = np.exp(-squared / (2 * np.median(squared, 1, keepdims=True)))
        self.anchors = len(anchors)
        self.register_buffer("index", torch.as_tensor(index, dtype=torch.int64))
        self.register_buffer("offset", torch.as_tensor(offset))
        self.register_buffer("near", torch.as_tensor(near))

    def forward(self, flow: Tensor, weight: Tensor, tolerance: float | Tensor) -> NeighbourFlow:
        """Predict the flow of each marker from its neighbours.

        Args:
            flow: `[B, D, 2]`, px.
            weight: `[B, D]` in 0..1.
            tolerance: residual that noise may explain, px; one number, or one for each marker `[D, 1]`.
        """
        u = F.pad(flow, (0, 0, 0, self.anchors))[:, self.index]
        prior = F.pad(weight, (0, self.anchors), value=1.0)[:, self.index]
        fit = weighted_median(u, prior), flow.new_zeros(*flow.shape, 2)
        for _ in range(ROBUST_STEPS):
            squared, scale = self.misfit(fit, u, prior, tolerance)
            fit = affine_fit(self.offset, u, prior * self.near / (1 + squared / scale.square()).square())
        squared, scale = self.misfit(fit, u, prior, tolerance)
        return NeighbourFlow(*fit, scale[..., 0], (prior * (squared < 4 * scale.square())).mean(-1))

    def misfit(self, fit: tuple[Tensor, Tensor], u: Tensor, prior: Tensor, tolerance: float | Tensor) -> tuple[Tensor, Tensor]:
        """Return the squared residuals `[B, D, k]` of the neighbours, and the scale `[B, D, 1]` up to which they are
        credible."""
        linear = torch.einsum("bdij,dkj->bdki", fit[1], self.offset)
        squared = (u - fit[0][:, :, None] - linear).square().sum(-1)
        median = (
            weighted_median(squared[..., None], prior).clamp_min(1e-12).sqrt()
        )  # all of a neighbourhood lost: no slope at 0
        return squared, tolerance + 1.5 * median.clamp(max=3 * tolerance)


def affine_fit(x: Tensor, u: Tensor, weight: Tensor) -> tuple[Tensor, Tensor]:
    """Fit `u ~ flow + gradient x` by weighted least squares.

    Args:
        x: offsets of the neighbours, `[..., D, k, 2]`.
        u: flow of the neighbours, `[..., D, k, 2]`.
        weight: weights of the neighbours, `[..., D, k]`.

    Returns:
        The value `[..., D, 2]` at x = 0 and the gradient `[..., D, 2, 2]`, the latter damped by `RIDGE`.
    """
    total = weight.sum(-1, keepdim=True) + 1e-12
    w = (weight / total)[..., None]
    x_mean, u_mean = (w * x).sum(-2), (w * u).sum(-2)
    dx, du = x - x_mean[..., None, :], u - u_mean[..., None, :]
    xx, ux = (w * dx).mT @ dx, (w * du).mT @ dx
    damping = RIDGE * x.square().sum(-1).mean(-1)[..., None, None] * torch.eye(2, dtype=x.dtype, device=x.device)
    gradient = ux @ inverse_2x2(xx + damping)
    return u_mean - (gradient @ x_mean[..., None])[..., 0], gradient


def inverse_2x2(matrix: Tensor) -> Tensor:
    """Invert `[..., 2, 2]` matrices in closed form.

    Example:
        >>> inverse_2x2(torch.tensor([[2.0, 1.0], [1.0, 1.0]])).tolist()
        [[1.0, -1.0], [-1.0, 2.0]]
    """
    (a, b), (c, d) = (row.unbind(-1) for row in matrix.unbind(-2))
    adjugate = torch.stack([torch.stack([d, -b], -1), torch.stack([-c, a], -1)], -2)
    return adjugate / (a * d - b * c)[..., None, None]


def weighted_median(values: Tensor, weight: Tensor) -> Tensor:
    """Return the median over `k` of `values [..., k, C]` with `weight [..., k]`; the smallest value if all weights are zero.

    Example:
        >>> weighted_median(torch.tensor([[1.0], [9.0], [5.0]]), torch.tensor([1.0, 0.1, 1.0])).tolist()
        [5.0]
    """
    ordered, order = values.sort(dim=-2)
    below = weight[..., None].expand_as(values).gather(-2, order).cumsum(-2)
    middle = (below < below[..., -1:, :] / 2).sum(-2, keepdim=True)
    return ordered.gather(-2, middle)[..., 0, :]
