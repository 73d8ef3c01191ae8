"""From marker displacements in the image to the flow of every grid vertex (section 5).

The paper's flow is bilinear between dots, for any dot pattern a constant matrix: the dots and the fixed rim are triangulated in
the grid's own coordinates; pairs of triangles that share their longest edge and make a convex quadrilateral are joined. Inside
a quadrilateral the interpolation is bilinear, in the triangles left over linear.
"""

import numpy as np
import torch
from scipy.spatial import Delaunay
from torch import Tensor, nn

from ...errors import MembraneError
from ...mechanics.hyperelastic import ElasticEnergy
from ...solve.conjugate_gradient import conjugate_gradient
from ...surface.membrane import Membrane
from ...surface.projection import SurfacePoints
from ...surface.topology import corners, corners_to_vertices
from ..base import Problem

FLOWS = ("smooth", "bilinear")
SMOOTHING_LENGTH = 0.45
"""Wavelength, in units of two marker spacings, at which the interpolated flow keeps half of the measured amplitude."""


class VertexFlow(nn.Module):
    """Where the grid's vertices are seen, from where the markers are.

    Args:
        problem: the sensor.
        kind: of the interpolation, "smooth" | "bilinear".
    """

    rest_pixels: Tensor
    vertex_pixels: Tensor

    def __init__(self, problem: Problem, kind: str = "smooth"):
        super().__init__()
        self.interpolation = FlowInterpolation(problem.membrane, problem.markers, kind)
        self.register_buffer("rest_pixels", problem.rest_pixels)
        self.register_buffer("vertex_pixels", problem.vertex_pixels)

    def forward(self, pixels: Tensor, confidence: Tensor) -> Tensor:
        """Pixels `[B, V, 2]` of the vertices, from those of the markers `[B, D, 2]` and their confidence `[B, D]`."""
        moved: Tensor = self.vertex_pixels + self.interpolation(pixels - self.rest_pixels, confidence)
        return moved


class FlowInterpolation(nn.Module):
    """Smooth image flow on the grid from marker displacements, zero on the rim.

    Minimises `sum_d c_d |W_d f - s_d|^2 + alpha |Laplace f|^2` over grid flows `f` that vanish on the rim, with `c_d` the
    confidence, `W_d` the marker's barycentric weights and the rest surface's own Laplacian. With all markers found this is a
    constant operator, `f = R s`; for any confidences it is `f = R (c s + (1 - c) z)`, where `z` is `f` at the markers:
    `z = H (c s + (1 - c) z)`, `H = W R`. Only lost markers are unknowns, so a few conjugate-gradient steps solve it. With
    `kind = "bilinear"` (the paper's) the flow is bilinear between the dots instead; a lost dot then has the smooth flow.

    Args:
        membrane: the rest surface on the solver's grid.
        markers: the markers as points of it.
        kind: "smooth" | "bilinear".
        steps: of the conjugate gradients.

    Raises:
        MembraneError: an unknown kind, or fewer than three markers.
    """

    spread: Tensor
    influence: Tensor
    bilinear: Tensor

    def __init__(self, membrane: Membrane, markers: SurfacePoints, kind: str = "smooth", steps: int = 12):
        super().__init__()
        if kind not in FLOWS:
            raise MembraneError(f"FlowInterpolation: kind = {kind!r}; expected one of {', '.join(FLOWS)}")
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
        """The flow `[..., V, 2]` px, from `displacement [..., D, 2]` px and `confidence [..., D]` of the markers."""
        c, displacement = confidence[..., None, :], displacement.mT
        H, lost = self.influence, (1 - c).clamp_min(1e-12).sqrt()  # H is symmetric
        observed = c * torch.where(c > 0, displacement, 0.0)
        filled = conjugate_gradient(lambda y: y - lost * ((lost * y) @ H), lambda y: y, lost * (observed @ H), self.steps)
        complete = observed + lost * filled
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


NEWTON_STEPS = 12
OUTSIDE = 1e-9
CONVERGED = 1e-6  # grid steps, by which the interpolated place may miss the point


def bilinear_matrix(membrane: Membrane, markers: SurfacePoints) -> np.ndarray:
    """Weights `[V, D]` of the markers' flow at every grid vertex; the flow of the rim is zero and adds nothing.

    Raises `MembraneError` where the markers cannot be triangulated (all on one line).
    """
    m, n = membrane.grid
    index = np.arange(m * n)
    nodes = np.stack([index // n, index % n], 1).astype(float)
    dots = (nodes[markers.vertices] * markers.weights[..., None]).sum(1)
    rim = nodes[membrane.fixed.cpu().numpy()]
    points = np.concatenate([dots, rim])
    cells = _cells(points)
    matrix = np.zeros((m * n, len(points)))
    for cell in cells:
        inside, weights = _weights(points[cell], nodes)
        fresh = inside & (np.abs(matrix).sum(1) == 0)
        matrix[np.ix_(fresh, cell)] = weights[fresh]
    matrix[membrane.fixed.cpu().numpy()] = 0
    return matrix[:, : len(dots)]


def _cells(points: np.ndarray) -> list[list[int]]:
    """Quadrilaterals (in order around) and triangles that cover the points' hull."""
    try:
        mesh = Delaunay(points)
    except Exception as error:
        raise MembraneError(
            f"bilinear_matrix: the markers cannot be triangulated ({error}); expected them spread out"
        ) from error
    pairs = []
    for k, triangle in enumerate(mesh.simplices):
        for corner in range(3):
            other = mesh.neighbors[k, corner]
            if other > k:
                a, (b, c) = triangle[corner], np.delete(triangle, corner)
                d = np.setdiff1d(mesh.simplices[other], [b, c])[0]
                pairs.append((_squareness(points[[a, b, d, c]]), k, other, [a, b, d, c]))
    free, cells = np.ones(len(mesh.simplices), bool), []
    for quality, k, other, quadrilateral in sorted(pairs, reverse=True, key=lambda pair: pair[0]):
        if quality > 0 and free[k] and free[other]:
            free[[k, other]] = False
            cells.append(quadrilateral)
    triangles: list[list[int]] = mesh.simplices[free].tolist()
    return cells + triangles


def _squareness(p: np.ndarray) -> float:
    """Smallest |sine| over the four corners; negative unless the quadrilateral is convex."""
    edge = np.roll(p, -1, 0) - p
    edge /= np.linalg.norm(edge, axis=1, keepdims=True)
    before = np.roll(edge, 1, 0)
    sines = before[:, 0] * edge[:, 1] - before[:, 1] * edge[:, 0]
    return float((sines * np.sign(sines.sum())).min()) - 0.3


def _weights(p: np.ndarray, q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Which of the points `q [Q, 2]` lie in the cell with corners `p [3 or 4, 2]`, and their interpolation weights."""
    u, v = np.full(len(q), 0.5), np.full(len(q), 0.5)
    twist = p[0] - p[1] + p[2] - p[3] if len(p) == 4 else np.zeros(2)
    along, across = p[1] - p[0], p[-1] - p[0]
    with np.errstate(all="ignore"):
        for _ in range(NEWTON_STEPS):
            miss = p[0] + u[:, None] * along + v[:, None] * across + (u * v)[:, None] * twist - q
            du, dv = along + v[:, None] * twist, across + u[:, None] * twist
            det = du[:, 0] * dv[:, 1] - du[:, 1] * dv[:, 0]
            u = u - (miss[:, 0] * dv[:, 1] - miss[:, 1] * dv[:, 0]) / det
            v = v - (du[:, 0] * miss[:, 1] - du[:, 1] * miss[:, 0]) / det
        if len(p) == 3:
            weights = np.stack([1 - u - v, u, v], 1)
        else:
            weights = np.stack([(1 - u) * (1 - v), u * (1 - v), u * v, (1 - u) * v], 1)
        converged = np.abs(weights @ p - q).max(1) < CONVERGED
    inside = converged & (weights > -OUTSIDE).all(1)
    return inside, weights
