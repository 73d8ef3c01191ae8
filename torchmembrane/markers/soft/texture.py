"""Soft location of texture: normalised correlation with patches of the rest image and soft-argmax, coarse to fine."""

import numpy as np
import torch
from torch import Tensor, nn

from ...control_flow import traced
from ..locator import LocatedMarkers
from ..texture.locator import PatchLocator
from ..texture.pyramid import low_pass_pyramid, sample
from ..texture.template import PATCH_RADII, Template, normalised_correlation, square_offsets
from .argmax import Peak, window_peak

TEMPERATURE = 0.025  # of the softmax, of correlation
STAGES = ((2, 7, 1.0), (2, 3, 1.0), (1, 3, 0.5), (0, 3, 0.3), (0, 2, 0.3))
"""Level of the pyramid, half side of the shifts tried in px of it, and tolerance of the neighbours' fit in px."""
BELIEVED_CORRELATION = (0.5, 0.3)  # correlation from which a patch is believed, and over which it comes to be wholly so


class PatchCorrelation(nn.Module):
    """Normalised correlation of one image level with patches of the rest image, over all integer shifts up to `reach`.

    Args:
        rest: level of the rest image, `[1, 1, H, W]`.
        centre: centres of the patches, `[D, 2]`, px of the level.
        radius: half side of a patch, px of the level.
        reach: largest shift, px of the level.
    """

    centre: Tensor
    offset: Tensor
    unit: Tensor
    weight: Tensor
    stride: Tensor
    error: Tensor

    def __init__(self, rest: Tensor, centre: Tensor, radius: int, reach: int):
        super().__init__()
        template, side = Template(rest, centre, radius), 2 * radius + 1
        self.register_buffer("centre", centre.clone())
        self.register_buffer("offset", square_offsets(radius + reach))
        self.register_buffer("unit", template.unit.reshape(-1, 1, side, side).clone())
        self.register_buffer("weight", template.weight.reshape(1, 1, side, side).clone())
        self.register_buffer("stride", torch.ones(len(centre), dtype=torch.float64))
        self.register_buffer("error", torch.full((len(centre),), float(reach), dtype=torch.float64))

    def forward(self, image: Tensor, flow: Tensor, gradient: Tensor) -> tuple[Tensor, Peak]:
        """Search for the patches around their positions by `flow [B, D, 2]`, px of the level, warped by its
        `gradient [B, D, 2, 2]`.

        Returns:
            Flow `[B, D, 2]`, px of the level, and the peak of the correlation, its place relative to that of `flow`.
        """
        affine = gradient + torch.eye(2, dtype=flow.dtype, device=flow.device)
        window = sample(image, self.centre + flow, affine, self.offset)
        correlation = normalised_correlation(window, self.unit, self.weight)
        peak = window_peak(
            correlation, correlation, torch.zeros_like(flow), self.stride, torch.zeros_like(flow), self.error, TEMPERATURE
        )
        return flow + (affine @ peak.place[..., None])[..., 0], peak


class SoftTextureLocator(PatchLocator):
    """Finds patches of a rest image in other images of the deformed membrane, by soft-argmax of their normalised correlation.

    Args:
        rest_image: `[H, W]`, grey in 0..1.
        pixels: patch centres `[D, 2]`, px, from `choose_patches`.
        anchors: fixed pixels on the rim, `[A, 2]`, or None.

    Raises:
        MembraneError: the image is not `[H, W]`, or there are too few patches, or some lie outside the image.

    Limitations:
        Patches that moved by more than about 25 px are lost. Less exact than `TextureLocator`, whose last steps fit each
        patch's own affine map: here it is that of its neighbours' flow.

    Example:
        >>> from scipy.ndimage import gaussian_filter
        >>> from torchmembrane.markers.texture import choose_patches
        >>> rest = gaussian_filter(np.random.default_rng(0).random((80, 100)), 2)
        >>> rest = (rest - rest.min()) / np.ptp(rest)
        >>> locator = SoftTextureLocator(rest, choose_patches(rest, np.ones((80, 100), bool), 200))
        >>> pixels, confidence, _ = locator(torch.tensor(np.roll(rest, 3, 1)[None, None]).float())
        >>> (pixels - locator.rest_pixels)[0][:, 0].median().round(decimals=1).item(), bool(confidence.median() > 0.9)
        (3.0, True)
    """

    def __init__(self, rest_image: np.ndarray, pixels: np.ndarray, anchors: np.ndarray | None = None):
        super().__init__(rest_image, pixels, anchors)
        levels = self.rest_levels(rest_image)
        self.stages = nn.ModuleList(
            PatchCorrelation(levels[k], self.rest_pixels / 2**k, PATCH_RADII[k], reach) for k, reach, _ in STAGES
        )
        self.to(torch.float32)

    @traced
    def forward(self, image: Tensor, previous: Tensor | None = None) -> LocatedMarkers:
        """Locate the patches in a batch of frames.

        Args:
            image: `[B, 1, H, W]`, grey in 0..1, of the rest image's size.
            previous: ignored, because `follows` is false.

        Raises:
            MembraneError: the image has another size than the rest image.
        """
        self.check_size(image)
        finite = image.isfinite()
        images = low_pass_pyramid(torch.where(finite, image, 0.0))
        flow = torch.zeros_like(self.rest_pixels).expand(image.shape[0], -1, -1)
        gradient = torch.zeros_like(flow)[..., None].expand(-1, -1, -1, 2)
        for (k, _, tolerance), stage in zip(STAGES, self.stages, strict=True):
            found, peak = stage(images[k], flow / 2**k, gradient)
            found, weight = 2**k * found, ((peak.strength - BELIEVED_CORRELATION[0]) / BELIEVED_CORRELATION[1]).clamp(0, 1)
            flow, local = self.settle(found, weight, flow, tolerance)
            gradient = local.gradient
        confidence = weight * local.trust(found) * finite.flatten(1).all(1)[:, None]
        return self.located(found, confidence, local)
