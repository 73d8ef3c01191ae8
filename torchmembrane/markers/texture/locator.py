"""Texture as markers: patches of paint or speckle, followed from the rest image into images of the deformed membrane.

Coarse to fine on a pyramid of three levels. At the coarsest every template meets every shift up to `REACH` by
normalised correlation. The finer ones start from the flow so far, warp by its local affine map, and refine both by
inverse compositional Gauss-Newton steps (Baker & Matthews, IJCV 56, 2004) with the light's gain and offset projected
out beforehand: a step is one matrix product with constants. After every level a robust affine fit to its neighbours
judges each patch.
"""

import numpy as np
import torch
from torch import Tensor, nn

from ...control_flow import traced
from ...errors import MembraneError
from ..locator import LocatedMarkers, isotropic
from ..neighbourhood import NEIGHBOURS, NeighbourFlow, Neighbourhood
from .pyramid import LEVELS, low_pass_pyramid
from .template import PATCH_RADII, Search, Template

LOCATION_NOISE = 0.1  # px, of a patch in an image
LOST_WEIGHT = 1e-3  # of a lost patch's predicted flow in its neighbours' fits: it counts only where none of them is found


class PatchLocator(nn.Module):
    """Patches of a rest image: the common base of the texture locators.

    Args:
        rest_image: `[H, W]`, grey in 0..1.
        pixels: patch centres `[D, 2]`, px, from `choose_patches`.
        anchors: fixed pixels on the rim, `[A, 2]`, or None.

    Attributes:
        follows: False; patches are searched for from rest in every frame.

    Raises:
        MembraneError: the image is not `[H, W]`, or there are too few patches, or some lie outside the image.
    """

    follows = False
    rest_pixels: Tensor

    def __init__(self, rest_image: np.ndarray, pixels: np.ndarray, anchors: np.ndarray | None = None):
        super().__init__()
        name, rest_image, pixels = type(self).__name__, np.asarray(rest_image, float), np.asarray(pixels, float)
        anchors = np.zeros((0, 2)) if anchors is None else np.asarray(anchors, float)
        if rest_image.ndim != 2 or pixels.ndim != 2 or pixels.shape[1] != 2 or len(pixels) <= NEIGHBOURS:
            raise MembraneError(
                f"{name}: rest_image has shape {rest_image.shape} and pixels {pixels.shape}, expected [H, W] "
                f"and [D, 2] with D > {NEIGHBOURS}; give a grey image and the result of choose_patches"
            )
        if not ((pixels >= 0) & (pixels <= np.array(rest_image.shape)[::-1] - 1)).all():
            raise MembraneError(
                f"{name}: pixels from {pixels.min(0)} to {pixels.max(0)}, expected inside the rest image "
                f"of width and height {rest_image.shape[::-1]}; give (u right, v down) of this very image"
            )
        self.size = rest_image.shape
        self.register_buffer("rest_pixels", torch.as_tensor(pixels))
        self.neighbourhood = Neighbourhood(pixels, anchors)

    @staticmethod
    def rest_levels(rest_image: np.ndarray) -> list[Tensor]:
        """Return the pyramid of the rest image `[H, W]`, each level `[1, 1, H, W]` in double precision."""
        return low_pass_pyramid(torch.as_tensor(np.asarray(rest_image, float))[None, None])

    def be_exact(self) -> None:
        """Do nothing: this locator has only one precision."""

    def check_size(self, image: Tensor) -> None:
        """Refuse an image that is not `[B, 1, H, W]` of the rest image's size."""
        height, width = self.size
        if image.ndim != 4 or tuple(image.shape[1:]) != (1, height, width):
            raise MembraneError(
                f"{type(self).__name__}: image has shape {tuple(image.shape)}, expected [B, 1, {height}, {width}] "
                "like the rest image; give grey images from the same camera, not resized"
            )

    def settle(self, found: Tensor, weight: Tensor, before: Tensor, tolerance: float) -> tuple[Tensor, NeighbourFlow]:
        """Return the flow `[B, D, 2]`: `found` where the neighbours confirm it, else their prediction, starting from
        `before`."""
        guess = torch.where((weight > 0)[..., None], found, before)
        local = self.neighbourhood(guess, weight.clamp(min=LOST_WEIGHT), tolerance)
        trust = (weight * local.trust(found))[..., None]
        return trust * found + (1 - trust) * local.flow, local

    def located(self, found: Tensor, confidence: Tensor, local: NeighbourFlow) -> LocatedMarkers:
        """Return the patches with flow `found [B, D, 2]`, or their neighbours' prediction where `confidence [B, D]` is 0."""
        pixels = self.rest_pixels + torch.where((confidence > 0)[..., None], found, local.flow)
        return LocatedMarkers(pixels, confidence, isotropic(confidence, LOCATION_NOISE))


class TextureLocator(PatchLocator):
    """Finds the patches of a rest image in other images of the deformed membrane.

    Patches are compared by normalised correlation, invariant to gain and offset of the light, after an affine warp.

    Args:
        rest_image: `[H, W]`, grey in 0..1.
        pixels: patch centres `[D, 2]`, px, from `choose_patches`.
        anchors: fixed pixels on the rim, `[A, 2]`, or None.

    Raises:
        MembraneError: the image is not `[H, W]`, or there are too few patches, or some lie outside the image.

    Limitations:
        Patches that moved by more than about 25 px are lost. Where reflections or shadows are the texture, and on a static
        thing in front of the membrane as large as a neighbourhood, what the image shows is followed, at rest (keep it out
        of the mask).

    Example:
        >>> from scipy.ndimage import gaussian_filter
        >>> from torchmembrane.markers.texture import choose_patches
        >>> rest = gaussian_filter(np.random.default_rng(0).random((80, 100)), 2)
        >>> rest = (rest - rest.min()) / np.ptp(rest)
        >>> locator = TextureLocator(rest, choose_patches(rest, np.ones((80, 100), bool), 200))
        >>> pixels, confidence, _ = locator(torch.tensor(np.roll(rest, 3, 1)[None, None]).float())
        >>> (pixels - locator.rest_pixels)[0][:, 0].median().round(decimals=2).item(), bool(confidence.median() > 0.9)
        (3.0, True)
    """

    def __init__(self, rest_image: np.ndarray, pixels: np.ndarray, anchors: np.ndarray | None = None):
        super().__init__(rest_image, pixels, anchors)
        levels = enumerate(self.rest_levels(rest_image))
        templates = [Template(rest, self.rest_pixels / 2**level, PATCH_RADII[level]) for level, rest in levels]
        self.templates = nn.ModuleList(templates)
        self.search = Search(templates[-1])
        self.to(torch.float32)

    @traced
    def forward(self, image: Tensor, previous: Tensor | None = None) -> LocatedMarkers:
        """Locate the patches in a batch of frames; only the steps on the finest level are differentiated.

        The coarser levels only determine where these steps start.

        Args:
            image: `[B, 1, H, W]`, grey in 0..1, of the rest image's size.
            previous: ignored, because `follows` is false.

        Raises:
            MembraneError: the image has another size than the rest image.
        """
        self.check_size(image)
        images = low_pass_pyramid(image)
        still = [level.detach() for level in images]
        shift, score = self.search(still[-1])
        flow, local = self.settle(2 ** (LEVELS - 1) * shift, score, torch.zeros_like(shift), 1.0)
        flow, local = self.settle(2 ** (LEVELS - 1) * shift, score, flow, 1.0)
        for level, steps, tolerance in ((1, 3, 0.5), (0, 2, 0.3)):
            found, likeness = self.templates[level](still[level], flow / 2**level, local.gradient, steps)
            flow, local = self.settle(2**level * found, likeness, flow, tolerance)
        found, likeness = self.templates[0](images[0], flow, local.gradient, 3)
        _, local = self.settle(found.detach(), likeness.detach(), flow, 0.3)
        return self.located(found, likeness * local.trust(found), local)
