"""Soft-argmax of a response in windows around the predicted markers."""

from typing import NamedTuple

import torch
from kornia.geometry.subpix import spatial_expectation2d, spatial_softmax2d
from torch import Tensor


class Peak(NamedTuple):
    """The result of a soft-argmax in windows.

    Attributes:
        place: position of the peak, `[B, D, 2]`, px.
        strength: mean response with the weights of the soft-argmax, `[B, D]`.
        spread: standard deviation of the position with these weights, `[B, D]`, px: large if there are several peaks.
    """

    place: Tensor
    strength: Tensor
    spread: Tensor


def window_peak(
    score: Tensor, value: Tensor, middle: Tensor, stride: Tensor, predicted: Tensor, reach: Tensor, temperature: float
) -> Peak:
    """Return the expected position of a marker in its window.

    `E[x]` under the weights `exp(score / temperature - |x - predicted|^2 / 2 reach^2)`.

    Args:
        score: score whose soft-argmax is computed, `[B, D, n, n]`.
        value: response that is averaged to `strength`, `[B, D, n, n]`.
        middle: centres of the windows, `[B, D, 2]`, px.
        stride: distance between their pixels, `[D]`, px.
        predicted: predicted positions, `[B, D, 2]`, px.
        reach: standard deviations of the predictions, `[D]`, px.
        temperature: temperature of the softmax, in units of the score.

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
