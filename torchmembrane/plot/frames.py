"""A frame's result in panels: marker flow, surface from the side, map of displacements, map of traction."""

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colorbar import Colorbar
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from matplotlib.transforms import ScaledTranslation
from matplotlib.tri import Triangulation, TriContourSet

from ..results.frame_shapes import of_first_view
from ..results.status import Status
from ..results.store import Mesh
from .drawing import (
    BLUE,
    GREY,
    VERMILION,
    closed_rim,
    few_lines,
    image_axes,
    legend_below,
    line_through,
    mesh_lines,
    panels,
    readable,
    side_axes,
)

DISPLACEMENT_MAP, TRACTION_MAP = "RdBu", "Oranges"  # displacement: inwards red, outwards blue
FORCE_ARROW = 0.2  # of the image's width: a force across the optical axis; shorter when it points along it
MAGNIFICATIONS = (1, 2, 3, 5, 10, 20)
LONGEST_ARROW, LEAST_SCALE = 0.07, 0.002  # of the image's width; of the surface's extent
ARROWS_ACROSS = 22
HIGHER, FULL = (1, 2, 5, 10), 0.85  # times that a side view may be drawn as high; height of a panel over its width
HEADLINE, WIDEST_LETTER = 17, 0.64  # points; of a font's size, in the mean of a headline's letters at most
LABEL_OFF, LOWEST = (34, 44), 62  # points, of a label from its point; its height over it where the image is as high as wide
BAR_BELOW, BAR_HEIGHT, BAR_WIDTH = 0.52, 0.11, 3.8  # inches: of a colour bar, below its axes, whatever the image's shape


@readable
def figure(
    frame: dict[str, np.ndarray], mesh: Mesh, image: np.ndarray | None = None, name: str = "", places: int | None = None
) -> Figure:
    """Draw a frame: flow over the image, side view, displacement along the rest normals and, if forces are known, traction.

    Args:
        frame: arrays of the frame, as `Reconstruction.frame` returns them.
        mesh: the `Mesh` of the results.
        image: image of the frame, `[height, width]` in 0..1, drawn behind the flow; None: no image.
        name: name of the frame, for the title.
        places: number of places for panels, 4 or 3; default: the number of panels. All figures of a film need the same number.

    Returns:
        A figure with three or four panels. For a frame without a surface, it has only the flow, and the reason as its title.

    Example:
        >>> from dataclasses import replace
        >>> from torchmembrane import Reconstructor, Sensor
        >>> from torchmembrane.results.store import Settings
        >>> sensor = Sensor.from_file("examples/sensor.toml")
        >>> reconstructor = Reconstructor(replace(sensor, markers=replace(sensor.markers, rest_image=None)))
        >>> frame = reconstructor.from_pixels(reconstructor.rest_pixels).frame(0)
        >>> drawing = figure(frame, Mesh.from_reconstructor(reconstructor, Settings.from_reconstructor(reconstructor, "npz")))
        >>> [axes.get_title() for axes in drawing.axes[:2]]
        ['Marker flow', 'Surface, seen along x']
    """
    good = bool(np.isfinite(frame["vertices"]).all())
    forces = good and np.any(frame["traction"])
    square = (places or (4 if forces else 3)) == 4
    drawing, grid = panels(2, rows=2) if square else panels(3 if good or places else 2)
    headline = _title(frame, mesh, name)
    fitting = 72 * drawing.get_figwidth() / (WIDEST_LETTER * len(headline))
    colour = "k" if int(frame["status"]) == Status.OK else VERMILION
    drawing.suptitle(headline, fontsize=min(HEADLINE, fitting), color=colour)
    draw_flow(flow := drawing.add_subplot(grid[0] if good else grid[:, :]), frame, mesh, image)
    if good:
        draw_side(drawing.add_subplot(grid[1]), frame, mesh)
        draw_displacement(drawing.add_subplot(grid[2]), frame, mesh)
        if forces:
            draw_traction(drawing.add_subplot(grid[3]), frame, mesh)
    else:
        flow.set_title(_failure(frame), fontsize=12)
    return drawing


def draw_flow(axes: Axes, frame: dict[str, np.ndarray], mesh: Mesh, image: np.ndarray | None = None) -> None:
    """Draw circles at the markers' rest pixels and arrows to their present ones (thinned and magnified if needed); mark lost
    ones."""
    image_axes(axes, mesh.image_size, image)
    rest, now = mesh.rest_pixels[0] if mesh.views else mesh.rest_pixels, of_first_view(frame, "pixels")
    lost = ~np.isfinite(now).all(1)
    rest, flow, gone = rest[~lost], (now - rest)[~lost], rest[lost]
    times, shown = _magnification(flow, mesh.image_size[0]), _thinned(rest, mesh.image_size[0] / ARROWS_ACROSS)
    if len(flow):
        label = f"at rest ({len(flow)}" + (")" if shown.all() else f", {shown.sum()} drawn)")
        axes.plot(*rest[shown].T, "o", ms=5, mfc="none", mec=BLUE, mew=1, label=label)
        axes.quiver(
            *rest[shown].T,
            *(times * flow[shown]).T,
            angles="xy",
            scale_units="xy",
            scale=1,
            color=VERMILION,
            width=0.005,
            headwidth=3.6,
            headlength=4.2,
            headaxislength=3.8,
            minlength=0.3,
            zorder=3,
        )
        label = "moved to" if times == 1 else f"moved, {times} times as long"
        axes.plot([], [], ls="", marker=r"$\rightarrow$", ms=14, color=VERMILION, label=label)
    if len(gone):
        axes.plot(*gone.T, "x", ms=6 if len(gone) < 200 else 3, mec="k", mew=1.3, label=f"lost ({len(gone)})")
    axes.set_title("Marker flow")
    legend_below(axes)


def draw_side(axes: Axes, frame: dict[str, np.ndarray], mesh: Mesh) -> None:
    """Draw the deformed mesh over crosses at the rest vertices, from the side that shows the deepest point."""
    x, X, (m, n) = frame["vertices"], mesh.rest_vertices, mesh.grid
    pressed = _is_pressed(mesh, frame)
    vertex = int(mesh.normal_displacement(frame).argmin()) if pressed else m // 2 * n + n // 2
    across = _side_axis(X, vertex)
    plane, line = [across, 2], line_through(vertex, X, mesh.grid, across)
    axes.plot(*few_lines(X[:, plane], mesh.grid).reshape(-1, 2).T, "+", ms=4, mew=0.7, color=GREY, label="at rest")
    axes.add_collection(mesh_lines(x[:, plane], mesh.grid, color=BLUE, lw=0.5, label="now"))
    axes.plot(*X[line][:, plane].T, "--", color="k", lw=1.2, label="one line at rest")
    axes.plot(*x[line][:, plane].T, "-", color=VERMILION, lw=2.2, label="the same line now")
    if pressed:
        axes.plot(*x[vertex, plane], "o", ms=8, mfc="none", mec="k", mew=1.5)
    side_axes(axes, "xy"[across], mesh.length_unit)
    times = _times_as_high(np.vstack([x, X])[:, plane])
    axes.set_aspect(times, anchor="N")
    axes.set_ylabel(f"z [{mesh.length_unit}]")
    axes.set_title(f"Surface, seen along {'yx'[across]}" + (f", {times} times as high" if times > 1 else ""))
    legend_below(axes)


def _times_as_high(points: np.ndarray) -> int:
    """How many times as high as wide a side view's units are drawn, so that one of a flat sensor fills its panel.

    Args:
        points: `[N, 2]`, of the view.

    Example:
        >>> [_times_as_high(np.array([[0.0, 0.0], [10.0, high]])) for high in (9.0, 4.0, 1.0, 0.0)]
        [1, 2, 5, 10]
    """
    wide, high = np.ptp(points, axis=0)
    return max(times for times in HIGHER if times == 1 or times * high < FULL * wide)


def draw_displacement(axes: Axes, frame: dict[str, np.ndarray], mesh: Mesh) -> None:
    """Draw the displacement along the rest normals at the rest vertices in the image; deepest point o, contacts x."""
    depth, place, unit = mesh.normal_displacement(frame), mesh.vertex_pixels, mesh.length_unit
    limit = max(np.abs(depth).max(), least_displacement(mesh))
    triangulation = Triangulation(place[:, 0], place[:, 1], mesh.triangles)
    marks = MaxNLocator(9, steps=(1, 2, 5, 10), symmetric=True).tick_values(-limit, limit)
    marks = marks[np.abs(marks) < limit]
    levels = np.linspace(-1.001 * limit, 1.001 * limit, 42)
    shades = axes.tricontourf(triangulation, depth, levels=levels, cmap=DISPLACEMENT_MAP)
    lines = marks[np.abs(marks) > 1e-9 * limit]
    axes.tricontour(triangulation, depth, levels=lines, colors="0.4", linewidths=0.6, linestyles="-")
    axes.plot(*place[closed_rim(mesh.grid)].T, color="k", lw=1)
    bar = _colour_bar(axes, shades, marks)
    bar.set_label(f"displacement [{unit}], negative: pressed in")
    image_axes(axes, mesh.image_size, None)
    for point in frame["contact_points"][np.isfinite(frame["contact_points"]).all(1)]:
        nearest = np.linalg.norm(frame["vertices"] - point, axis=1).argmin()
        axes.plot(*place[nearest], "x", ms=10, color="k", mew=2)
    if _is_pressed(mesh, frame):
        deepest, decimals = depth.argmin(), int(-np.floor(np.log10(least_displacement(mesh))))
        axes.plot(*place[deepest], "o", ms=9, mfc="none", mec="k", mew=1.6)
        _annotate(axes, f"{depth[deepest]:+.3g} {unit}", place[deepest], mesh.image_size)
        where = ", ".join(f"{c:.{max(decimals, 0)}f}" for c in frame["vertices"][deepest])
        axes.set_title(f"Deepest at x, y, z = {where} {unit}")
    else:
        axes.set_title(f"Not pressed in by {least_displacement(mesh):.1g} {unit} anywhere")


def draw_traction(axes: Axes, frame: dict[str, np.ndarray], mesh: Mesh) -> None:
    """Draw the compressive normal traction at the rest vertices in the image, contacts x, and the total force as an arrow."""
    compressive, place = -(frame["traction"] * frame["normals"]).sum(1), mesh.vertex_pixels
    levels = np.linspace(0, 1.001 * max(compressive.max(), np.finfo(np.float32).tiny), 32)
    shades = axes.tricontourf(
        Triangulation(place[:, 0], place[:, 1], mesh.triangles), compressive.clip(0), levels=levels, cmap=TRACTION_MAP
    )
    axes.plot(*place[closed_rim(mesh.grid)].T, color="k", lw=1)
    bar = _colour_bar(axes, shades)
    bar.locator = MaxNLocator(4)
    bar.update_ticks()
    bar.set_label(f"compressive normal traction [{_pressure_unit(mesh)}]")
    image_axes(axes, mesh.image_size, None)
    points = frame["contact_points"][np.isfinite(frame["contact_points"]).all(1)]
    nearest = np.linalg.norm(frame["vertices"] - points[:, None], axis=2).argmin(1)
    axes.plot(*place[nearest].T, "x", ms=10, color="k", mew=2)
    force = frame["force"]
    size = np.linalg.norm(force)
    if len(points):
        arrow = FORCE_ARROW * mesh.image_size[0] * force[:2] / size
        axes.annotate("", place[nearest[0]] + arrow, place[nearest[0]], arrowprops=dict(arrowstyle="-|>", color=BLUE, lw=2.5))
    decimals = max(0, int(2 - np.floor(np.log10(size)))) if size > 0 else 0
    components = ", ".join(f"{c:.{decimals}f}" for c in force)
    unit = "relative units\n" if mesh.force_unit == "relative" else f"{mesh.force_unit} "
    axes.set_title(f"Force {size:.{decimals}f} {unit}({components})")


def _pressure_unit(mesh: Mesh) -> str:
    return "relative units" if mesh.force_unit == "relative" else f"{mesh.force_unit}/{mesh.length_unit}²"


def _colour_bar(axes: Axes, shades: TriContourSet, ticks: np.ndarray | None = None) -> Colorbar:
    """Add a flat bar below the axes, of a width independent of theirs."""
    foot = ScaledTranslation(0.5, 0, axes.transAxes)  # type: ignore[arg-type]
    inches = axes.figure.dpi_scale_trans + foot
    place = axes.inset_axes((-BAR_WIDTH / 2, -BAR_BELOW - BAR_HEIGHT, BAR_WIDTH, BAR_HEIGHT), transform=inches)
    bar = axes.figure.colorbar(shades, cax=place, ticks=ticks, orientation="horizontal", format="{x:g}")
    bar.ax.tick_params(labelsize=12)
    return bar


def least_displacement(mesh: Mesh) -> float:
    """Return the displacement below which nothing is marked; the colour scale always covers it."""
    return LEAST_SCALE * float(np.ptp(mesh.rest_vertices, 0).max())


def _is_pressed(mesh: Mesh, frame: dict[str, np.ndarray]) -> bool:
    return bool(mesh.normal_displacement(frame).min() < -least_displacement(mesh))


def _title(frame: dict[str, np.ndarray], mesh: Mesh, name: str) -> str:
    status = int(frame["status"])
    words = [name] * bool(name) + ["ok" if status == Status.OK else "NOT OK: " + Status(status).text.partition(":")[0]]
    if np.isfinite(frame["pressure_change"]):
        words += [
            f"pressure change {mesh.pressure_in_words(float(frame['pressure_change']))}",
            f"residual {frame['residual'].max():.2f} px",
        ]
    return "    ".join(words)


def _failure(frame: dict[str, np.ndarray]) -> str:
    """Return the reason why a frame has no surface, for its headline."""
    _, _, remedy = Status(int(frame["status"])).text.removesuffix("; no surface").partition(": ")
    found = np.atleast_2d(frame["confidence"] > 0).any(0)
    count = f"{found.sum()} of {found.size} markers found"
    return "; ".join(filter(None, ["no surface for this frame", remedy, count]))


def _annotate(axes: Axes, text: str, place: np.ndarray, size: np.ndarray) -> None:
    """Write a label beside a point, on the side where the image has more room."""
    side, up = (-1 if place[0] > size[0] / 2 else 1), (1 if place[1] > size[1] / 2 else -1)
    axes.annotate(
        text,
        tuple(place),
        xytext=(LABEL_OFF[0] * side, min(LABEL_OFF[1], LOWEST * size[1] / size[0]) * up),
        textcoords="offset points",
        ha="left" if side > 0 else "right",
        va="center",
        fontsize=16,
        fontweight="bold",
        arrowprops={"arrowstyle": "-", "lw": 1, "shrinkB": 5},
        bbox={"boxstyle": "round,pad=0.2", "fc": "w", "ec": "none", "alpha": 0.8},
    )


def _magnification(flow: np.ndarray, width: float) -> int:
    """Return the factor by which arrows can be magnified while the longest stay under `LONGEST_ARROW` of the image's width."""
    longest = np.percentile(np.linalg.norm(flow, axis=1), 99) if len(flow) else 0.0
    return max((times for times in MAGNIFICATIONS if times * longest <= LONGEST_ARROW * width), default=1)


def _thinned(pixels: np.ndarray, pitch: float) -> np.ndarray:
    """Return which points to draw, `[D]`: the first one in each cell of `pitch`, or all if few would be omitted."""
    first = np.zeros(len(pixels), bool)
    first[np.unique(pixels // pitch, axis=0, return_index=True)[1]] = True
    return first if first.sum() < 0.6 * len(pixels) else np.ones(len(pixels), bool)


def _side_axis(X: np.ndarray, vertex: int) -> int:
    """Return 0 for a view of x and z, 1 for y and z: the axis along which the vertex is farther from the middle."""
    middle = (X.max(0) + X.min(0)) / 2
    return int(np.abs(X[vertex] - middle)[:2].argmax())
