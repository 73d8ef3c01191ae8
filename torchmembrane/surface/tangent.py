"""Two unit vectors orthogonal to a direction: the tangent frame of a normal, or the two axes for the angles of a ray.

Any two unit vectors that are orthogonal to the direction and to each other will do; no result may depend on their rotation
about the direction. The functions for torch and for numpy use different rules. Both are kept, because the sampling points of
calibrated surfaces and of dots' outlines follow these frames.
"""

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

ALONG_Z = 0.9  # the cross product with the x axis is used for directions with a larger |z|, else that with the z axis


def tangent_frame(directions: Tensor, dim: int = -1) -> Tensor:
    """Return two unit vectors orthogonal to each unit direction, computed without a branch because exported models use it.

    The first is `d x e / |d x e|`, where `e` is the z axis, or the x axis for directions close to z. The second is the cross
    product of `d` and the first.

    Args:
        directions: unit vectors with components along `dim`: `[..., 3]`, or with components first `[B, 3, D]` and `dim=1`.
        dim: axis of the components.

    Returns:
        The two vectors along a new axis before that of the components: `[..., 2, 3]`, or `[B, 2, 3, D]`.

    Limitations:
        The frame is discontinuous where `|z|` passes 0.9; do not differentiate across that point.

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
    """Return two unit vectors orthogonal to each unit normal, as numpy arrays.

    The first is also orthogonal to the coordinate axis of the normal's smallest component.

    Args:
        normals: unit normals, `[D, 3]`.

    Returns:
        `[D, 2, 3]`.

    Example:
        >>> tangent_axes(np.array([[0.0, 0.6, 0.8]])).round(3).tolist()
        [[[0.0, 0.8, -0.6], [-1.0, 0.0, 0.0]]]
    """
    first = np.cross(normals, np.eye(3)[np.abs(normals).argmin(1)])
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    return np.stack([first, np.cross(normals, first)], 1)
