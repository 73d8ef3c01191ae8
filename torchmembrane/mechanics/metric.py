"""Edges of triangles, their metrics, and constants for derivatives with respect to the metric.

Symmetric 2 x 2 matrices are given by their entries 11, 12, 22.
"""

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from ..solve.stencil import ONE_RING
from ..solve.symmetric_2x2 import symmetric_determinant


def edge_vectors(x: Tensor, grid: tuple[int, int]) -> Tensor:
    """Return the two edges from the first vertex of all triangles, `[..., 3, 2, T]`, of vertices `x [..., V, 3]`."""
    g = x.transpose(-2, -1).contiguous().unflatten(-1, grid)  # with components last in memory it would take three times as long
    a, b, c, d = g[..., :-1, :-1], g[..., 1:, :-1], g[..., 1:, 1:], g[..., :-1, 1:]
    ac = c - a
    return torch.stack([torch.stack([b - a, ac], -3), torch.stack([ac, d - a], -3)], -4).flatten(-3)


def metric(edges: Tensor) -> Tensor:
    """Return the metrics `[..., 3, T]` of pairs of edges `[..., 3, 2, T]`."""
    e1, e2 = edges.split(1, -2)
    return (torch.cat([e1, e1, e2], -2) * torch.cat([e1, e2, e2], -2)).sum(-3)


def adjugate(g: Tensor) -> Tensor:
    """Return the adjugates of symmetric matrices, `[..., 3, T]` each."""
    g11, g12, g22 = g.split(1, -2)
    return torch.cat([g22, -g12, g11], -2)


def determinant(g: Tensor) -> Tensor:
    """Return the determinants `[..., 1, T]` of symmetric matrices `[..., 3, T]`."""
    return symmetric_determinant(*g.split(1, -2))


def metric_constants() -> dict[str, Tensor]:
    """Return constants for second derivatives with respect to the metric's entries 11, 12, 22.

    `twice_12 [3]` counts the off-diagonal entry twice. `bend [9]` are the second derivatives of the determinant.
    `metric_to_pairs [12, 9]` maps second derivatives in the metric to `T_cd` of `ElasticEnergy._pairs`, and `stress_to_pairs
    [3, 3]` maps the stress to `S`, both for the three vertex pairs of a triangle.
    """
    dg = np.zeros((2, 3, 2))  # d g / d e_a = sum_c dg[a, g, c] e_c
    dg[0, 0, 0] = dg[1, 2, 1] = 2.0
    dg[0, 1, 1] = dg[1, 1, 0] = 1.0
    edges = np.einsum("agc,bhd->abcdgh", dg, dg).reshape(2, 2, 4, 9)
    to_pairs = np.stack([-edges.sum(0)[0], -edges.sum(0)[1], edges[0, 1]]).reshape(12, 9)
    return dict(
        twice_12=torch.tensor([1.0, 2.0, 1.0], dtype=torch.float64)[:, None],
        bend=torch.tensor([0.0, 0, 1, 0, -2, 0, 1, 0, 0], dtype=torch.float64)[:, None],
        metric_to_pairs=torch.from_numpy(to_pairs),
        stress_to_pairs=torch.tensor([[-1.0, -1, 0], [0, -1, -1], [0, 1, 0]], dtype=torch.float64),
    )


def tensile_part(stress: Tensor) -> Tensor:
    """Return the positive semi-definite part of symmetric 2 x 2 matrices, `[..., 3, T]`: negative eigenvalues become zero."""
    s11, s12, s22 = stress.split(1, -2)
    mean, half = (s11 + s22) / 2, (s11 - s22) / 2
    radius = (half**2 + s12**2).clamp_min(torch.finfo(stress.dtype).tiny).sqrt()
    high, low = (mean + radius).clamp_min(0), (mean - radius).clamp_min(0)
    centre, ratio = (high + low) / 2, (high - low) / (2 * radius)
    return torch.cat([centre + ratio * half, ratio * s12, centre - ratio * half], -2)


def one_ring_constants() -> dict[str, Tensor]:
    """Return constants for sums over the triangles around a vertex.

    `around [12, 6, 2, 2]` are convolution kernels. Their input planes are the three vertex pairs of the first and second
    triangles of all quadrilaterals. They sum the pairs that lead from a vertex to each neighbour in `ONE_RING`, then those that
    lead from the neighbour to the vertex; the index `transposed [10]` transposes the blocks of the latter. `one [9, 1, 1]` has
    the entries of the unit matrix.
    """
    joins = ((0, 0, 0, 1, 1), (1, 1, 0, 1, 1), (1, 0, 1, 1, 1), (2, 2, 0, 0, 1), (2, 1, 1, 1, 1), (3, 2, 1, 0, 0))
    back = ((0, 2, 1, 1, 0), (3, 0, 0, 0, 1), (4, 1, 0, 0, 0), (4, 0, 1, 0, 0), (5, 2, 0, 0, 0), (5, 1, 1, 1, 0))
    around = torch.zeros(2, len(ONE_RING), 3, 2, 2, 2, dtype=torch.float64)
    for way, found in enumerate((joins, back)):
        for neighbour, pair, triangle, i, j in found:
            around[way, neighbour, pair, triangle, i, j] = 1.0
    order = torch.arange(9).unflatten(0, (3, 3)).T.flatten()
    one = torch.eye(3, dtype=torch.float64).reshape(9, 1, 1)
    return dict(around=around.flatten(0, 1).flatten(1, 2), transposed=torch.cat([order, torch.tensor([9])]), one=one)


def products(a: Tensor, b: Tensor) -> Tensor:
    """Return all products `[..., 9, T]` of an entry of `a [..., 3, T]` and an entry of `b [..., 3, T]`."""
    return (a[..., :, None, :] * b[..., None, :, :]).flatten(-3, -2)


def cell_edges(x: Tensor, grid: tuple[int, int]) -> Tensor:
    """Return the edges of every quadrilateral `a b c d` from `a` to `b`, `c` and `d`, in its triangles `a b c` and `a c d`.

    Args:
        x: vertices `[..., V, 3]`.
        grid: `m, n`.

    Returns:
        Edges and their components, `[..., 3, 3, m-1, n-1]`.
    """
    g = x.mT.unflatten(-1, grid)
    ends = torch.stack([g[..., 1:, :-1], g[..., 1:, 1:], g[..., :-1, 1:]], -4)
    return ends - g[..., None, :, :-1, :-1]


def cell_metric(edges: Tensor) -> Tensor:
    """Return the metrics of both triangles of every quadrilateral, `[..., 3, 2, m-1, n-1]`, from the result of `cell_edges`."""
    square = (edges * edges).sum(-3)
    mixed = (edges[..., :2, :, :, :] * edges[..., 1:, :, :, :]).sum(-3)
    return torch.stack([square[..., :2, :, :], mixed, square[..., 1:, :, :]], -4)


def forces_of_stress(edges: Tensor, stress: Tensor) -> Tensor:
    """Sum the nodal forces of a stress `S` over all triangles, `[..., V, 3]`.

    Every edge `e_i` of a triangle contributes `sum_j S_ij e_j` at its end and the opposite at its start.

    Args:
        edges: edges from `cell_edges`, `[..., 3, 3, m-1, n-1]`.
        stress: entries 11, 12, 22 of `S`, `[..., 3, 2, m-1, n-1]`.
    """
    first, second = edges[..., :2, :, :, :], edges[..., 1:, :, :, :]
    s11, s12, s22 = (s.unsqueeze(-3) for s in stress.unbind(-4))
    at_first, at_second = (s11 * first).addcmul(s12, second), (s12 * first).addcmul(s22, second)
    b, d = at_first[..., 0, :, :, :], at_second[..., 1, :, :, :]
    c = at_second[..., 0, :, :, :] + at_first[..., 1, :, :, :]
    total = F.pad(b, (0, 1, 1, 0)) + F.pad(c, (1, 0, 1, 0)) + F.pad(d, (1, 0, 0, 1)) - F.pad(b + c + d, (0, 1, 0, 1))
    return total.flatten(-2).mT
