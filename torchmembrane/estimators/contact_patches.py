"""Contact patches from tractions: where something pushes, and the patches' centroids."""

import torch
from torch import Tensor

PATCH = 0.1
"""Radius of a patch over the surface's size; what lies within it counts as one contact."""
LEAST = 0.15
"""Smallest patch that is reported, as a share of the strongest one's force."""


def contact_indicator(traction: Tensor, normals: Tensor, reference: float) -> Tensor:
    """How surely a vertex is pushed, 0..1: `s / (s + reference / 2)` of the inward traction `s`.

    A convex rigid body pushes with at least the fluid's pressure: at a contact the indicator is above 2/3, if the reference is
    the rest pressure. Arguments `[B, V, 3]`; returns `[B, V]`.
    """
    inward = (-(traction * normals).sum(-1)).clamp_min(0)
    return inward / (inward + reference / 2)


def contact_points(vertices: Tensor, rest: Tensor, inward_force: Tensor, size: float, count: int) -> Tensor:
    """Force-weighted centroids of the contact patches, strongest first, `[B, count, 3]`, NaN where there is none.

    Arguments: deformed `vertices [B, V, 3]`, `rest [V, 3]`, `inward_force [B, V]`. A patch is what lies within `PATCH` x size
    of the strongest concentration of force; it is taken away before the next is looked for.
    """
    distance2 = ((rest[:, None] - rest) ** 2).sum(-1)
    near = torch.exp(-distance2 / (2 * (PATCH * size) ** 2))
    load, points, strengths = inward_force, [], []
    for _ in range(count):
        patch = near[(load @ near).argmax(-1)]
        weight = load * patch
        strength = weight.sum(-1, keepdim=True)
        points.append((weight[..., None] * vertices).sum(1) / strength.clamp_min(torch.finfo(load.dtype).tiny))
        strengths.append(strength)
        load = load * (1 - patch.sqrt().sqrt())  # a Gaussian twice as wide
    points, strengths = torch.stack(points, 1), torch.stack(strengths, 1)
    present = (strengths > LEAST * strengths[:, :1]) & (strengths > 0)
    return torch.where(present, points, torch.nan)
