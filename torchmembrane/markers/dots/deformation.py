"""Deformation at every blob of a frame, from the arrangement of the blobs around it alone."""

import numpy as np
import torch
from torch import Tensor, nn

from ...control_flow import fori_loop, traced
from ..spacing import FADED, neighbours, spacing, square_distance
from .scales import CANDIDATES, FAR, NEIGHBOURS, NONE, RIDGE

WIDTH = 0.2  # pitches, distance of a neighbour's blob from its position under a deformation
AVERAGE = 0.8  # pitches, radius of the averages of deformations
FITS = 6  # number of fits of a deformation to the surrounding blobs


def monomial_map() -> Tensor:
    """Return the linear map from the entries of a matrix to its action on monomials.

    Returns:
        `[8, 24]`: for `A = [[a, b], [c, d]]`, the map from `a b c d a^2+c^2 ab+cd b^2+d^2 1` to the matrix `[4, 6]` that maps
        the monomials `u v uu uv vv 1` of `x` to `A x`, `|A x|^2` and 1.
    """
    matrix = np.zeros((8, 4, 6))
    matrix[np.arange(8), [0, 0, 1, 1, 2, 2, 2, 3], [0, 1, 0, 1, 2, 3, 4, 5]] = [1, 1, 1, 1, 1, 2, 1, 1]
    return torch.as_tensor(matrix.reshape(8, 24))


class LocalDeformation(nn.Module):
    """Measures the deformation gradient at every blob of a frame from the arrangement of the blobs around it alone.

    The neighbours of the rest dot at that place are mapped by `A` and matched to the nearest blobs, then `A` is fitted, a fixed
    number of times; between the fits it is averaged over nearby blobs. It need not be known which blob is which dot. Blobs are
    the last axis throughout.

    Args:
        pixels: centres of the dots at rest, `[D, 2]`, px.
    """

    pixels: Tensor
    around: Tensor
    pitch: Tensor
    monomial_map: Tensor
    ridge: Tensor
    identity: Tensor

    def __init__(self, pixels: np.ndarray):
        super().__init__()
        pitch = spacing(pixels)[1]
        around = (pixels[neighbours(pixels, NEIGHBOURS)] - pixels[:, None]) / pitch[:, None, None]
        self.register_buffer("pixels", torch.as_tensor(pixels))
        u, v = np.moveaxis(around, -1, 0)
        self.register_buffer("around", torch.as_tensor(np.stack([u, v, u * u, u * v, v * v, np.ones_like(u)], 1)))
        self.register_buffer("pitch", torch.as_tensor(pitch))
        self.register_buffer("monomial_map", monomial_map())
        self.register_buffer("ridge", torch.tensor([[RIDGE], [0.0], [RIDGE], [0.0]], dtype=torch.float64))
        self.register_buffer("identity", torch.tensor([[1e-6], [0.0], [0.0], [1e-6], [1e-6]], dtype=torch.float64))

    def forward(self, blobs: Tensor, valid: Tensor) -> Tensor:
        """Return the gradient `[B, 2, 2, K]` for `blobs [B, K, 2]` with `valid [B, K]` in 0..1."""
        first, *scene = self.begin(blobs, valid)
        gradient: Tensor
        (gradient,) = fori_loop(self.refine, FITS, (first,), *scene, valid)
        return gradient

    @traced
    def begin(self, blobs: Tensor, valid: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
        """Prepare the fits of a frame.

        Returns:
            A first gradient `[B, 2, 2, K]`; monomials of the surrounding dots `[B, K, 6, M]`; for the neighbouring blobs, in
            pitches, the terms of their squared distance `[B, K, 4, C]`, and their positions and validity `[B, K, 3, C]`; the
            weights of all blobs (columns) for the averages of the others `[B, K, K]`.
        """
        middle = self.pixels.mean(0)
        own = square_distance(blobs - middle, self.pixels - middle).argmin(-1)
        around, pitch = self.around[own], self.pitch[own]
        apart = square_distance(blobs - middle, blobs - middle)
        index = (apart + FAR * (1 - valid[:, None])).topk(min(1 + CANDIDATES, blobs.shape[1]), largest=False).indices[..., 1:]
        known = torch.cat([blobs.mT, valid[:, None]], 1).gather(2, index.flatten(1)[:, None].expand(-1, 3, -1))
        position, there = known.unflatten(2, index.shape[1:]).split([2, 1], 1)
        others = (position - blobs.mT[..., None]) / pitch[:, None, :, None]  # [B, 2, K, C]
        square = others.square().sum(1, keepdim=True)
        away = torch.cat([-2 * others, torch.ones_like(square), square], 1)
        beside = torch.cat([others * there, there], 1)
        nearby = torch.exp((apart / (-2 * (AVERAGE * pitch[:, None]) ** 2)).clamp_min(-FADED)) * valid[..., None]
        eye = torch.eye(2, dtype=blobs.dtype, device=blobs.device)[..., None]
        ratio = square[:, 0, :, :4].clamp_min(1e-12).sqrt().mean(-1).clamp(0.5, 2.0)
        return ratio[:, None, None] * eye, around, away.transpose(1, 2), beside.transpose(1, 2), nearby

    @traced
    def refine(
        self, gradient: Tensor, around: Tensor, away: Tensor, beside: Tensor, nearby: Tensor, valid: Tensor
    ) -> tuple[Tensor]:
        """Return the gradient after another fit to blobs within about `WIDTH` pitches; the other arguments are from `begin`."""
        a, b, c, d = gradient.flatten(1, 2).unbind(1)
        entries = torch.stack([a, b, c, d, a * a + c * c, a * b + c * d, b * b + d * d, torch.ones_like(a)], -1)
        mapped = (entries * (-0.5 / WIDTH**2) @ self.monomial_map).unflatten(-1, (4, 6)) @ around
        target = beside @ torch.exp((away.mT @ mapped).clamp_min(-FADED))
        target = target / (target[:, :, 2:] + NONE)  # weight times position, weight: [B, K, 3, M]
        sums = (target @ around.mT).flatten(-2).mT.unflatten(1, (3, 6))
        load = sums[:, :2, :2] + RIDGE * gradient
        uu, uv, vv, weight = (sums[:, 2, 2:] + self.ridge).unbind(1)
        fitted = load * torch.stack([vv, uu], 1)[:, None] - load.flip(2) * uv[:, None, None]
        quality = valid * (weight / around.shape[-1]).square()
        scaled = fitted.flatten(1, 2) * (quality / (uu * vv - uv * uv))[:, None]
        average = torch.cat([scaled, quality[:, None]], 1) @ nearby + self.identity
        return ((average[:, :4] / average[:, 4:]).unflatten(1, (2, 2)),)
