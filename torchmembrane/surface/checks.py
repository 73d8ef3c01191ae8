"""Checks of a vertex grid before it becomes a `Membrane`: finite, with a fixed rim, without folds, seen from the inside."""

import numpy as np
from numpy.typing import ArrayLike

from ..errors import MembraneError, is_array

FARTHEST = 1e6
"""Largest coordinate, length unit."""
SMALLEST_AREA = 1e-9  # of a triangle, relative to that of the largest


def checked_grid(vertices: ArrayLike, fixed: ArrayLike | None) -> tuple[np.ndarray, np.ndarray]:
    """Return the vertices of a grid and the mask of the fixed ones as arrays.

    Args:
        vertices: `[m, n, 3]`, length unit.
        fixed: which vertices are fixed, `[m, n]` bool; None for the border.

    Returns:
        Vertices `[m, n, 3]` float64, and which are fixed, `[m, n]` bool.

    Raises:
        MembraneError: a wrong shape, a vertex that is not finite, a free border vertex, or no free vertex.
    """
    if not is_array(vertices):
        raise MembraneError(f"Membrane: vertices are a {type(vertices).__name__}; expected an array [m, n, 3] of numbers")
    X = np.asarray(vertices, dtype=np.float64)
    if X.ndim != 3 or X.shape[2] != 3 or min(X.shape[:2]) < 3:
        raise MembraneError(f"Membrane: vertices of shape {list(X.shape)}; expected [m, n, 3] with m, n >= 3")
    if not np.isfinite(X).all():
        i, j = np.argwhere(~np.isfinite(X).all(-1))[0]
        raise MembraneError(f"Membrane: vertex ({i}, {j}) is not finite; expected finite coordinates")
    if np.abs(X).max() > FARTHEST:
        i, j = np.argwhere(np.abs(X).max(-1) > FARTHEST)[0]
        raise MembraneError(
            f"Membrane: vertex ({i}, {j}) at {X[i, j].tolist()}; expected coordinates up to {FARTHEST:g}, in the length unit"
        )
    border = np.zeros(X.shape[:2], bool)
    border[[0, -1]] = border[:, [0, -1]] = True
    if fixed is None:
        return X, border
    fixed = np.asarray(fixed)
    if fixed.shape != border.shape or fixed.dtype != bool:
        raise MembraneError(
            f"Membrane: fixed is {fixed.dtype} {list(fixed.shape)}; expected bool {list(border.shape)}, one per vertex"
        )
    if not fixed[border].all():
        i, j = np.argwhere(border & ~fixed)[0]
        raise MembraneError(f"Membrane: border vertex ({i}, {j}) is free; expected every border vertex to be fixed (the rim)")
    if fixed.all():
        raise MembraneError("Membrane: every vertex is fixed; expected free vertices inside the rim")
    return X, fixed


def checked_orientation(X: np.ndarray, triangles: np.ndarray, fixed: np.ndarray) -> int:
    """Return which way the triangles face, seen from the camera at the origin.

    Args:
        X: vertices `[V, 3]`.
        triangles: vertex indices of the triangles, `[T, 3]`.
        fixed: which vertices are fixed, `[V]` bool; triangles whose vertices are all fixed are ignored.

    Returns:
        +1 if the triangles already face away from the camera, -1 if all have to be flipped.

    Raises:
        MembraneError: the grid lies behind the camera, a triangle has no area, or the grid folds.
    """
    if X[:, 2].max() <= 0:
        raise MembraneError(
            f"Membrane: the grid lies behind the camera (largest z = {X[:, 2].max():.4g}); expected it at z > 0, "
            "in the camera's frame with +z towards the membrane"
        )
    a, b, c = X[triangles].transpose(1, 0, 2)
    normal = np.cross(b - a, c - a)
    free = ~fixed[triangles].all(1)
    area = np.linalg.norm(normal, axis=1)
    empty = free & (area < SMALLEST_AREA * area.max())
    if empty.any():
        k = np.flatnonzero(empty)[0]
        raise MembraneError(
            f"Membrane: the triangle of vertices {triangles[k].tolist()} has no area; expected distinct vertices"
        )
    facing = np.sign((normal * (a + b + c)).sum(1))[free]
    outward = 1 if facing.sum() >= 0 else -1
    hidden = facing != outward
    if hidden.any():
        k = np.flatnonzero(free)[np.flatnonzero(hidden)[0]]
        raise MembraneError(
            f"Membrane: {hidden.sum()} of {free.sum()} triangles show the camera their outer side, the first one at vertices "
            f"{triangles[k].tolist()}; expected a grid without folds whose inner side is visible to the camera everywhere"
        )
    return outward
