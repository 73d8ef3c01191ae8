"""A dot's outline in the image: pixel = centre + shape @ (unit circle)."""

import numpy as np
import torch

SOFTNESS = 0.6  # px, logistic scale of a dot's blurred outline


def half_axes(shapes):
    """Long and short half axis `[D, 2]` of the ellipses `shapes [D, 2, 2]`."""
    return np.linalg.svd(shapes, compute_uv=False)


def size_tolerance(shapes, sizes):
    """Standard deviation of a dot's log radius: wide, but less than half of what tells two sizes apart."""
    log_radius = 0.5 * np.log(np.abs(np.linalg.det(shapes)))
    if sizes.min() == sizes.max():
        return 0.45
    return float(np.clip(0.45 * abs(np.median(log_radius[sizes == 1]) - np.median(log_radius[sizes == 0])), 0.2, 0.45))


def metric_of(shape):
    """`(S S^T)^-1 [2, 2, ...]` of `shape [..., 2, 2]`: `x^T (S S^T)^-1 x = |S^-1 x|^2`."""
    a, b, c, d = shape.flatten(-2).movedim(-1, 0).split(1)
    uv, area = a * c + b * d, a * d - b * c
    return torch.cat([c * c + d * d, -uv, -uv, a * a + b * b]).unflatten(0, (2, 2)) / (area * area)


def draw(pixels, shapes, image_size):
    """The pattern as dark dots on white, `[1, 1, H, W]`."""
    width, height = image_size
    image = np.ones((height, width))
    for centre, shape in zip(pixels, shapes, strict=True):
        reach = int(half_axes(shape)[0]) + 4
        low, high = np.round(centre).astype(int) - reach, np.round(centre).astype(int) + reach + 1
        u, v = np.arange(max(low[0], 0), min(high[0], width)), np.arange(max(low[1], 0), min(high[1], height))
        y = (np.stack(np.meshgrid(u, v), -1) - centre) @ np.linalg.inv(shape).T
        depth = (1 - np.linalg.norm(y, axis=-1)) * np.sqrt(abs(np.linalg.det(shape)))
        image[np.ix_(v, u)] -= 0.9 / (1 + np.exp(-depth / SOFTNESS))
    return torch.as_tensor(image.clip(0))[None, None]
