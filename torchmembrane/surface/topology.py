"""Topology of the grid: the vertices of its quadrilaterals, its triangles and its rim.

Vertex `(i, j)` of an `m x n` grid has the index `i n + j`. Quadrilateral `(i, j)` has the corners `a = (i, j)`,
`b = (i+1, j)`, `c = (i+1, j+1)`, `d = (i, j+1)`. All quadrilaterals are split along `a c`, because alternating diagonals would
bias the pressure. Corners are gathered, and summed back to vertices, by slices and pads without index arithmetic, which is
cheap in exported models.
"""

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

TRIANGLE_CORNERS = ((0, 1, 2), (0, 2, 3))


def corners(field: Tensor, grid: tuple[int, int]) -> Tensor:
    """Return a vertex field's values at the corners a, b, c, d of every quadrilateral.

    Args:
        field: vertex field `[..., V, C]`.
        grid: `m, n` with `V = m n`.

    Returns:
        `[..., m-1, n-1, 4, C]`.

    Example:
        >>> corners(torch.arange(6)[:, None], (2, 3))[0, 0, :, 0].tolist()
        [0, 3, 4, 1]
    """
    g = field.reshape(*field.shape[:-2], *grid, field.shape[-1])
    return torch.stack([g[..., :-1, :-1, :], g[..., 1:, :-1, :], g[..., 1:, 1:, :], g[..., :-1, 1:, :]], dim=-2)


def corners_to_vertices(values: Tensor, grid: tuple[int, int]) -> Tensor:
    """Sum corner values at every vertex: the adjoint of `corners`.

    Args:
        values: corner values, `[..., m-1, n-1, 4, C]`.
        grid: `m, n`.

    Returns:
        `[..., V, C]`.

    Example:
        >>> corners_to_vertices(torch.ones(1, 2, 4, 1), (2, 3))[:, 0].tolist()
        [1.0, 2.0, 1.0, 1.0, 2.0, 1.0]
    """
    a, b, c, d = values.unbind(-2)
    total = F.pad(a, (0, 0, 0, 1, 0, 1)) + F.pad(b, (0, 0, 0, 1, 1, 0)) + F.pad(c, (0, 0, 1, 0, 1, 0))
    total = total + F.pad(d, (0, 0, 1, 0, 0, 1))
    return total.reshape(*total.shape[:-3], grid[0] * grid[1], total.shape[-1])


def triangles_of(values: Tensor) -> Tensor:
    """Return the corner values of both triangles of every quadrilateral.

    Args:
        values: corner values of the quadrilaterals from `corners`, `[..., 4, C]`.

    Returns:
        `[..., 2, 3, C]`, in the order of `TRIANGLE_CORNERS`.

    Example:
        >>> triangles_of(torch.arange(4)[:, None])[..., 0].tolist()
        [[0, 1, 2], [0, 2, 3]]
    """
    return torch.stack([values[..., 0:3, :], torch.stack([values[..., i, :] for i in (0, 2, 3)], -2)], -3)


def triangles_to_corners(values: Tensor) -> Tensor:
    """Sum the values of both triangles at the corners of their quadrilateral: the adjoint of `triangles_of`.

    Args:
        values: corner values of the triangles, `[..., 2, 3, C]`.

    Returns:
        `[..., 4, C]`.

    Example:
        >>> triangles_to_corners(torch.ones(2, 3, 1))[:, 0].tolist()
        [2.0, 1.0, 2.0, 1.0]
    """
    first, second = values.unbind(-3)
    a, d = first[..., 0, :] + second[..., 0, :], second[..., 2, :]
    return torch.stack([a, first[..., 1, :], first[..., 2, :] + second[..., 1, :], d], -2)


def grid_triangles(grid: tuple[int, int]) -> np.ndarray:
    """Return the vertex indices of all triangles of a grid; the two triangles of a quadrilateral are adjacent.

    Args:
        grid: `m, n`.

    Returns:
        Vertex indices `[2 (m-1) (n-1), 3]`, in the grid's own winding.

    Example:
        >>> grid_triangles((2, 2)).tolist()
        [[0, 2, 3], [0, 3, 1]]
    """
    index = torch.arange(grid[0] * grid[1], device="cpu")[:, None]
    triangles: np.ndarray = triangles_of(corners(index, grid)).reshape(-1, 3).numpy()
    return triangles


def rim_loop(grid: tuple[int, int]) -> np.ndarray:
    """Return the vertices of the grid's border in cyclic order, each once.

    Args:
        grid: `m, n`.

    Returns:
        Vertex indices `[2 (m + n) - 4]`, starting at vertex 0 in the direction `a b`; repeat the first one to close the loop.

    Example:
        >>> rim_loop((3, 3)).tolist()
        [0, 3, 6, 7, 8, 5, 2, 1]
    """
    index = np.arange(grid[0] * grid[1]).reshape(grid)
    return np.concatenate([index[:-1, 0], index[-1, :-1], index[:0:-1, -1], index[0, :0:-1]])
