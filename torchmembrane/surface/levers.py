"""Markers at a distance from the surface, such as the tips of pins and bumps: each is the end of a lever that turns with it.

With the surface's tangents `a` and `b` along the grid's two directions at a marker's foot `x`, the tip is at

    x + h n,    n = a x b / |a x b|.

If the tangents change by `da` and `db`, the normal changes by

    dn = -(n . da) a* - (n . db) b*,    a* = b x n / |a x b|,  b* = n x a / |a x b|,

with the dual basis `a*`, `b*` of the tangent plane. `h` is negative where `a x b` points away from the tip.
"""

from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor, nn

from .bicubic import bicubic_slopes
from .membrane import Membrane
from .projection import SurfacePoints


class Turned(NamedTuple):
    """Levers on a deformed surface.

    Attributes:
        levers: vectors from feet to tips, `[..., D, 3]`.
        normal: unit normals `n`, `[..., D, 3]`.
        dual: dual basis `a*` and `b*`, `[..., 2, D, 3]`.
    """

    levers: Tensor
    normal: Tensor
    dual: Tensor


class Levers(nn.Module):
    """Levers of the markers of a surface, which turn as the surface deforms.

    Args:
        membrane: the rest surface.
        points: feet of the markers on the rest surface.
        levers: vectors from feet to tips at rest, `[D, 3]`; zero for markers on the surface.

    Attributes:
        slopes: weights of the vertices that give the tangents, `[2, D, V]`.
        tangents: tangents of the rest surface without their components along the levers, `[2, D, 3]`.
        heights: signed lengths of the levers along `a x b`, `[D]`.

    Example:
        >>> from torchmembrane.surface.shapes import heightfield
        >>> plane = heightfield(np.arange(5.0), np.arange(5.0), np.full((5, 5), 10.0))
        >>> levers = Levers(plane, plane.closest_points([[2.0, 2.0, 10.0]]), torch.tensor([[0.0, 0.0, -3.0]]))
        >>> tilted = plane.rest[:, :1] * torch.tensor([0.0, 0.0, 0.75])  # by 3 over 4
        >>> (levers(tilted).levers.round(decimals=9) + 0.0).tolist()
        [[1.8, 0.0, -2.4]]
    """

    slopes: Tensor
    tangents: Tensor
    heights: Tensor

    def __init__(self, membrane: Membrane, points: SurfacePoints, levers: Tensor) -> None:
        super().__init__()
        levers = levers.double()
        self.register_buffer("slopes", torch.from_numpy(bicubic_slopes(points, membrane.grid, membrane.fixed)))
        tangents = self.slopes @ membrane.rest
        length = torch.linalg.vector_norm(levers, dim=-1, keepdim=True)
        along = torch.where(length > 0, levers / length.clamp_min(torch.finfo(levers.dtype).tiny), 0.0)
        tangents = tangents - (tangents * along).sum(-1, keepdim=True) * along
        self.register_buffer("tangents", tangents)
        self.register_buffer("heights", (torch.linalg.cross(*tangents) * along).sum(-1).sign() * length[:, 0])

    def forward(self, u: Tensor) -> Turned:
        """Return the levers on the surface whose vertices are displaced by `u [..., V, 3]`."""
        moved = (self.slopes.flatten(0, 1) @ u).unflatten(-2, (2, -1))
        a, b = (self.tangents + moved).unbind(-3)
        across = torch.linalg.cross(a, b)
        area = torch.linalg.vector_norm(across, dim=-1, keepdim=True).clamp_min(torch.finfo(u.dtype).tiny)
        n = across / area
        dual = torch.stack([torch.linalg.cross(b, n), torch.linalg.cross(n, a)], -3) / area[..., None, :, :]
        return Turned(self.heights[:, None] * n, n, dual)


def inward_levers(membrane: Membrane, points: SurfacePoints, heights: np.ndarray) -> np.ndarray:
    """Return levers `[D, 3]` of given `heights [D]` along the inward normals at points of the rest surface.

    Example:
        >>> from torchmembrane.surface.shapes import spherical_cap
        >>> cap = spherical_cap(12.0, 9.0, 15.0)
        >>> inward_levers(cap, cap.closest_points([[0.0, 0.0, 24.0]]), np.array([2.0])).round(2).tolist()
        [[-0.0, -0.0, -2.0]]
    """
    tangents = bicubic_slopes(points, membrane.grid, membrane.fixed) @ membrane.rest.cpu().double().numpy()
    across = np.cross(*tangents)
    levers: np.ndarray = -membrane.outward * heights[:, None] * across / np.linalg.norm(across, axis=1, keepdims=True)
    return levers
