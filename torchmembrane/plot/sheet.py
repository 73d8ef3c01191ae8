"""The frames of a folder as small maps on one sheet: `view DIR --sheet`."""

from collections.abc import Mapping
from math import ceil, floor, log10

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from matplotlib.tri import Triangulation, TriContourSet

from ..results.reconstruction import Frame
from ..results.status import Status
from ..results.store import Mesh
from .drawing import VERMILION, closed_rim
from .frames import DISPLACEMENT_MAP, least_displacement

ACROSS, HIGHEST = 10, 3.2
"""Frames in a row; inches of a frame's height at most."""
SIDE, TITLE, HEAD, BAR = 1.9, 0.42, 0.35, 0.75
"""Inches: of a frame's width, of its title, of the sheet's title, of the colours below."""
LEVELS, LETTERS = 21, 22
"""Shades of displacement; letters of a name that are shown."""


def sheet_figure(frames: Mapping[str, tuple[Frame, np.ndarray | None]], mesh: Mesh) -> Figure:
    """Draw the displacement along the rest normals of all frames on one colour scale, with force and status.

    Args:
        frames: arrays of each frame, and its image `[height, width]` in 0..1, which is drawn if there is no surface.
        mesh: the data that the frames share.
    """
    across = min(ACROSS, len(frames))
    down, (image_width, image_height) = ceil(len(frames) / across), mesh.image_size.tolist()
    each = min(SIDE * image_height / image_width, HIGHEST)
    width, height = across * (SIDE + 0.12) + 0.2, HEAD + down * (each + TITLE) + BAR
    drawing = Figure(figsize=(width, height), dpi=100)
    depths = {name: mesh.normal_displacement(frame) for name, (frame, _) in frames.items()}
    finite = [np.abs(depth).max() for depth in depths.values() if np.isfinite(depth).all()]
    limit = max([*finite, least_displacement(mesh)])
    hardest = max(
        (float(np.linalg.norm(frame["force"])) for frame, _ in frames.values() if np.isfinite(frame["force"]).all()),
        default=0.0,
    )
    shades, digits = None, max(0, 2 - floor(log10(hardest))) if hardest > 0 else 0
    for number, (name, (frame, image)) in enumerate(frames.items()):
        row, column = divmod(number, across)
        left, low = 0.1 + column * (SIDE + 0.12), height - HEAD - (row + 1) * (each + TITLE)
        axes = drawing.add_axes((left / width, low / height, SIDE / width, each / height))
        shades = _draw(axes, frame, depths[name], mesh, image, limit) or shades
        _name(axes, name, frame, mesh.force_unit, digits)
    if shades is not None:
        place = drawing.add_axes((0.5 - 2 / width, 0.45 / height, 4 / width, 0.12 / height))
        bar = drawing.colorbar(shades, cax=place, orientation="horizontal", format="{x:g}", ticks=MaxNLocator(5))
        bar.set_label(f"displacement [{mesh.length_unit}], negative: pressed in")
    drawing.text(0.5, 1 - 0.24 / height, f"{mesh.name}: {len(frames)} frames", ha="center", fontsize=13)
    return drawing


def _draw(
    axes: Axes, frame: Frame, depth: np.ndarray, mesh: Mesh, image: np.ndarray | None, limit: float
) -> TriContourSet | None:
    """Draw one frame's map, or its image; return the filled contours of the map."""
    width, height = mesh.image_size
    axes.set(xlim=(-0.5, width - 0.5), ylim=(height - 0.5, -0.5), xticks=[], yticks=[])
    if not np.isfinite(depth).all():
        axes.set_facecolor("0.92")
        if image is not None:
            axes.imshow(image, cmap="gray", vmin=0, vmax=1)
        return None
    place = mesh.vertex_pixels
    levels = np.linspace(-1.001 * limit, 1.001 * limit, LEVELS + 1)
    shades = axes.tricontourf(
        Triangulation(place[:, 0], place[:, 1], mesh.triangles), depth, levels=levels, cmap=DISPLACEMENT_MAP
    )
    axes.plot(*place[closed_rim(mesh.grid)].T, color="k", lw=0.6)
    points = frame["contact_points"][np.isfinite(frame["contact_points"]).all(1)]
    nearest = np.linalg.norm(frame["vertices"] - points[:, None], axis=2).argmin(1)
    axes.plot(*place[nearest].T, "x", ms=5, color="k", mew=1)
    return shades


def _name(axes: Axes, name: str, frame: Frame, unit: str, digits: int) -> None:
    """Write the name, the force with `digits` decimals, and the status if it is not ok."""
    status = Status(int(frame["status"]))
    force = float(np.linalg.norm(frame["force"]))
    said = f"{force:.{digits}f} {unit if unit == 'N' else ''}".rstrip() if np.isfinite(force) else "no surface"
    shown = name if len(name) <= LETTERS else f"...{name[3 - LETTERS :]}"
    words = said if status == Status.OK else f"{said}, status {status:d}"
    axes.set_title(f"{shown}\n{words}", fontsize=8, pad=2, color="k" if status == Status.OK else VERMILION, linespacing=1.1)
