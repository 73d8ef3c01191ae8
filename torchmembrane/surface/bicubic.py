"""Bicubic interpolation of a grid's vertex fields: of fourth order, where linear triangles are of second order.

The displacement of a pressed membrane bends within a few lines of the grid; linear interpolation in a triangle is off by up to
an eighth of its second difference.
"""

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from .projection import SurfacePoints

BEYOND = (3.0, -3.0, 1.0)  # the line beyond the border, from the three at it: quadratic


def bicubic_shares(points: SurfacePoints, grid: tuple[int, int], fixed: Tensor) -> np.ndarray:
    """The shares of the vertices in a field at points of the surface, in the grid's own coordinates.

    Args:
        points: of the grid's triangles.
        grid: `m, n`, at least 3 each.
        fixed: `[V]` bool. Where it is more than the border, a field may have a kink: points near such vertices are linear in
            their triangle.

    Returns:
        `[D, V]`, rows that sum to one; exact for cubics away from the border, for quadratics at it.

    Example:
        >>> points = SurfacePoints(np.array([[0, 4, 5]]), np.array([[0.5, 0.25, 0.25]]), np.zeros(1))
        >>> row, column = np.divmod(np.arange(16.0), 4)
        >>> (bicubic_shares(points, (4, 4), torch.zeros(16, dtype=bool)) @ np.stack([row, row * column], 1)).tolist()
        [[0.5, 0.125]]
    """
    (m, n), rows = grid, np.arange(len(points.vertices))[:, None]
    place = (points.weights[..., None] * np.stack(np.divmod(points.vertices, n), -1)).sum(1)
    shares: np.ndarray = (_along(place[:, 0], m)[:, :, None] * _along(place[:, 1], n)[:, None]).reshape(len(rows), m * n)
    inside = np.zeros((m, n), bool)
    inside[1:-1, 1:-1] = fixed.numpy().reshape(m, n)[1:-1, 1:-1]
    linear = np.zeros_like(shares)
    np.add.at(linear, (rows, points.vertices), points.weights)
    kinked = (abs(shares) @ inside.ravel()) > 0
    shares[kinked] = linear[kinked]
    return shares


class Refinement(nn.Module):
    """Refine fields of a grid to a grid with more lines and the same border, by cubic convolution.

    Args:
        grid: `m, n`.
        finer: the same of the other grid.

    Example:
        >>> Refinement((3, 3), (5, 3))(torch.tensor([0.0, 0, 0, 1, 1, 1, 0, 0, 0])[None, :, None].double())[0, ::3, 0].tolist()
        [0.0, 0.59375, 1.0, 0.59375, 0.0]
    """

    rows: Tensor
    columns: Tensor

    def __init__(self, grid: tuple[int, int], finer: tuple[int, int]):
        super().__init__()
        self.grid = grid
        for name, lines, more in zip(("rows", "columns"), grid, finer, strict=True):
            one = torch.eye(lines, dtype=torch.float64)[None, None]
            self.register_buffer(name, F.interpolate(one, (more, lines), mode="bicubic", align_corners=True)[0, 0])

    def forward(self, field: Tensor) -> Tensor:
        """`[B, V', C]` from `field [B, V, C]`."""
        finer: Tensor = self.rows @ field.unflatten(1, self.grid).permute(0, 3, 1, 2) @ self.columns.mT
        return finer.permute(0, 2, 3, 1).flatten(1, 2)


def _along(place: np.ndarray, count: int) -> np.ndarray:
    """Shares `[D, count]` of the lines of one direction: Lagrange's polynomials of the four around."""
    first = np.clip(np.floor(place).astype(int), 0, count - 2)
    t = place - first
    cubic = -t * (t - 1) * (t - 2) / 6, (t + 1) * (t - 1) * (t - 2) / 2, -(t + 1) * t * (t - 2) / 2, (t + 1) * t * (t - 1) / 6
    shares, rows = np.zeros((len(place), count + 2)), np.arange(len(place))
    for k, share in enumerate(cubic):
        shares[rows, first + k] = share  # a line beyond the border at each end
    for k, share in enumerate(BEYOND):
        shares[:, 1 + k] += share * shares[:, 0]
        shares[:, count - k] += share * shares[:, -1]
    return shares[:, 1:-1]
