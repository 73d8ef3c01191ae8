"""Bicubic interpolation of vertex fields on a grid: fourth-order accurate, where linear triangles are second-order accurate.

The displacement of a pressed membrane curves strongly within a few grid lines; the error of linear interpolation in a triangle
is up to an eighth of its second difference.
"""

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from .projection import SurfacePoints

BEYOND = (3.0, -3.0, 1.0)  # weights of the three outermost lines in a quadratic extrapolation to the line beyond the border


def bicubic_shares(points: SurfacePoints, grid: tuple[int, int], fixed: Tensor) -> np.ndarray:
    """Return the weights of the vertices that interpolate a field at points of the surface, bicubic in the grid's coordinates.

    Args:
        points: points on the grid's triangles.
        grid: `m, n`, at least 3 each.
        fixed: which vertices are fixed, `[V]` bool. A field may have a kink at fixed vertices inside the border; points near
            them are interpolated linearly in their triangle.

    Returns:
        `[D, V]`, rows that sum to one. Interpolation is exact for cubics away from the border, for quadratics at the border.

    Example:
        >>> points = SurfacePoints(np.array([[0, 4, 5]]), np.array([[0.5, 0.25, 0.25]]), np.zeros(1))
        >>> row, column = np.divmod(np.arange(16.0), 4)
        >>> (bicubic_shares(points, (4, 4), torch.zeros(16, dtype=bool)) @ np.stack([row, row * column], 1)).tolist()
        [[0.5, 0.125]]
    """
    (m, n), place = grid, grid_coordinates(points, grid)
    shares = _products(_along(place[:, 0], m), _along(place[:, 1], n))
    kinked = _is_kinked(shares, grid, fixed)
    shares[kinked] = _linear(points.vertices, points.weights, m * n)[kinked]
    return shares


def bicubic_slopes(points: SurfacePoints, grid: tuple[int, int], fixed: Tensor) -> np.ndarray:
    """Return the weights of the vertices that give a field's derivatives at points of the surface in both grid coordinates.

    Args:
        points: as for `bicubic_shares`.
        grid: as for `bicubic_shares`.
        fixed: as for `bicubic_shares`.

    Returns:
        `[2, D, V]`, rows that sum to zero: the derivatives of the interpolation by `bicubic_shares` with respect to the row and
        column number.

    Example:
        >>> points = SurfacePoints(np.array([[0, 4, 5]]), np.array([[0.5, 0.25, 0.25]]), np.zeros(1))
        >>> row, column = np.divmod(np.arange(16.0), 4)
        >>> (bicubic_slopes(points, (4, 4), torch.zeros(16, dtype=bool)) @ (row * column)).round(9).tolist()
        [[0.25], [0.5]]
    """
    (m, n), place = grid, grid_coordinates(points, grid)
    rows, columns = _along(place[:, 0], m), _along(place[:, 1], n)
    along_rows = _products(_along(place[:, 0], m, slopes=True), columns)
    slopes = np.stack([along_rows, _products(rows, _along(place[:, 1], n, slopes=True))])
    kinked = _is_kinked(abs(slopes).sum(0), grid, fixed)
    flat = [_linear(points.vertices, weights, m * n) for weights in triangle_slopes(points, grid)]
    slopes[:, kinked] = np.stack(flat)[:, kinked]
    return slopes


def grid_coordinates(points: SurfacePoints, grid: tuple[int, int]) -> np.ndarray:
    """Return the fractional row and column of points of the surface, `[D, 2]`."""
    place: np.ndarray = (points.weights[..., None] * np.stack(np.divmod(points.vertices, grid[1]), -1)).sum(1)
    return place


def triangle_slopes(points: SurfacePoints, grid: tuple[int, int]) -> np.ndarray:
    """Return the weights `[2, D, 3]` of the triangles' corners that give the derivatives of a field linear in each triangle."""
    corners = np.stack(np.divmod(points.vertices, grid[1]), -1).astype(float)
    inverse = np.linalg.inv(corners[:, 1:] - corners[:, :1])
    slopes: np.ndarray = np.concatenate([-inverse.sum(-1, keepdims=True), inverse], -1).swapaxes(0, 1)
    return slopes


def _products(rows: np.ndarray, columns: np.ndarray) -> np.ndarray:
    """Return the weights `[D, m n]` of the vertices: products of the weights of the grid lines in both directions."""
    products: np.ndarray = (rows[:, :, None] * columns[:, None]).reshape(len(rows), -1)
    return products


def _is_kinked(shares: np.ndarray, grid: tuple[int, int], fixed: Tensor) -> np.ndarray:
    """Return which points depend on fixed vertices inside the border, `[D]` bool."""
    m, n = grid
    inside = np.zeros((m, n), bool)
    inside[1:-1, 1:-1] = fixed.numpy().reshape(m, n)[1:-1, 1:-1]
    kinked: np.ndarray = (abs(shares) @ inside.ravel()) > 0
    return kinked


def _linear(vertices: np.ndarray, weights: np.ndarray, count: int) -> np.ndarray:
    """Return weights `[D, count]` of all vertices, given the weights `[D, 3]` of the triangles' corners."""
    linear = np.zeros((len(vertices), count))
    np.add.at(linear, (np.arange(len(vertices))[:, None], vertices), weights)
    return linear


class Refinement(nn.Module):
    """Interpolate fields of a grid to a finer grid with the same border, by cubic convolution.

    Args:
        grid: `m, n` of the given grid.
        finer: `m, n` of the finer grid.

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
        """Return the field `[B, V', C]` on the finer grid from `field [B, V, C]`."""
        finer: Tensor = self.rows @ field.unflatten(1, self.grid).permute(0, 3, 1, 2) @ self.columns.mT
        return finer.permute(0, 2, 3, 1).flatten(1, 2)


def _along(place: np.ndarray, count: int, slopes: bool = False) -> np.ndarray:
    """Return the weights `[D, count]` of the grid lines in one direction: the Lagrange polynomials of the four lines around a
    point, or their derivatives."""
    first = np.clip(np.floor(place).astype(int), 0, count - 2)
    t = place - first
    cubic = -t * (t - 1) * (t - 2) / 6, (t + 1) * (t - 1) * (t - 2) / 2, -(t + 1) * t * (t - 2) / 2, (t + 1) * t * (t - 1) / 6
    if slopes:
        outer, inner = -(3 * t**2 - 6 * t + 2) / 6, (3 * t**2 - 4 * t - 1) / 2
        cubic = outer, inner, -(3 * t**2 - 2 * t - 2) / 2, (3 * t**2 - 1) / 6
    shares, rows = np.zeros((len(place), count + 2)), np.arange(len(place))
    for k, share in enumerate(cubic):
        shares[rows, first + k] = share  # with one extra line beyond the border at each end
    for k, share in enumerate(BEYOND):
        shares[:, 1 + k] += share * shares[:, 0]
        shares[:, count - k] += share * shares[:, -1]
    return shares[:, 1:-1]
