"""Resampling of a vertex grid to another number of grid lines, equally spaced along the surface.

scipy.interpolate is slow to import, and is loaded only where a grid is resampled.
"""

import numpy as np

from ..errors import MembraneError

FEWEST = 4  # lines needed for bicubic interpolation
FINE = 40  # samples between two lines, to compute arc lengths


def resampled_grid(X: np.ndarray, fixed: np.ndarray, grid: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    """Resample the surface of a grid on another grid.

    The interpolation is bicubic in the grid's own coordinates, so that the rim stays where it is. The new lines are at equal
    steps of the mean arc length, so that steep sides, where the grid of a file is often coarse, get enough lines.

    Args:
        X: vertices `[m, n, 3]`.
        fixed: which vertices are fixed, `[m, n]` bool.
        grid: number of lines of the new grid in both directions.

    Returns:
        Vertices `[*grid, 3]`, and which are fixed, `[*grid]`: the border, and inner vertices whose nearest vertex in the given
        grid is fixed.

    Raises:
        MembraneError: the given grid has fewer than 4 lines in a direction.
    """
    if min(X.shape[:2]) < FEWEST:
        raise MembraneError(f"Membrane: {X.shape[0]} x {X.shape[1]} lines; expected at least {FEWEST} in each direction")
    lines = even_lines(X, grid[0]), even_lines(X.swapaxes(0, 1), grid[1])
    vertices = on_lines(X, lines)
    rows, columns = (np.rint(line[1:-1]).clip(1, count - 2).astype(int) for line, count in zip(lines, X.shape[:2], strict=True))
    resampled = np.ones(grid, bool)
    resampled[1:-1, 1:-1] = fixed[rows][:, columns]
    return vertices, resampled


def on_lines(X: np.ndarray, lines: tuple[np.ndarray, np.ndarray]) -> np.ndarray:
    """Interpolate a grid's values between its lines, bicubic in the line numbers.

    Args:
        X: values `[m, n, 3]`, at least 4 lines in both directions.
        lines: fractional line numbers of the new lines, `[M]` in 0..m - 1 and `[N]` in 0..n - 1.

    Returns:
        `[M, N, 3]`.

    Example:
        >>> X = np.stack(np.meshgrid(np.arange(4.0), np.arange(5.0), [0.0], indexing="ij"), -1)[:, :, 0]
        >>> on_lines(X, (np.array([1.5]), np.array([0.0, 2.25]))).round(6).tolist()
        [[[1.5, 0.0, 0.0], [1.5, 2.25, 0.0]]]
    """
    from scipy.interpolate import RectBivariateSpline

    m, n = (np.arange(count) for count in X.shape[:2])
    return np.stack([RectBivariateSpline(m, n, X[..., c])(*lines) for c in range(3)], -1)


def at_equal_steps(X: np.ndarray, grid: tuple[int, int]) -> np.ndarray:
    """Interpolate a grid's values `[m, n, 3]` to `[*grid, 3]`, with new lines at equal steps of the line number."""
    m, n = X.shape[:2]
    return on_lines(X, (np.linspace(0, m - 1, grid[0]), np.linspace(0, n - 1, grid[1])))


def even_lines(X: np.ndarray, count: int) -> np.ndarray:
    """Return the fractional line numbers, along the first axis of `X [m, n, 3]`, of `count` lines with equal rms spacing.

    Example:
        >>> x = np.array([0.0, 1.0, 2.0, 4.0, 6.0])
        >>> X = np.stack(np.broadcast_arrays(x[:, None], np.zeros((1, 4)), 5.0), -1)
        >>> even_lines(X, 4).round(1).tolist()
        [0.0, 2.0, 3.0, 4.0]
    """
    from scipy.interpolate import CubicSpline

    fine = np.linspace(0, len(X) - 1, FINE * (len(X) - 1) + 1)
    step = np.diff(CubicSpline(np.arange(len(X)), X)(fine), axis=0)
    length = np.concatenate([[0.0], np.cumsum(((step**2).sum(-1).mean(1)) ** 0.5)])
    return np.interp(np.linspace(0, length[-1], count), length, fine)
