"""Soft-argmax of a response in windows about where markers are predicted."""

from typing import NamedTuple

import torch
from kornia.geometry.subpix import spatial_expectation2d, spatial_softmax2d
from torch import Tensor


class Peak(NamedTuple):
    """What a soft-argmax finds in windows.

    Attributes:
        place: of the peak `[B, D, 2]`, px.
        strength: the response there `[B, D]`, averaged with the weights of the soft-argmax.
        spread: standard deviation of the place `[B, D]` over those weights, px: wide where there are several peaks.
    """

    place: Tensor
    strength: Tensor
    spread: Tensor


def window_peak(
    score: Tensor, value: Tensor, middle: Tensor, stride: Tensor, predicted: Tensor, reach: Tensor, temperature: float
) -> Peak:
    """The expected place of a marker in its window.

    `E[x]` under the weights `exp(score / temperature - |x - predicted|^2 / 2 reach^2)`.

    Args:
        score: `[B, D, n, n]`, what the soft-argmax is of.
        value: `[B, D, n, n]`, what `strength` is of.
        middle: of the windows `[B, D, 2]`, px.
        stride: between their pixels `[D]`, px.
        predicted: `[B, D, 2]`, px.
        reach: standard deviation of the predictions `[D]`, px.
        temperature: of the softmax, in units of the score.

    Example:
        >>> step = torch.arange(-4.0, 5.0)
        >>> score = -(step - 1.5).square()[None, :] - (step + 0.5).square()[:, None]  # a peak at (1.5, -0.5) of the window
        >>> zero, one = torch.zeros(1, 1, 2), torch.ones(1)
        >>> peak = window_peak(score[None, None], score[None, None], zero + 20, one, zero + 20, 100 * one, 2.0)
        >>> peak.place.round(decimals=2).tolist(), round(float(peak.spread), 2)
        ([[[21.5, 19.5]]], 1.41)
    """
    half = score.shape[-1] // 2
    step = torch.arange(-half, half + 1, dtype=score.dtype, device=score.device)
    away = (middle - predicted)[..., None] + stride[:, None, None] * step  # [B, D, 2, n]
    far_u, far_v = (0.5 * (away / reach[:, None, None]).square()).unbind(2)
    weight = spatial_softmax2d(score - temperature * (far_u[..., None, :] + far_v[..., :, None]), temperature)
    at = spatial_expectation2d(weight, normalized_coordinates=False) - half
    square = (weight.sum(2) @ step.square()) + (weight.sum(3) @ step.square())
    variance = (square - at.square().sum(-1)).clamp_min(1e-6)
    return Peak(middle + stride[:, None] * at, (weight * value).sum((-2, -1)), stride * variance.sqrt())
