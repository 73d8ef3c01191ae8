"""From a rim to the rest surface: the grid within the rim, the uninflated film, and the inflated sheet."""

from functools import lru_cache
from typing import NamedTuple

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.linalg import splu

from ..errors import MembraneError
from ..surface.resampling import at_equal_steps
from ..surface.topology import grid_triangles
from .inflate import Sheet, inflated_by, inflated_to
from .outline import Outline, outline_of
from .outline_grid import OutlineGrid, outline_grid

LINES = 33  # of the grid on which the rest surface is solved, per side
FILM_STEPS, FILM_SETTLED = 60, 1e-10  # iterations for the film; tolerance of its heights, over the rim's length


class SheetMaterial(NamedTuple):
    """The properties of a sheet that determine its shape: energy and prestretch, without its stiffness.

    Attributes:
        model: "harmonic" | "neo_hookean" | "mooney_rivlin".
        prestretch: prestretch of the sheet in its rim, before inflation.
        c2_ratio: C2 / C1, for "mooney_rivlin" only.
    """

    model: str
    prestretch: float
    c2_ratio: float = 0.0


class Film(NamedTuple):
    """A sheet in a rim, before inflation.

    Attributes:
        outline: the rim.
        cells: the grid within the rim, with its worst cell.
        vertices: vertices of the sheet, `[m, n, 3]`, in the frame of the rim's plane.
    """

    outline: Outline
    cells: OutlineGrid
    vertices: np.ndarray

    @property
    def area(self) -> float:
        """Area of the sheet, length unit squared."""
        a, b, c = self.vertices.reshape(-1, 3)[grid_triangles(self.cells.places.shape)].transpose(1, 0, 2)
        return float(np.linalg.norm(np.cross(b - a, c - a), axis=1).sum()) / 2


class FormedSurface(NamedTuple):
    """A rest surface in equilibrium, in the camera's frame.

    Attributes:
        vertices: vertices of the surface, `[m, n, 3]`.
        sheet: positions of the vertices before inflation, `[m, n, 3]`.
        pressure: equilibrium pressure, over shear modulus x thickness of the sheet, 1 / length.
        height: height of the highest vertex above the rim's plane, length unit.
        outline: the rim.
        cells: the grid within the rim, with its worst cell.
    """

    vertices: np.ndarray
    sheet: np.ndarray
    pressure: float
    height: float
    outline: Outline
    cells: OutlineGrid

    def resampled_to(self, grid: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
        """Return vertices and sheet on another grid, `[*grid, 3]` each, by bicubic interpolation."""
        return _on(self.vertices, grid), _on(self.sheet, grid)


def formed_surface(
    rim: np.ndarray,
    material: SheetMaterial,
    height: float | None = None,
    pressure: float | None = None,
    lines: int = LINES,
) -> FormedSurface:
    """Find the rest surface of a sheet that is stretched in a rim and inflated to a height, or by a pressure.

    Before inflation the sheet is a film of uniform tension, flat if the rim is planar. Results are cached.

    Args:
        rim: points once around the rim, `[K, 3]`, camera's frame.
        material: material of the sheet.
        height: height of the highest point above the rim's plane, along the normal that points away from the camera, length
            unit.
        pressure: pressure, given instead of the height, over shear modulus x thickness of the sheet, 1 / length.
        lines: number of grid lines per side: 9, 17 or 33.

    Returns:
        The `FormedSurface`.

    Raises:
        MembraneError: no grid was found within the rim, or there is no equilibrium at this height or pressure.

    Example:
        >>> from torchmembrane.forming.outline import ellipse
        >>> rim = np.insert(ellipse((40.0, 40.0)), 2, 30.0, axis=1)
        >>> cap = formed_surface(rim, SheetMaterial("neo_hookean", 3.0), height=1.0)
        >>> round(cap.pressure * 20**2 / 2 / (2 * 1.0) / (3**2 - 3**-4), 2)  # 2 T / R, R = a^2 / (2 h), T = mu t (l^2 - l^-4)
        1.0
    """
    rim = np.ascontiguousarray(rim, float)
    return _formed(rim.tobytes(), lines, material, height, pressure)


def film(rim: np.ndarray, lines: int = LINES) -> Film:
    """Find the film of least area in a rim, which is the shape of a sheet before inflation.

    Args:
        rim: points once around the rim, `[K, 3]`, camera's frame.
        lines: number of grid lines per side.

    Raises:
        MembraneError: no grid or no film was found within the rim.
    """
    outline = outline_of(rim)
    cells = outline_grid(outline.points, lines)
    return Film(outline, cells, _film(outline, cells))


@lru_cache(maxsize=16)
def _formed(content: bytes, lines: int, material: SheetMaterial, height: float | None, pressure: float | None) -> FormedSurface:
    outline, cells, vertices = film(np.frombuffer(content).reshape(-1, 3), lines)
    sheet = Sheet(vertices, *material)
    found = inflated_by(sheet, pressure) if height is None and pressure is not None else inflated_to(sheet, height or 0.0)
    vertices, flat = (outline.camera_frame(x) for x in (found.vertices, sheet.vertices))
    for array in (vertices, flat):
        array.flags.writeable = False  # the cached arrays are shared
    return FormedSurface(vertices, flat, found.pressure, found.height, outline, cells)


def _film(outline: Outline, cells: OutlineGrid) -> np.ndarray:
    """Return the film of least area in a rim, `[m, n, 3]`, in the frame of the rim's plane.

    Its heights w solve `div (grad w / sqrt(1 + |grad w|^2)) = 0` on linear triangles, by fixed-point iteration with the root
    from the previous step.
    """
    x, on_rim = cells.vertices.reshape(-1, 2), ~np.isnan(cells.places.ravel())
    w = np.zeros(len(x))
    if outline.is_planar:
        return np.column_stack([x, w]).reshape(*cells.places.shape, 3)
    steps = np.concatenate([[0.0], np.cumsum(outline.steps)]) / outline.length
    w[on_rim] = np.interp(cells.places.ravel()[on_rim] % 1.0, steps, outline.heights[np.r_[: len(outline.heights), 0]])
    triangles = grid_triangles(cells.places.shape)
    triangles = triangles[~on_rim[triangles].all(1)]
    a, b, c = x[triangles].transpose(1, 0, 2)
    double = (b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0]
    gradients = np.stack([c - b, a - c, b - a], 1)[..., ::-1] * [-1.0, 1.0] / double[:, None, None]  # of the hat functions
    rows, columns = np.broadcast_arrays(triangles[:, :, None], triangles[:, None, :])
    free = np.flatnonzero(~on_rim)
    for _ in range(FILM_STEPS):
        slope = np.einsum("tic,ti->tc", gradients, w[triangles])
        weight = double / 2 / np.sqrt(1 + (slope**2).sum(1))
        entries = weight[:, None, None] * (gradients @ gradients.swapaxes(1, 2))
        K = coo_array((entries.ravel(), (rows.ravel(), columns.ravel())), (len(x), len(x))).tocsr()
        before = w[free]
        w[free] = splu(K[free][:, free].tocsc()).solve(-(K[free][:, on_rim] @ w[on_rim]))
        if np.abs(w[free] - before).max() < FILM_SETTLED * outline.length:
            break
    else:
        raise MembraneError(
            "outline: the sheet before inflation (the surface of least area in the rim) was not found in "
            f"{FILM_STEPS} steps; expected a flatter rim: points lie up to {np.abs(outline.heights).max():.3g} off its plane"
        )
    return np.column_stack([x, w]).reshape(*cells.places.shape, 3)


def _on(X: np.ndarray, grid: tuple[int, int]) -> np.ndarray:
    return X if X.shape[:2] == tuple(grid) else at_equal_steps(X, grid)
