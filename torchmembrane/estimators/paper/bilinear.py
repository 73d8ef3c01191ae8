"""The paper's flow of the grid's vertices: bilinear interpolation between the dots (section 5).

For any pattern of dots it is a constant matrix. The dots and the fixed rim are triangulated in the grid's own coordinates, and
adjacent triangles that form a convex quadrilateral are joined, the most rectangular pairs first. The interpolation is bilinear
in the quadrilaterals, and linear in the remaining triangles.
"""

import numpy as np
import torch
from scipy.spatial import Delaunay
from torch import Tensor

from ...errors import MembraneError
from ...surface.membrane import Membrane
from ...surface.projection import SurfacePoints
from ..minimum_energy.flow import FlowInterpolation

NEWTON_STEPS = 12
OUTSIDE = 1e-9  # negative weight that still counts as inside a cell
CONVERGED = 1e-6  # largest distance between the interpolated position and the point, grid steps


class BilinearFlow(FlowInterpolation):
    """Interpolates the flow bilinearly between the dots, zero on the rim; lost dots take the flow of `FlowInterpolation`.

    Args:
        membrane: the rest surface on the solver's grid.
        markers: the dots as points on the membrane.

    Raises:
        MembraneError: there are fewer than three dots, or all are on one line.
    """

    bilinear: Tensor

    def __init__(self, membrane: Membrane, markers: SurfacePoints):
        super().__init__(membrane, markers)
        self.register_buffer("bilinear", torch.from_numpy(bilinear_matrix(membrane, markers)))

    def forward(self, displacement: Tensor, confidence: Tensor) -> Tensor:
        """Return the flow `[..., V, 2]` px from `displacement [..., D, 2]` px and `confidence [..., D]` of the dots."""
        smooth = self.completed(displacement, confidence) @ self.influence
        at_dots = torch.where(confidence[..., None, :] > 0, displacement.mT, smooth)
        return (at_dots @ self.bilinear.mT).mT


def bilinear_matrix(membrane: Membrane, markers: SurfacePoints) -> np.ndarray:
    """Return the weights `[V, D]` of the markers' flow at every grid vertex; the flow of the rim is zero and adds nothing.

    Raises:
        MembraneError: the markers cannot be triangulated (all on one line).
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
    """Return quadrilaterals (corners in cyclic order) and triangles that cover the points' convex hull."""
    try:
        mesh = Delaunay(points)
    except Exception as error:
        raise MembraneError(
            f"bilinear_matrix: the markers cannot be triangulated ({error}); expected markers that are not all on one line"
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
    """Return the smallest |sine| of the four corners minus 0.3; negative unless the quadrilateral is clearly convex."""
    edge = np.roll(p, -1, 0) - p
    edge /= np.linalg.norm(edge, axis=1, keepdims=True)
    before = np.roll(edge, 1, 0)
    sines = before[:, 0] * edge[:, 1] - before[:, 1] * edge[:, 0]
    return float((sines * np.sign(sines.sum())).min()) - 0.3


def _weights(p: np.ndarray, q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return which of the points `q [Q, 2]` lie in the cell with corners `p [3 or 4, 2]`, and their interpolation weights."""
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
