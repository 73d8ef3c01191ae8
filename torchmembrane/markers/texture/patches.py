"""Choice of patches of the rest image that can be followed."""

import numpy as np
from scipy.ndimage import binary_erosion, gaussian_filter

from ...errors import MembraneError
from ...files.levels import too_few_bits
from .template import PATCH_RADII

WEAKEST_GRADIENT = 0.01  # grey per px, rms over the patch in its weakest direction: 1 % noise then moves it by 0.05 px


def choose_patches(image: np.ndarray, mask: np.ndarray, count: int = 1200) -> np.ndarray:
    """Choose the patches to follow: the pixels with the strongest gradients in two directions, spread evenly and at least 5 px
    from the edge of the mask.

    Args:
        image: rest image `[H, W]`, grey in 0..1.
        mask: `[H, W]` bool, where the membrane is visible.
        count: approximate number of patches if all of the mask is textured.

    Returns:
        Patch centres `[D, 2]`, px, in decreasing order of the structure tensor's smaller eigenvalue.

    Raises:
        MembraneError: image and mask are not `[H, W]` of one size, or fewer than 30 patches are found.

    Example:
        >>> image = np.random.default_rng(0).random((120, 160))
        >>> patches = choose_patches(gaussian_filter(image, 2), np.ones((120, 160), bool), 200)
        >>> len(patches) > 30, bool((patches >= 5).all())
        (True, True)
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
    for pixel in np.stack([v, u], 1)[order]:
        if not taken[tuple(pixel + margin)]:
            chosen.append(pixel)
            taken[tuple((pixel + margin + disc).T)] = True
    if len(chosen) < 30:
        raise MembraneError(
            f"choose_patches: {len(chosen)} textured places in a mask of {int(mask.sum())} px, expected 30 or more; "
            "give a sharper or brighter rest image, more paint or speckle, or check where the rest surface projects"
            f"{too_few_bits(image)}"
        )
    return np.array(chosen, float)[:, ::-1].copy()


def weakest_gradient(image: np.ndarray) -> np.ndarray:
    """Return the square root of the structure tensor's smaller eigenvalue, grey per px, `[H, W]`, over about a patch of the
    image."""
    v, u = np.gradient(gaussian_filter(np.asarray(image, float), 1.0))
    uu, uv, vv = (gaussian_filter(product, PATCH_RADII[0] / 2) for product in (u * u, u * v, v * v))
    return np.sqrt(np.maximum((uu + vv) / 2 - np.sqrt((uu - vv) ** 2 / 4 + uv**2), 0.0))
