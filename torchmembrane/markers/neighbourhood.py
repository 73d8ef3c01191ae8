"""The flow at every marker as its neighbours have it: a robust local affine fit."""

from typing import NamedTuple

import numpy as np
import torch
from scipy.spatial import cKDTree
from torch import Tensor, nn
from torch.nn import functional as F

NEIGHBOURS = 16
ROBUST_STEPS = 4
RIDGE = 0.05  # share of the neighbours' spread that damps the affine part of a fit


class LocalFlow(NamedTuple):
    """What the neighbours of each patch say about its flow, px."""

    flow: Tensor  # [B, D, 2]
    gradient: Tensor  # [B, D, 2, 2], d flow / d rest pixel
    scale: Tensor  # [B, D], distance up to which a flow is credible
    support: Tensor  # [B, D], share of the neighbours that agree, 0..1

    def trust(self, flow: Tensor) -> Tensor:
        """Confidence [B, D] in 0..1 that flow [B, D, 2] belongs with its neighbours'."""
        distance = ((flow - self.flow).square().sum(-1) + 1e-12).sqrt()
        return (2.5 - distance / self.scale).clamp(0, 1) * (self.support > 0.25)


class Neighbourhood(nn.Module):
    """Predict the flow at every patch from its neighbours, itself left out, by a robust local affine fit."""

    def __init__(self, pixels: np.ndarray, anchors: np.ndarray):
        super().__init__()
        nodes = np.concatenate([pixels, anchors])
        _, index = cKDTree(nodes).query(pixels, k=min(NEIGHBOURS + 1, len(nodes)))
        offset = nodes[index[:, 1:]] - pixels[:, None]
        squared = (offset**2).sum(-1)
        near = np.exp(-squared / (2 * np.median(squared, 1, keepdims=True)))
        self.anchors = len(anchors)
        self.register_buffer("index", torch.as_tensor(index[:, 1:], dtype=torch.int64))
        self.register_buffer("offset", torch.as_tensor(offset))
        self.register_buffer("near", torch.as_tensor(near))

    def forward(self, flow: Tensor, weight: Tensor, tolerance: float) -> LocalFlow:
        """Fit to flow [B, D, 2] with weight [B, D] in 0..1; `tolerance`, px, is what noise may explain."""
        u = F.pad(flow, (0, 0, 0, self.anchors))[:, self.index]
        prior = F.pad(weight, (0, self.anchors), value=1.0)[:, self.index]
        fit = weighted_median(u, prior), flow.new_zeros(*flow.shape, 2)
        for _ in range(ROBUST_STEPS):
            squared, scale = self.misfit(fit, u, prior, tolerance)
            fit = affine_fit(self.offset, u, prior * self.near / (1 + squared / scale.square()).square())
        squared, scale = self.misfit(fit, u, prior, tolerance)
        return LocalFlow(*fit, scale[..., 0], (prior * (squared < 4 * scale.square())).mean(-1))

    def misfit(self, fit: tuple[Tensor, Tensor], u: Tensor, prior: Tensor, tolerance: float) -> tuple[Tensor, Tensor]:
        """Squared residuals [B, D, k] of the neighbours, and the scale [B, D, 1] up to which they are credible."""
        linear = torch.einsum("bdij,dkj->bdki", fit[1], self.offset)
        squared = (u - fit[0][:, :, None] - linear).square().sum(-1)
        median = weighted_median(squared[..., None], prior).sqrt()
        return squared, tolerance + 1.5 * median.clamp(max=3 * tolerance)


def affine_fit(x: Tensor, u: Tensor, weight: Tensor) -> tuple[Tensor, Tensor]:
    """Weighted affine fit u ~ flow + gradient x: its value [..., D, 2] at x = 0 and gradient [..., D, 2, 2]."""
    total = weight.sum(-1, keepdim=True) + 1e-12
    w = (weight / total)[..., None]
    x_mean, u_mean = (w * x).sum(-2), (w * u).sum(-2)
    dx, du = x - x_mean[..., None, :], u - u_mean[..., None, :]
    xx, ux = (w * dx).mT @ dx, (w * du).mT @ dx
    damping = RIDGE * x.square().sum(-1).mean(-1)[..., None, None] * torch.eye(2, dtype=x.dtype, device=x.device)
    gradient = ux @ inverse_2x2(xx + damping)
    return u_mean - (gradient @ x_mean[..., None])[..., 0], gradient


def inverse_2x2(matrix: Tensor) -> Tensor:
    """Inverse of [..., 2, 2] matrices in closed form."""
    (a, b), (c, d) = (row.unbind(-1) for row in matrix.unbind(-2))
    adjugate = torch.stack([torch.stack([d, -b], -1), torch.stack([-c, a], -1)], -2)
    return adjugate / (a * d - b * c)[..., None, None]


def weighted_median(values: Tensor, weight: Tensor) -> Tensor:
    """Median over k of values [..., k, C] with weight [..., k]; the smallest value where all weights vanish."""
    ordered, order = values.sort(dim=-2)
    below = weight[..., None].expand_as(values).gather(-2, order).cumsum(-2)
    place = (below < below[..., -1:, :] / 2).sum(-2, keepdim=True)
    return ordered.gather(-2, place)[..., 0, :]
