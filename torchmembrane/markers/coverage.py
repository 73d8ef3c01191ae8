"""How much of a membrane the markers that are found still see."""

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from ..surface.membrane import Membrane

MARKERS_PER_VERTEX = 4
"""Markers that a vertex is asked of."""
MARKER_REACH = 1.5
"""How far a marker sees, over the markers' spacing."""
LEAST_COVERAGE = 0.85
"""Of what the markers see at rest: where they see less, a part of the membrane is hidden."""
LEAST_FACING = 0.5
"""Of how a marker faces the camera at rest: one that faces it less is lost to the press, and hidden by nothing."""


def facings(points: Tensor, normals: Tensor) -> Tensor:
    """How surfaces at `points [..., D, 3]` with outward `normals [..., D, 3]` of any length face the camera that sees them
    from within: the cosines of the angles between normals and lines of sight, refraction apart, `[..., D]`."""
    return F.cosine_similarity(points, normals, dim=-1)


class Coverage(nn.Module):
    """The share of a membrane's area near markers that are found, of what is near those seen at rest.

    Args:
        membrane: the rest surface on the solver's grid.
        positions: of the markers, `[D, 3]`.
        seen: `[D]` bool, which of them are seen at rest; of W views `[W D]`, view by view.
        facing: `[D]` or `[W D]`, how they face the camera at rest, as of `facings`.
    """

    seen: Tensor
    facing: Tensor
    nearest: Tensor
    near: Tensor
    share: Tensor

    def __init__(self, membrane: Membrane, positions: Tensor, seen: Tensor, facing: Tensor):
        super().__init__()
        self.views = len(seen) // len(positions)
        self.register_buffer("seen", seen)
        seen = seen.unflatten(0, (self.views, -1)).any(0)
        reach = MARKER_REACH * membrane.size / len(positions) ** 0.5
        distance = torch.where(seen, torch.cdist(membrane.rest, positions.to(membrane.rest)), torch.inf)
        distance, nearest = distance.topk(min(MARKERS_PER_VERTEX, len(positions)), largest=False)
        area = membrane.rest_area * (distance[:, 0] < reach)
        self.register_buffer("facing", facing)
        self.register_buffer("nearest", nearest)
        self.register_buffer("near", (distance < reach).double())
        self.register_buffer("share", area / area.sum())

    def forward(self, confidence: Tensor) -> Tensor:
        """The share `[B]`, of markers with `confidence [B, D]`, 0 where one is lost; of several views `[B, W D]`."""
        found = (confidence > 0).to(self.near.dtype)
        found = found if self.views == 1 else found.unflatten(1, (self.views, -1)).amax(1)
        seen: Tensor = (found[:, self.nearest] * self.near).amax(-1) @ self.share
        return seen

    def in_view(self, confidence: Tensor, facing: Tensor) -> Tensor:
        """The same, those counted too that the press has turned away: by how the markers on the surface found face the camera,
        `facing [B, D]`."""
        turned = facing < LEAST_FACING * self.facing
        if self.views > 1:  # from every view that saw it at rest
            turned = (turned | ~self.seen).unflatten(1, (self.views, -1)).all(1).repeat(1, self.views)
        counted: Tensor = self(torch.where(turned, 1.0, confidence))
        return counted
