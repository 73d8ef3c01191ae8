"""Interpolation of marker displacements in the image to the flow of every grid vertex (section 5)."""

import numpy as np
import torch
from torch import Tensor, nn

from ...errors import MembraneError
from ...mechanics.hyperelastic import ElasticEnergy
from ...solve.conjugate_gradient import conjugate_gradient
from ...surface.membrane import Membrane
from ...surface.projection import SurfacePoints
from ...surface.topology import corners, corners_to_vertices
from ..base import Problem

SMOOTHING_LENGTH = 0.45
"""Wavelength, in units of two marker spacings, at which the interpolated flow keeps half of the measured amplitude."""


class VertexFlow(nn.Module):
    """Computes the pixels of the grid's vertices from those of the markers.

    Args:
        problem: description of the sensor.
        interpolation: interpolation of the markers' displacements to the grid's vertices.
    """

    rest_pixels: Tensor
    vertex_pixels: Tensor

    def __init__(self, problem: Problem, interpolation: "FlowInterpolation"):
        super().__init__()
        self.interpolation = interpolation
        self.register_buffer("rest_pixels", problem.rest_pixels)
        self.register_buffer("vertex_pixels", problem.vertex_pixels)

    def forward(self, pixels: Tensor, confidence: Tensor) -> Tensor:
        """Return the pixels `[B, V, 2]` of the vertices from those of the markers `[B, D, 2]` and their confidence `[B, D]`."""
        moved: Tensor = self.vertex_pixels + self.interpolation(pixels - self.rest_pixels, confidence)
        return moved


class FlowInterpolation(nn.Module):
    """Interpolates marker displacements to a smooth image flow on the grid that is zero on the rim.

    It minimises `sum_d c_d |W_d f - s_d|^2 + alpha |Laplace f|^2` over grid flows `f` that vanish on the rim, with the
    confidence `c_d`, the marker's barycentric weights `W_d` and the Laplacian of the rest surface. If all markers are found,
    this is a constant operator, `f = R s`. For any confidences it is `f = R (c s + (1 - c) z)`, where `z` is `f` at the
    markers: `z = H (c s + (1 - c) z)`, `H = W R`. Only lost markers are unknown, so a few conjugate gradient steps solve it.

    Args:
        membrane: the rest surface on the solver's grid.
        markers: the markers as points on the membrane.
        steps: number of conjugate gradient steps.

    Raises:
        MembraneError: fewer than three markers.
    """

    spread: Tensor
    influence: Tensor

    def __init__(self, membrane: Membrane, markers: SurfacePoints, steps: int = 12):
        super().__init__()
        self.steps = steps
        D, V = len(markers.vertices), len(membrane.rest)
        if D < 3:
            raise MembraneError(f"FlowInterpolation: {D} markers; expected at least 3")
        W, bending = weights(markers, V), roughness(membrane, D)
        free = membrane.free_vertices
        normal = (W.T @ W + bending)[free][:, free]
        inverse = torch.zeros(V, V, dtype=torch.float64)
        inverse[free[:, None], free] = torch.linalg.inv(normal)
        at_markers = W @ inverse
        self.register_buffer("spread", at_markers)
        self.register_buffer("influence", at_markers @ W.T)

    def forward(self, displacement: Tensor, confidence: Tensor) -> Tensor:
        """Return the flow `[..., V, 2]` px from `displacement [..., D, 2]` px and `confidence [..., D]` of the markers."""
        return (self.completed(displacement, confidence) @ self.spread).mT

    def completed(self, displacement: Tensor, confidence: Tensor) -> Tensor:
        """Return the completed displacements `c s + (1 - c) z` of all markers, `[..., 2, D]` px; arguments as for `forward`."""
        c, displacement = confidence[..., None, :], displacement.mT
        H, lost = self.influence, (1 - c).clamp_min(1e-12).sqrt()  # H is symmetric
        observed = c * torch.where(c > 0, displacement, 0.0)
        filled = conjugate_gradient(lambda y: y - lost * ((lost * y) @ H), lambda y: y, lost * (observed @ H), self.steps)
        return observed + lost * filled


def weights(markers: SurfacePoints, count: int) -> Tensor:
    """Return the matrix `W [D, V]` that interpolates values at the markers from those at the grid's vertices."""
    W = torch.zeros(len(markers.vertices), count, dtype=torch.float64)
    return W.scatter_add_(1, torch.from_numpy(markers.vertices.astype(np.int64)), torch.from_numpy(markers.weights.copy()))


def roughness(membrane: Membrane, markers: int) -> Tensor:
    """Return the matrix `[V, V]` of `alpha |Laplace f|^2` for a number of markers on the membrane."""
    spacing2 = membrane.rest_area.sum() / markers
    alpha = (2 * SMOOTHING_LENGTH * spacing2.sqrt() / (2 * torch.pi)) ** 4 / spacing2
    L = _laplacian(membrane)
    return alpha * L @ (L / membrane.rest_area[:, None])


def _laplacian(membrane: Membrane) -> Tensor:
    """Return the dense stiffness matrix `L [V, V]` of the Dirichlet energy on the rest surface (cotangent Laplacian)."""
    V = len(membrane.rest)
    elasticity = ElasticEnergy(membrane, "harmonic", 1.0)
    one = torch.zeros_like(membrane.rest)
    one[:, 2] = 1.0
    K = elasticity.stiffness_along(membrane.rest, one)
    return corners_to_vertices(K @ corners(torch.eye(V, dtype=torch.float64), membrane.grid), membrane.grid)
