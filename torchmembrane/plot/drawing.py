"""Common elements of figures: colours, rows of panels, axes in pixels and lengths, grids as lines, and display.

A figure is a matplotlib `Figure` without a window, so that drawing needs no display.
"""

import numpy as np
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.gridspec import GridSpec

from ..surface.topology import rim_loop

BLUE, VERMILION, GREY = "#0072B2", "#D55E00", "#B8B8B8"  # distinct with any colour vision
Grid = tuple[int, int] | np.ndarray

readable = rc_context({"font.size": 13, "axes.titlesize": 14.5, "axes.titlepad": 9})
"""Decorate a function that draws a figure: its text stays legible at half the page's width."""
ROW = 6.0  # inches, of a row of panels
ABOVE, UNDER = 0.9, 1.3  # of it: the headline and titles of two lines; labels and a legend of two rows
TITLE = 0.6  # inches, of the titles of a further row
SHORT = (-2, 3)  # powers of ten of lengths whose ticks are written in full: a membrane in um or m has its power beside the axis
LINES = 16  # approximate largest number of grid lines drawn in each direction


def show(drawing: Figure) -> None:
    """Show the figure in a window and wait until it is closed."""
    from matplotlib import pyplot

    window = pyplot.figure(figsize=tuple(drawing.get_size_inches()))
    drawing.set_canvas(window.canvas)
    window.canvas.figure = drawing
    pyplot.show()


def panels(count: int, below: float = 0.0, rows: int = 1) -> tuple[Figure, GridSpec]:
    """Return a figure with places for `count` panels in each of its rows, and `below` inches of extra height."""
    panel, between = ROW - ABOVE - UNDER, UNDER + TITLE
    height = rows * panel + (rows - 1) * between + ABOVE + UNDER + below
    drawing = Figure(figsize=(16 * count / 3, height), dpi=100)
    top, bottom = 1 - ABOVE / height, (below + UNDER) / height
    left, right = 0.155 / count, 1 - 0.045 / count
    return drawing, drawing.add_gridspec(
        rows, count, left=left, right=right, top=top, bottom=bottom, wspace=0.2, hspace=between / panel
    )


def image_axes(axes: Axes, size: np.ndarray | tuple[int, int], image: np.ndarray | None) -> None:
    """Set up axes in pixels of an image of `size` (width, height), v downwards, over the image if there is one."""
    width, height = size
    if image is not None:
        axes.imshow(image, cmap="gray", vmin=-1, vmax=1, interpolation="nearest")
    axes.set(xlim=(-0.5, width - 0.5), ylim=(height - 0.5, -0.5), xlabel="u [px]", ylabel="v [px]")
    axes.set_aspect("equal", anchor="N")


def side_axes(axes: Axes, letter: str, unit: str) -> None:
    """Set up the axes of a side view: the axis `letter` to the right, z upwards."""
    axes.set_aspect("equal", anchor="N")
    axes.margins(0.06)
    axes.set(xlabel=f"{letter} [{unit}]", ylabel=f"z, away from the camera [{unit}]")
    axes.ticklabel_format(scilimits=SHORT)
    axes.grid(lw=0.3, alpha=0.5)


def legend_below(axes: Axes) -> None:
    """Place the legend below the axes."""
    narrow = dict(handlelength=1.4, handletextpad=0.5, columnspacing=1.2)
    axes.legend(loc="upper center", bbox_to_anchor=(0.5, 0), borderaxespad=3.4, ncols=2, frameon=False, **narrow)


def few_lines(points: np.ndarray, grid: Grid) -> np.ndarray:
    """Return the points `[V, 2]` of a grid as a lattice `[m, n, 2]` of at most about `LINES` lines in each direction."""
    m, n = (max(1, (size - 1) // LINES) for size in grid)
    return points.reshape(*grid, 2)[::m, ::n]


def mesh_lines(points: np.ndarray, grid: Grid, **style) -> LineCollection:
    """Return the rows and columns of a grid of points `[V, 2]` as lines."""
    lattice = few_lines(points, grid)
    return LineCollection([*lattice, *lattice.swapaxes(0, 1)], **style)


def line_through(vertex: int, X: np.ndarray, grid: Grid, across: int) -> np.ndarray:
    """Return the vertex indices of the row or column through a vertex, whichever runs along the axis `across`."""
    index = np.arange(len(X)).reshape(grid)
    i, j = divmod(vertex, grid[1])
    return max(index[i], index[:, j], key=lambda line: np.ptp(X[line, across]))


def closed_rim(grid: Grid) -> np.ndarray:
    """Return the vertex indices along the grid's border, once around and back to the first.

    Example:
        >>> closed_rim((3, 3)).tolist()
        [0, 3, 6, 7, 8, 5, 2, 1, 0]
    """
    m, n = grid
    return np.append(rim_loop((int(m), int(n))), 0)
