"""How far apart markers are."""

import numpy as np
from scipy.spatial import cKDTree


def spacing(pixels):
    """`[D]` distance of each dot to its nearest neighbour and `[D]` the mean over its four nearest."""
    distance = cKDTree(pixels).query(pixels, k=min(5, len(pixels)))[0][:, 1:]
    return distance[:, 0], distance.mean(1)


def thin_out(points, gap):
    """Every point farther than `gap` from those kept before it."""
    kept = []
    for point in points:
        if all(np.hypot(*(point - other)) > gap for other in kept):
            kept.append(point)
    return np.array(kept).reshape(-1, 2)


def square_distance(x, y):
    """`[..., K, D]` between the points `x [..., K, 2]` and `y [..., D, 2]`."""
    return (x.square().sum(-1)[..., None] + y.square().sum(-1)[..., None, :] - 2 * x @ y.mT).clamp_min(0)
