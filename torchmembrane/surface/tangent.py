"""Two unit vectors across a direction: the tangent frame of a normal, the two angles of a ray.

Any two unit vectors that are orthogonal to the direction and to each other will do; no result may depend on their rotation
about the direction. There is one rule for torch and another one for numpy. Both are kept, because the sampling points of
calibrated surfaces and of dots' outlines follow these frames.
"""

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

ALONG_Z = 0.9  # directions with a larger |z| are crossed with the x axis, others with the z axis


def tangent_frame(directions: Tensor, dim: int = -1) -> Tensor:
    """Two unit vectors across each unit direction, computed without a branch because exported models contain it.

    The first is `d x e / |d x e|` with the axis `e = z`, or `x` for directions close to `z`; the second `d x` the first.

    Args:
        directions: unit vectors, x y z along `dim`: `[..., 3]`, or components first, `[B, 3, D]` with `dim=1`.
        dim: the axis of the components.

    Returns:
        The two vectors along a new axis before that of the components: `[..., 2, 3]`, or `[B, 2, 3, D]`.

    Limitations:
        Turns abruptly where `|z|` passes 0.9: not for what is differentiated across there.

    Example:
        >>> tangent_frame(torch.tensor([[1.0, 0.0, 0.0]])).tolist()
        [[[0.0, -1.0, 0.0], [0.0, 0.0, -1.0]]]
    """
    dim = dim % directions.ndim
    x, y, z = directions.unbind(dim)
    zero = torch.zeros_like(x)
    across_z, across_x = torch.stack([y, -x, zero], dim), torch.stack([zero, z, -y], dim)
    first = F.normalize(torch.where((z.abs() < ALONG_Z).unsqueeze(dim), across_z, across_x), dim=dim)
    return torch.stack([first, torch.linalg.cross(directions, first, dim=dim)], dim)


def tangent_axes(normals: np.ndarray) -> np.ndarray:
    """Two unit vectors across each unit normal, as numpy arrays: the first across the axis of its least component.

    Args:
        normals: `[D, 3]`, of length one.

    Returns:
        `[D, 2, 3]`.

    Example:
        >>> tangent_axes(np.array([[0.0, 0.6, 0.8]])).round(3).tolist()
        [[[0.0, 0.8, -0.6], [-1.0, 0.0, 0.0]]]
    """
    first = np.cross(normals, np.eye(3)[np.abs(normals).argmin(1)])
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    return np.stack([first, np.cross(normals, first)], 1)
