"""The share of a membrane that the markers found in an image cover."""

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from ..surface.membrane import Membrane

MARKERS_PER_VERTEX = 4
"""Number of nearest markers that are examined for each vertex."""
MARKER_REACH = 1.5
"""Radius of the area that a marker covers, over the markers' spacing."""
LEAST_COVERAGE = 0.85
"""Share of the area covered at rest below which a part of the membrane counts as hidden."""
LEAST_FACING = 0.5
"""Share of its facing at rest below which a lost marker counts as turned away by the press, not as hidden."""


def facings(points: Tensor, normals: Tensor) -> Tensor:
    """Return how directly surfaces at `points [..., D, 3]` with outward `normals [..., D, 3]` of any length face a camera
    inside: the cosines of the angles between normals and lines of sight, without refraction, `[..., D]`."""
    return F.cosine_similarity(points, normals, dim=-1)


class Coverage(nn.Module):
    """The share of a membrane's area that found markers cover, relative to the area covered by those seen at rest.

    Args:
        membrane: the rest surface on the solver's grid.
        positions: positions of the markers, `[D, 3]`.
        seen: `[D]` bool, which of them are seen at rest; for W views `[W D]`, view by view.
        facing: `[D]` or `[W D]`, how directly they face the camera at rest, as returned by `facings`.
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
        """Return the share `[B]` for markers with `confidence [B, D]`, 0 for lost ones; for several views `[B, W D]`."""
        found = (confidence > 0).to(self.near.dtype)
        found = found if self.views == 1 else found.unflatten(1, (self.views, -1)).amax(1)
        seen: Tensor = (found[:, self.nearest] * self.near).amax(-1) @ self.share
        return seen

    def in_view(self, confidence: Tensor, facing: Tensor) -> Tensor:
        """Return the same share, but also count lost markers that the press has turned away from the camera, according to how
        directly the markers on the reconstructed surface face it, `facing [B, D]`."""
        turned = facing < LEAST_FACING * self.facing
        if self.views > 1:  # from every view that saw it at rest
            turned = (turned | ~self.seen).unflatten(1, (self.views, -1)).all(1).repeat(1, self.views)
        counted: Tensor = self(torch.where(turned, 1.0, confidence))
        return counted
