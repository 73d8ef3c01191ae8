"""From marker displacements in the image to a ray through every grid vertex; local affine maps (eqs. 15-17, Appendix C)."""

from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor, nn

from ..errors import MembraneError
from ..mechanics.hyperelastic import ElasticEnergy
from ..solve.conjugate_gradient import conjugate_gradient
from ..surface.membrane import Membrane
from ..surface.projection import SurfacePoints
from ..surface.topology import corners, corners_to_vertices
from .bilinear import bilinear_matrix

KINDS = ("smooth", "bilinear")
SMOOTHING_LENGTH = 0.45
"""Wavelength, in units of two marker spacings, at which the interpolated flow keeps half of the measured amplitude."""


class AffineMap(NamedTuple):
    """`p' = A p + b`: `A [..., q, p]`, `b [..., q]`."""

    A: Tensor
    b: Tensor


def affine_fit(points: Tensor, images: Tensor, inverse_moment: Tensor | None = None) -> AffineMap:
    """Least-squares affine map between matched points (eqs. 15-17, 47-52).

    Arguments: `points [..., n, p]`, `images [..., n, q]`; `inverse_moment [..., p, p]` is `G^-1` where it is known beforehand.
    `A = F^T G^-1`, `F = sum p p'^T - n pbar p'bar^T`, `G = sum p p^T - n pbar pbar^T`, and `b = p'bar - A pbar`
    (eq. 17 prints the opposite sign, that of Appendix C's `A x - b`).
    Wrong when the points are collinear (or, in space, coplanar): `G` is singular there.
    """
    mean, image_mean = points.mean(-2), images.mean(-2)
    centred = points - mean[..., None, :]
    if inverse_moment is None:
        inverse_moment = torch.linalg.inv(centred.mT @ centred)
    F = centred.mT @ (images - image_mean[..., None, :])
    A = F.mT @ inverse_moment
    return AffineMap(A, image_mean - (A @ mean[..., None]).squeeze(-1))


def weighted_affine_fit(points: Tensor, images: Tensor, weight: Tensor) -> AffineMap:
    """Affine map that minimises `sum_i e_i.Q_i e_i`, `e_i = A p_i + b - p'_i` (eq. 46, with a weight matrix of each match).

    Arguments: `points [..., n, p]`, `images [..., n, q]`, `weight [..., n, q, q]` symmetric positive definite, the inverse
    covariances of the matches. One matrix for all changes nothing: eq. 52 does not know Q; then `affine_fit` is enough.
    Wrong when the points are collinear (in space, coplanar).
    """
    homogeneous = torch.cat([points, torch.ones_like(points[..., :1])], -1)
    normal = torch.einsum("...ia,...ipq,...ib->...paqb", homogeneous, weight, homogeneous)
    load = torch.einsum("...ia,...ipq,...iq->...pa", homogeneous, weight, images)
    q, p = images.shape[-1], points.shape[-1]
    fit = torch.linalg.solve(normal.flatten(-2).flatten(-3, -2), load.flatten(-2)).unflatten(-1, (q, p + 1))
    return AffineMap(fit[..., :-1], fit[..., -1])


class LocalAffineMaps(nn.Module):
    """One affine map for each quadrilateral of a grid of points, with `G^-1` precomputed (section 3.2).

    Argument: `points [V, p]`, the grid's rest positions (p = 2: in the image, or in the plane). Calling it with the moved
    points `[..., V, q]` returns `A [..., m-1, n-1, q, p]`, `b [..., m-1, n-1, q]`.
    """

    def __init__(self, points: Tensor, grid: tuple[int, int]):
        super().__init__()
        self.grid = grid
        p = corners(points, grid)
        centred = p - p.mean(-2, keepdim=True)
        self.register_buffer("points", p)
        self.register_buffer("inverse_moment", torch.linalg.inv(centred.mT @ centred))

    def forward(self, moved: Tensor) -> AffineMap:
        return affine_fit(self.points, corners(moved, self.grid), self.inverse_moment)


class FlowInterpolation(nn.Module):
    """Smooth image flow on the grid from marker displacements, zero on the rim.

    Minimises `sum_d c_d |W_d f - s_d|^2 + alpha |Laplace f|^2` over grid flows `f` that vanish on the rim, with `c_d` the
    confidence, `W_d` the marker's barycentric weights and the rest surface's own Laplacian. With all markers found this is a
    constant operator, `f = R s`; for any confidences it is `f = R (c s + (1 - c) z)`, where `z` is `f` at the markers:
    `z = H (c s + (1 - c) z)`, `H = W R`. Only lost markers are unknowns, so a few conjugate-gradient steps solve it. With
    `kind = "bilinear"` (the paper's) the flow is bilinear between the dots instead; a lost dot then has the smooth flow.

    Arguments: membrane, the markers' `SurfacePoints`, `kind`. Calling it with `displacement [..., D, 2]` (px) and
    `confidence [..., D]` gives the flow `[..., V, 2]` (px).
    """

    def __init__(self, membrane: Membrane, markers: SurfacePoints, kind: str = "smooth", steps: int = 12):
        super().__init__()
        if kind not in KINDS:
            raise MembraneError(f"FlowInterpolation: kind = {kind!r}; expected one of {', '.join(KINDS)}")
        self.kind, self.steps = kind, steps
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
        if kind == "bilinear":
            self.register_buffer("bilinear", torch.from_numpy(bilinear_matrix(membrane, markers)))

    def forward(self, displacement: Tensor, confidence: Tensor) -> Tensor:
        c, displacement = confidence[..., None, :], displacement.mT
        H, lost = self.influence, (1 - c).clamp_min(1e-12).sqrt()  # H is symmetric
        told = c * torch.where(c > 0, displacement, 0.0)
        filled = conjugate_gradient(lambda y: y - lost * ((lost * y) @ H), lambda y: y, lost * (told @ H), self.steps)
        complete = told + lost * filled
        if self.kind == "bilinear":
            return (torch.where(c > 0, displacement, complete @ H) @ self.bilinear.mT).mT
        return (complete @ self.spread).mT


def weights(markers: SurfacePoints, count: int) -> Tensor:
    """`W [D, V]`: values at markers from those at the grid's vertices."""
    W = torch.zeros(len(markers.vertices), count, dtype=torch.float64)
    return W.scatter_add_(1, torch.from_numpy(markers.vertices.astype(np.int64)), torch.from_numpy(markers.weights.copy()))


def roughness(membrane: Membrane, markers: int) -> Tensor:
    """`alpha |Laplace f|^2` as a matrix `[V, V]`, for so many markers on the membrane."""
    spacing2 = membrane.rest_area.sum() / markers
    alpha = (2 * SMOOTHING_LENGTH * spacing2.sqrt() / (2 * torch.pi)) ** 4 / spacing2
    L = _laplacian(membrane)
    return alpha * L @ (L / membrane.rest_area[:, None])


def _laplacian(membrane: Membrane) -> Tensor:
    """Dense stiffness `L [V, V]` of the Dirichlet energy on the rest surface (cotangent Laplacian)."""
    V = len(membrane.rest)
    elasticity = ElasticEnergy(membrane, "harmonic", 1.0)
    one = torch.zeros_like(membrane.rest)
    one[:, 2] = 1.0
    K = elasticity.stiffness_along(membrane.rest, one)
    return corners_to_vertices(K @ corners(torch.eye(V, dtype=torch.float64), membrane.grid), membrane.grid)
