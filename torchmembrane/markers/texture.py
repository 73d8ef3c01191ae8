"""Texture as markers: patches of paint or speckle, followed from the rest image into images of the deformed membrane.

Coarse to fine on a pyramid of three levels. At the coarsest every template meets every shift up to `REACH` by
normalised correlation. The finer ones start from the flow so far, warp by its local affine map, and refine both by
inverse compositional Gauss-Newton steps (Baker & Matthews, IJCV 56, 2004) with the light's gain and offset projected
out beforehand: a step is one matrix product with constants. After every level a robust affine fit to its neighbours
judges each patch.
"""

from typing import NamedTuple

import numpy as np
import torch
from scipy.ndimage import binary_erosion, gaussian_filter
from scipy.spatial import cKDTree
from torch import Tensor, nn
from torch.nn import functional as F

from ..errors import MembraneError

LEVELS = 3  # pyramid: full, half, quarter resolution
REACH = 7  # px of the coarsest level searched to each side: 28 px of the image
RADIUS = (8, 8, 6)  # px of the level, half side of a patch, finest level first
WIDTH = 0.6  # standard deviation of a patch's Gaussian window over its half side
WARP_DAMPING = 1e-3  # grey^2: keeps weak texture from bending a patch's own affine map with the noise
NEIGHBOURS = 16
ROBUST_STEPS = 4
HEARSAY = 1e-3  # weight of a lost patch's predicted flow: heard only where nobody knows better
RIDGE = 0.05  # share of the neighbours' spread that damps the affine part of a fit
WEAKEST_GRADIENT = 0.01  # grey per px, rms over the patch in its weakest direction: 1 % noise then moves it by 0.05 px
BINOMIAL = (1 / 16, 4 / 16, 6 / 16, 4 / 16, 1 / 16)


def choose_patches(image: np.ndarray, mask: np.ndarray, count: int = 1200) -> np.ndarray:
    """Choose the patches to follow: corners with a well-conditioned structure tensor, spread evenly.

    Args:
        image: rest image [H, W], grey in 0..1.
        mask: [H, W] bool, where the membrane is seen.
        count: patches wanted if all of the mask were textured.

    Returns:
        Patch centres [D, 2], px, the best conditioned first.

    Raises:
        MembraneError: image and mask differ in shape, or fewer than 30 places have texture in two directions.
    """
    if np.ndim(image) != 2 or np.shape(mask) != np.shape(image):
        raise MembraneError(
            f"choose_patches: image has shape {np.shape(image)} and mask {np.shape(mask)}, expected the same [H, W]; "
            "give the grey image and one bool per pixel"
        )
    mask = np.asarray(mask, bool)
    strength = np.where(binary_erosion(mask, iterations=5), weakest_gradient(image), 0.0)
    spacing = 0.85 * np.sqrt(max(mask.sum(), 1) / count)
    offsets = np.mgrid[-int(spacing) : int(spacing) + 1, -int(spacing) : int(spacing) + 1].reshape(2, -1).T
    disc = offsets[(offsets**2).sum(1) < spacing**2]
    v, u = np.nonzero(strength > WEAKEST_GRADIENT)
    order = np.argsort(-strength[v, u], kind="stable")
    margin = int(spacing) + 1
    taken = np.zeros(np.add(image.shape, 2 * margin), bool)
    chosen = []
    for place in np.stack([v, u], 1)[order]:
        if not taken[tuple(place + margin)]:
            chosen.append(place)
            taken[tuple((place + margin + disc).T)] = True
    if len(chosen) < 30:
        raise MembraneError(
            f"choose_patches: {len(chosen)} textured places in a mask of {int(mask.sum())} px, expected 30 or more; "
            "give a sharper or brighter rest image, more paint or speckle, or check where the rest surface projects"
        )
    return np.array(chosen, float)[:, ::-1].copy()


def weakest_gradient(image: np.ndarray) -> np.ndarray:
    """Root of the structure tensor's smaller eigenvalue [H, W], grey per px, over about a patch."""
    v, u = np.gradient(gaussian_filter(np.asarray(image, float), 1.0))
    uu, uv, vv = (gaussian_filter(product, RADIUS[0] / 2) for product in (u * u, u * v, v * v))
    return np.sqrt(np.maximum((uu + vv) / 2 - np.sqrt((uu - vv) ** 2 / 4 + uv**2), 0.0))


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


class TextureLocator(nn.Module):
    """Find the patches of a rest image again in other images of the deformed membrane.

    A patch is compared up to gain and offset of the light, warped by an affine map (normalised correlation). Wrong when
    the membrane moved by more than about 25 px, where reflections or shadows are the texture, and on a static thing in
    front of the membrane as large as a neighbourhood: what is seen is followed, at rest (keep it out of the mask).

    Args:
        rest_image: [H, W], grey in 0..1.
        pixels: patch centres [D, 2], px, from `choose_patches`.
        anchors: pixels [A, 2] on the rim, where nothing moves, or None.

    Raises:
        MembraneError: the image is not [H, W], or there are too few patches, or some lie outside the image.
    """

    def __init__(self, rest_image: np.ndarray, pixels: np.ndarray, anchors: np.ndarray | None = None):
        super().__init__()
        rest_image, pixels = np.asarray(rest_image, float), np.asarray(pixels, float)
        anchors = np.zeros((0, 2)) if anchors is None else np.asarray(anchors, float)
        if rest_image.ndim != 2 or pixels.ndim != 2 or pixels.shape[1] != 2 or len(pixels) <= NEIGHBOURS:
            raise MembraneError(
                f"TextureLocator: rest_image has shape {rest_image.shape} and pixels {pixels.shape}, expected [H, W] "
                f"and [D, 2] with D > {NEIGHBOURS}; give a grey image and the result of choose_patches"
            )
        if not ((pixels >= 0) & (pixels <= np.array(rest_image.shape)[::-1] - 1)).all():
            raise MembraneError(
                f"TextureLocator: pixels from {pixels.min(0)} to {pixels.max(0)}, expected inside the rest image "
                f"of width and height {rest_image.shape[::-1]}; give (u right, v down) of this very image"
            )
        self.size = rest_image.shape
        self.register_buffer("rest_pixels", torch.as_tensor(pixels))
        self.neighbourhood = Neighbourhood(pixels, anchors)
        levels = enumerate(pyramid(torch.as_tensor(rest_image)[None, None]))
        self.templates = nn.ModuleList(Template(rest, self.rest_pixels / 2**level, RADIUS[level]) for level, rest in levels)
        self.search = Search(self.templates[-1])
        self.to(torch.get_default_dtype())

    def forward(self, image: Tensor) -> tuple[Tensor, Tensor]:
        """Pixels and confidence of the patches; the gradient takes the last level only, the rest is where to look.

        Args:
            image: [B, 1, H, W], grey in 0..1, of the rest image's size.

        Returns:
            pixels [B, D, 2] and confidence [B, D] in 0..1; a lost patch has confidence 0 and the pixel that its
            neighbours predict.

        Raises:
            MembraneError: the image has another size than the rest image.
        """
        height, width = self.size
        if image.ndim != 4 or tuple(image.shape[1:]) != (1, height, width):
            raise MembraneError(
                f"TextureLocator: image has shape {tuple(image.shape)}, expected [B, 1, {height}, {width}] "
                "like the rest image; give grey images from the same camera, not resized"
            )
        images = pyramid(image)
        still = [level.detach() for level in images]
        shift, score = self.search(still[-1])
        flow, local = self.settle(2 ** (LEVELS - 1) * shift, score, torch.zeros_like(shift), 1.0)
        flow, local = self.settle(2 ** (LEVELS - 1) * shift, score, flow, 1.0)
        for level, steps, tolerance in ((1, 3, 0.5), (0, 2, 0.3)):
            found, likeness = self.templates[level](still[level], flow / 2**level, local.gradient, steps)
            flow, local = self.settle(2**level * found, likeness, flow, tolerance)
        found, likeness = self.templates[0](images[0], flow, local.gradient, 3)
        _, local = self.settle(found.detach(), likeness.detach(), flow, 0.3)
        confidence = likeness * local.trust(found)
        return self.rest_pixels + torch.where((confidence > 0)[..., None], found, local.flow), confidence

    def settle(self, found: Tensor, weight: Tensor, before: Tensor, tolerance: float) -> tuple[Tensor, LocalFlow]:
        """The flow [B, D, 2]: `found` where its neighbours bear it out, else what they say, starting from `before`."""
        guess = torch.where((weight > 0)[..., None], found, before)
        local = self.neighbourhood(guess, weight.clamp(min=HEARSAY), tolerance)
        trust = (weight * local.trust(found))[..., None]
        return trust * found + (1 - trust) * local.flow, local


def pyramid(image: Tensor) -> list[Tensor]:
    """Images [B, 1, H, W] at full, half and quarter resolution, low-passed; pixel p of the first is p / 2^level."""
    levels = [smooth(image)]
    for _ in range(LEVELS - 1):
        levels.append(smooth(levels[-1])[..., ::2, ::2])
    return levels


def smooth(image: Tensor) -> Tensor:
    """Binomial 5 x 5 low-pass with replicated border."""
    kernel = torch.tensor(BINOMIAL, dtype=image.dtype, device=image.device)
    image = F.conv2d(F.pad(image, (2, 2, 0, 0), mode="replicate"), kernel.view(1, 1, 1, 5))
    return F.conv2d(F.pad(image, (0, 0, 2, 2), mode="replicate"), kernel.view(1, 1, 5, 1))


def sample(image: Tensor, centre: Tensor, affine: Tensor, offset: Tensor) -> Tensor:
    """Bilinear values [B, D, N] of image [B, 1, H, W] at centre [B, D, 2] + affine [B, D, 2, 2] offset [N, 2], px."""
    scale = 2 / centre.new_tensor([image.shape[-1] - 1, image.shape[-2] - 1])
    grid = (scale * centre - 1)[:, :, None] + offset @ (scale[:, None] * affine).mT
    return F.grid_sample(image, grid, "bilinear", "border", align_corners=True)[:, 0]


def square(radius: int) -> Tensor:
    """Integer offsets [(2 radius + 1)^2, 2] in rows of u."""
    line = torch.arange(-radius, radius + 1, dtype=torch.float64)
    v, u = torch.meshgrid(line, line, indexing="ij")
    return torch.stack([u, v], -1).reshape(-1, 2)


class Template(nn.Module):
    """Patches of one level of the rest image, and the Gauss-Newton steps that bring an image's patches onto them.

    With T the patch less its weighted mean, scaled to unit variance, and S its six derivatives (by shift, by affine
    map) made orthogonal to 1 and T, a step is (S^T S)^-1 S^T I / (T . I): linear in the image I but for the gain.
    """

    def __init__(self, rest: Tensor, centre: Tensor, radius: int):
        super().__init__()
        offset = square(radius)
        weight = torch.exp(-offset.square().sum(-1) / (2 * (WIDTH * radius) ** 2))
        weight = weight / weight.sum()
        still = torch.eye(2).to(rest)[None, None]
        half = 0.5 * torch.eye(2).to(rest)
        value = sample(rest, centre[None], still, offset)[0]
        value = value - (weight * value).sum(-1, keepdim=True)
        contrast = (weight * value.square()).sum(-1, keepdim=True).sqrt() + 1e-6
        unit = (value / contrast)[:, None]
        ahead, behind = ([sample(rest, centre[None] + s * h, still, offset)[0] for h in half] for s in (1, -1))
        slope = torch.stack(ahead, 1) - torch.stack(behind, 1)  # [D, 2, N]
        slope = torch.cat([slope, (slope[:, :, None] * offset.T / radius).flatten(1, 2)], 1)
        slope = slope - (weight * slope).sum(-1, keepdim=True)
        slope = slope - (weight * slope * unit).sum(-1, keepdim=True) * unit
        damping = torch.diag(torch.tensor([1e-8] * 2 + [WARP_DAMPING] * 4).to(rest))
        newton = torch.linalg.solve((weight * slope) @ slope.mT + damping, weight * slope) * contrast[:, None]
        self.register_buffer("centre", centre.clone())
        self.register_buffer("offset", offset)
        self.register_buffer("radius", torch.tensor(float(radius)))
        self.register_buffer("weight", weight)
        self.register_buffer("unit", weight * unit[:, 0])
        self.register_buffer("rows", torch.cat([weight.expand_as(unit), weight * unit, newton], 1))  # [D, 8, N]

    def forward(self, image: Tensor, flow: Tensor, gradient: Tensor, steps: int) -> tuple[Tensor, Tensor]:
        """Refined flow [B, D, 2], px of the level, and likeness [B, D] in 0..1 by correlation, before the last step."""
        eye = torch.eye(2, dtype=flow.dtype, device=flow.device)
        affine = gradient + eye
        for _ in range(steps):
            value = sample(image, self.centre + flow, affine, self.offset)
            mean, gain, step = torch.einsum("drn,bdn->bdr", self.rows, value).split([1, 1, 6], -1)
            step = step / gain.clamp(min=1e-4)
            shift, warp = (step / step.square().sum(-1, keepdim=True).clamp(min=1).sqrt()).split([2, 4], -1)
            affine = affine @ (eye - warp.unflatten(-1, (2, 2)) / self.radius)
            flow = flow - (affine @ shift[..., None])[..., 0]
        variance = value.square() @ self.weight - mean[..., 0].square()
        ncc = gain[..., 0] / (variance.clamp(min=0) + 1e-6).sqrt()
        return flow, ((ncc - 0.7) / 0.25).clamp(0, 1)


class Search(nn.Module):
    """Exhaustive normalised correlation of the coarsest templates over all shifts up to `REACH`."""

    def __init__(self, template: Template):
        super().__init__()
        self.side = 2 * (RADIUS[-1] + REACH) + 1
        side, shift = 2 * RADIUS[-1] + 1, square(REACH)
        self.register_buffer("centre", template.centre.clone())
        self.register_buffer("offset", square(RADIUS[-1] + REACH))
        self.register_buffer("unit", template.unit.reshape(-1, 1, side, side).clone())
        self.register_buffer("weight", template.weight.reshape(1, 1, side, side).clone())
        self.register_buffer("shift", shift)
        self.register_buffer("near", torch.exp(-(shift[:, None] - shift).square().sum(-1) / 2))

    def forward(self, image: Tensor) -> tuple[Tensor, Tensor]:
        """Shift [B, D, 2] of the highest correlation, px of the level, and a score [B, D] in 0..1: high and unique?"""
        still = torch.eye(2, dtype=image.dtype, device=image.device).expand(image.shape[0], 1, 2, 2)
        window = sample(image, self.centre.expand(image.shape[0], -1, -1), still, self.offset)
        window = (window - window.mean(-1, keepdim=True)).unflatten(-1, (self.side, self.side))
        patches = self.unit.shape[0]
        weight = self.weight.expand(patches, -1, -1, -1)
        product = F.conv2d(window, self.unit, groups=patches)
        mean = F.conv2d(window, weight, groups=patches)
        variance = F.conv2d(window.square(), weight, groups=patches) - mean.square()
        ncc = (product / (variance.clamp(min=0) + 1e-6).sqrt()).flatten(-2)
        best, place = ncc.max(-1)
        near = self.near[place]
        share = torch.softmax(40 * ncc, -1) * near
        shift = (share @ self.shift) / (share.sum(-1, keepdim=True) + 1e-12)
        rival = (ncc - 2 * near).amax(-1)
        return shift, ((best - 0.5) / 0.3).clamp(0, 1) * ((best - rival) / 0.2).clamp(0, 1)
