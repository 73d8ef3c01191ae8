"""The appearance of a rendered image: illumination of a white membrane, vignetting, blur and noise."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from ..camera.model import Camera
from ..errors import MembraneError, check_arguments
from ..surface.membrane import Membrane
from ..torch_modes import on_cpu

LIGHTS, LIGHT_RADIUS = 4, 0.3  # default lights around the camera's centre, radius over the rim's mean distance from the axis
LIGHT_WITHIN = 0.5  # largest distance of the lights from the camera, over the membrane's smallest distance from it
BRIGHT = 0.95  # quantile of the rest surface's brightness that equals `exposure`
RANGES = {
    "exposure": (0, math.inf),
    "ambient": (0, 1),
    "highlight": (0, 1),
    "shininess": (0, math.inf),
    "vignetting": (0, 1),
    "blur": (0, 20),
    "outside": (0, 1),
    "noise": (0, 200),
}


@check_arguments
@dataclass(frozen=True)
class Appearance:
    """Lighting, lens and image sensor of rendered images.

    Args:
        lights: positions `(x, y, z)` of point lights, length unit, camera frame; default: four around the camera, inside the
            membrane.
        exposure: grey value of a bright part of the white membrane at rest (95 % of the membrane is darker).
        ambient: share of the light that is ambient.
        highlight: ratio of specular to diffuse light (Blinn-Phong), 0 for a matt membrane.
        shininess: exponent of the highlights.
        vignetting: loss of light in the image's corners, in `1 - vignetting (r / r_corner)^2`.
        blur: standard deviation of the defocus, px.
        outside: grey value outside the membrane.
        noise: ratio of white to the noise's standard deviation, dB; None: no noise.

    Raises:
        MembraneError: a value is outside its range.

    Example:
        >>> Appearance(noise=40.0).vignetting
        0.2
    """

    lights: Sequence[Sequence[float]] | None = None
    exposure: float = 0.75
    ambient: float = 0.5
    highlight: float = 0.0
    shininess: float = 40.0
    vignetting: float = 0.2
    blur: float = 0.6
    outside: float = 0.02
    noise: float | None = None

    def __post_init__(self) -> None:
        for name, (low, high) in RANGES.items():
            value = getattr(self, name)
            if value is not None and not low <= value <= high:
                raise MembraneError(f"Appearance: {name} = {value}; expected a number from {low} to {high}")

    @on_cpu
    def lights_for(self, membrane: Membrane) -> Tensor:
        """Return the positions `[L, 3]` of the lights in a sensor with this membrane."""
        if self.lights is not None:
            return torch.from_numpy(np.array(self.lights, dtype=float).reshape(-1, 3))
        rest = membrane.rest
        radius = LIGHT_RADIUS * float(rest[membrane.fixed, :2].norm(dim=-1).mean())
        radius = min(radius, LIGHT_WITHIN * float(rest.norm(dim=-1).min()))
        angle = 2 * math.pi * (torch.arange(LIGHTS, dtype=torch.float64) + 0.5) / LIGHTS
        return torch.stack([radius * angle.cos(), radius * angle.sin(), 0 * angle], -1)


DEFAULT_APPEARANCE = Appearance()


def diffuse_light(x: Tensor, inward: Tensor, lights: Tensor) -> Tensor:
    """Return the diffuse light by Lambert's law, `sum_l max(0, n . l) / |x - x_l|^2`.

    Args:
        x: points of the surface, `[..., V, 3]`.
        inward: unit normals there, towards the camera, `[..., V, 3]`.
        lights: positions of the lights, `[L, 3]`.

    Returns:
        The light at the points, `[..., V]`.

    Example:
        >>> diffuse_light(torch.tensor([[0.0, 0, 2]]), torch.tensor([[0.0, 0, -1]]), torch.zeros(1, 3))
        tensor([0.2500])
    """
    ray = lights - x[..., None, :]
    square = (ray * ray).sum(-1)
    return ((ray * inward[..., None, :]).sum(-1).clamp_min(0) / square**1.5).sum(-1)


def specular_light(x: Tensor, inward: Tensor, lights: Tensor, shininess: float) -> Tensor:
    """Return the Blinn-Phong highlights, `sum_l max(0, n . h)^shininess / |x - x_l|^2`, with h halfway from light to camera.

    Args:
        x: points of the surface, `[..., V, 3]`.
        inward: unit normals there, towards the camera, `[..., V, 3]`.
        lights: positions of the lights, `[L, 3]`.
        shininess: exponent of the highlights.

    Returns:
        The light at the points, `[..., V]`.
    """
    ray = lights - x[..., None, :]
    square = (ray * ray).sum(-1)
    half = F.normalize(F.normalize(ray, dim=-1) - F.normalize(x, dim=-1)[..., None, :], dim=-1)
    return ((half * inward[..., None, :]).sum(-1).clamp_min(0) ** shininess / square).sum(-1)


def vignette(pixels: Tensor, camera: Camera, vignetting: float) -> Tensor:
    """Return `1 - vignetting (r / r_corner)^2`, at least 0, at pixels `[..., 2]`; r is measured from the principal point."""
    size = pixels.new_tensor(camera.image_size)
    centre: Tensor = camera.centre.to(pixels)
    corner = torch.maximum(centre + 0.5, size - 0.5 - centre).square().sum()
    return (1 - vignetting * (pixels - centre).square().sum(-1) / corner).clamp_min(0)


def blurred(images: Tensor, sigma: float) -> Tensor:
    """Blur images `[..., H, W]` by a Gaussian of standard deviation `sigma` px, cut off at 4 sigma; edges are repeated.

    Example:
        >>> bool(torch.allclose(blurred(torch.ones(1, 5, 5), 0.6), torch.ones(1, 5, 5)))
        True
    """
    if sigma == 0:
        return images
    reach = max(1, math.ceil(4 * sigma))
    offset = torch.arange(-reach, reach + 1, dtype=images.dtype, device=images.device)
    weights = (-0.5 * (offset / sigma) ** 2).exp()
    weights = weights / weights.sum()
    flat = F.pad(images.reshape(-1, 1, *images.shape[-2:]), (reach, reach, reach, reach), mode="replicate")
    flat = F.conv2d(F.conv2d(flat, weights.view(1, 1, 1, -1)), weights.view(1, 1, -1, 1))
    return flat.view(images.shape)


def noisy(images: Tensor, decibel: float | None, rng: np.random.Generator) -> Tensor:
    """Add Gaussian noise with a standard deviation `decibel` below white to images, within 0..1; `None` adds none.

    Example:
        >>> image = noisy(torch.full((100, 100), 0.5), 40.0, np.random.default_rng(0))
        >>> round(float(image.std()), 3)
        0.01
    """
    if decibel is None:
        return images
    grain = torch.from_numpy(rng.standard_normal(tuple(images.shape), dtype=np.float32)).to(images)
    return (images + 10 ** (-decibel / 20) * grain).clamp(0, 1)
