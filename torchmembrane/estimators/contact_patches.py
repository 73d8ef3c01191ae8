"""Contact patches from tractions: where something pushes, and the patches' centroids."""

import torch
from torch import Tensor

PATCH = 0.1
"""Radius of a patch over the surface's size; what lies within it counts as one contact."""
LEAST = 0.15
"""Smallest patch that is reported, as a share of the strongest one's force."""


def contact_indicator(traction: Tensor, normals: Tensor, reference: float | Tensor) -> Tensor:
    """How surely a vertex is pushed: `s / (s + reference / 2)` of the compressive normal traction `s`.

    A convex rigid body pushes with at least the fluid's pressure: at a contact the indicator is above 2/3, if the reference is
    the rest pressure.

    Args:
        traction: `[B, V, 3]`.
        normals: outward, `[B, V, 3]`.
        reference: force / length^2, a number or `[B, V]`.

    Returns:
        `[B, V]` in 0..1.

    Example:
        >>> outward = torch.tensor([[[0.0, 0.0, 1.0]]])
        >>> contact_indicator(-0.3 * outward, outward, 0.2)
        tensor([[0.7500]])
    """
    inward = (-(traction * normals).sum(-1)).clamp_min(0)
    return inward / (inward + reference / 2)


def contact_points(vertices: Tensor, rest: Tensor, inward_force: Tensor, size: float, count: int) -> Tensor:
    """Force-weighted centroids of the contact patches.

    A patch is what lies within `PATCH` x size of the strongest concentration of force; it is taken away before the next is
    looked for.

    Args:
        vertices: deformed, `[B, V, 3]`.
        rest: `[V, 3]`.
        inward_force: `[B, V]`.
        size: of the surface.
        count: how many are looked for.

    Returns:
        `[B, count, 3]`, strongest first, NaN where there is none.
    """
    distance2 = ((rest[:, None] - rest) ** 2).sum(-1)
    near = torch.exp(-distance2 / (2 * (PATCH * size) ** 2))
    load, found, forces = inward_force, [], []
    for _ in range(count):
        patch = near[(load @ near).argmax(-1)]
        weight = load * patch
        force = weight.sum(-1, keepdim=True)
        found.append((weight[..., None] * vertices).sum(1) / force.clamp_min(torch.finfo(load.dtype).tiny))
        forces.append(force)
        load = load * (1 - patch.sqrt().sqrt())  # a Gaussian twice as wide
    points, strengths = torch.stack(found, 1), torch.stack(forces, 1)
    present = (strengths > LEAST * strengths[:, :1]) & (strengths > 0)
    return torch.where(present, points, torch.nan)
