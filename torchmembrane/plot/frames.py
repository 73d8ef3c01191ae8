"""Figures: a frame's flow, surface and displacement map; a sensor as it was understood.

Every function returns a matplotlib `Figure` that belongs to no window; `save` writes it.
"""

from pathlib import Path

import numpy as np
import torch
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from ..io.atomic import whole_file
from ..io.status import Status
from ..io.store import Mesh
from ..surface.topology import rim_loop

BLUE, VERMILION, GREY = "#0072B2", "#D55E00", "#B8B8B8"  # distinguishable with any colour vision
PRESSED_IN, PUSH = "RdBu", "Oranges"  # negative (in) red, positive (out) blue
FORCE_ARROW = 0.2  # of the image's width: a force across the optical axis; shorter when it points along it
MAGNIFICATIONS = (1, 2, 3, 5, 10, 20)
LONGEST_ARROW, LEAST_SCALE = 0.07, 0.002
ARROWS_ACROSS, LINES = 22, 16


def figure(frame: dict[str, np.ndarray], mesh: Mesh, image: np.ndarray | None = None, name: str = "") -> Figure:
    """Flow over the image, side view, displacement along the rest normals and, where forces are known, the push.

    Arguments: the frame (`Reconstruction.frame`); the `Mesh` stored beside it; its image `[height, width]` in 0..1 (default:
    none is drawn).
    """
    good = np.isfinite(frame["vertices"]).all()
    forces = good and np.any(frame["traction"])
    drawing, places = _panels(4 if forces else 3)
    drawing.suptitle(_title(frame, mesh, name), fontsize=14, color="k" if good else VERMILION)
    draw_flow(drawing.add_subplot(places[0]), frame, mesh, image)
    if good:
        draw_side(drawing.add_subplot(places[1]), frame, mesh)
        draw_map(drawing.add_subplot(places[2]), frame, mesh)
        if forces:
            draw_push(drawing.add_subplot(places[3]), frame, mesh)
    else:
        _draw_failure(drawing.add_subplot(places[0, 1:]), frame)
    return drawing


def save(drawing: Figure, path: str | Path) -> None:
    """Write a figure as PNG, whole or not at all."""
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    with whole_file(path) as partial:
        drawing.savefig(partial, format="png")


def show(drawing: Figure) -> None:
    """Open a window with the figure and wait until it is closed."""
    from matplotlib import pyplot

    window = pyplot.figure(figsize=drawing.get_size_inches())
    drawing.set_canvas(window.canvas)
    window.canvas.figure = drawing
    pyplot.show()


def draw_flow(axes, frame, mesh: Mesh, image=None) -> None:
    """Circles where markers are at rest, arrows to where they are now (thinned and magnified if need be), lost ones."""
    _image_axes(axes, mesh.image_size, image)
    rest, now = mesh.rest_pixels, frame["pixels"]
    lost = ~np.isfinite(now).all(1)
    rest, flow, gone = rest[~lost], (now - rest)[~lost], rest[lost]
    times, shown = _magnification(flow, mesh.image_size[0]), _thinned(rest, mesh.image_size[0] / ARROWS_ACROSS)
    if len(flow):
        label = f"at rest ({len(flow)}" + (")" if shown.all() else f", {shown.sum()} drawn)")
        axes.plot(*rest[shown].T, "o", ms=5, mfc="none", mec=BLUE, mew=1, label=label)
        axes.quiver(
            *rest[shown].T, *(times * flow[shown]).T, angles="xy", scale_units="xy", scale=1, color=VERMILION,
            width=0.005, headwidth=3.6, headlength=4.2, headaxislength=3.8, minlength=0.3, zorder=3,
        )  # fmt: skip
        label = "moved to" if times == 1 else f"moved to, arrows {times} times as long"
        axes.plot([], [], ls="", marker=r"$\rightarrow$", ms=14, color=VERMILION, label=label)
    if len(gone):
        axes.plot(*gone.T, "x", ms=6 if len(gone) < 200 else 3, mec="k", mew=1.3, label=f"lost ({len(gone)})")
    axes.set_title("Marker flow")
    _legend_below(axes)


def draw_side(axes, frame, mesh: Mesh) -> None:
    """The deformed mesh over crosses at the rest vertices, seen from the side that shows the deepest point."""
    x, X, (m, n) = frame["vertices"], mesh.rest_vertices, mesh.grid
    vertex = mesh.normal_displacement(frame).argmin() if _is_pressed(mesh, frame) else m // 2 * n + n // 2
    across = _side_axis(X, vertex)
    plane, line = [across, 2], _line_through(vertex, X, mesh.grid, across)
    axes.plot(*_few_lines(X[:, plane], mesh.grid).reshape(-1, 2).T, "+", ms=4, mew=0.7, color=GREY, label="at rest")
    axes.add_collection(_mesh_lines(x[:, plane], mesh.grid, color=BLUE, lw=0.5, label="now"))
    axes.plot(*X[line][:, plane].T, "--", color="k", lw=1.2, label="one line at rest")
    axes.plot(*x[line][:, plane].T, "-", color=VERMILION, lw=2.2, label="the same line now")
    if _is_pressed(mesh, frame):
        axes.plot(*x[vertex, plane], "o", ms=8, mfc="none", mec="k", mew=1.5)
    _side_axes(axes, "xy"[across], mesh.length_unit)
    axes.set_title(f"Surface, seen along {'yx'[across]}")
    _legend_below(axes)


def draw_map(axes, frame, mesh: Mesh) -> None:
    """Displacement along the rest normals where the rest vertices are seen in the image; deepest point o, contacts x."""
    depth, place, unit = mesh.normal_displacement(frame), mesh.vertex_pixels, mesh.length_unit
    limit = max(np.abs(depth).max(), _least(mesh))
    marks = MaxNLocator(9, steps=(1, 2, 5, 10), symmetric=True).tick_values(-limit, limit)
    marks = marks[np.abs(marks) < limit]
    levels = np.linspace(-1.001 * limit, 1.001 * limit, 42)
    shades = axes.tricontourf(*place.T, mesh.triangles, depth, levels=levels, cmap=PRESSED_IN)
    lines = marks[np.abs(marks) > 1e-9 * limit]
    axes.tricontour(*place.T, mesh.triangles, depth, levels=lines, colors="0.4", linewidths=0.6, linestyles="-")
    axes.plot(*place[_rim(mesh.grid)].T, color="k", lw=1)
    below = axes.inset_axes([0.05, -0.24, 0.9, 0.04])
    bar = axes.figure.colorbar(shades, cax=below, ticks=marks, orientation="horizontal")
    bar.ax.tick_params(labelsize=8.5)
    bar.set_label(f"displacement along the normal [{unit}], negative: pressed in")
    _image_axes(axes, mesh.image_size, None)
    for point in frame["contact_points"][np.isfinite(frame["contact_points"]).all(1)]:
        nearest = np.linalg.norm(frame["vertices"] - point, axis=1).argmin()
        axes.plot(*place[nearest], "x", ms=10, color="k", mew=2)
    if _is_pressed(mesh, frame):
        deepest, decimals = depth.argmin(), int(-np.floor(np.log10(_least(mesh))))
        axes.plot(*place[deepest], "o", ms=9, mfc="none", mec="k", mew=1.6)
        _annotate(axes, f"{depth[deepest]:+.3g} {unit}", place[deepest], mesh.image_size)
        where = ", ".join(f"{c:.{max(decimals, 0)}f}" for c in frame["vertices"][deepest])
        axes.set_title(f"Deepest at x, y, z = {where} {unit}")
    else:
        axes.set_title(f"Not pressed in by {_least(mesh):.1g} {unit} anywhere")


def draw_push(axes, frame, mesh: Mesh) -> None:
    """Inward traction where the rest vertices are seen in the image; contacts x, and the total force along the image's axes."""
    push, place = -(frame["traction"] * frame["normals"]).sum(1), mesh.vertex_pixels
    largest = max(push.max(), np.finfo(np.float32).tiny)
    shades = axes.tricontourf(*place.T, mesh.triangles, push.clip(0), levels=np.linspace(0, 1.001 * largest, 32), cmap=PUSH)
    axes.plot(*place[_rim(mesh.grid)].T, color="k", lw=1)
    bar = axes.figure.colorbar(shades, cax=axes.inset_axes([0.05, -0.24, 0.9, 0.04]), orientation="horizontal")
    bar.ax.tick_params(labelsize=8.5)
    bar.locator = MaxNLocator(5)
    bar.update_ticks()
    relative = mesh.force_unit == "relative"
    bar.set_label("push on the membrane " + ("(relative)" if relative else f"[{mesh.force_unit}/{mesh.length_unit}²]"))
    _image_axes(axes, mesh.image_size, None)
    points = frame["contact_points"][np.isfinite(frame["contact_points"]).all(1)]
    nearest = np.linalg.norm(frame["vertices"] - points[:, None], axis=2).argmin(1)
    axes.plot(*place[nearest].T, "x", ms=10, color="k", mew=2)
    force = frame["force"]
    size = np.linalg.norm(force)
    if len(points):
        arrow = FORCE_ARROW * mesh.image_size[0] * force[:2] / size
        axes.annotate("", place[nearest[0]] + arrow, place[nearest[0]], arrowprops=dict(arrowstyle="-|>", color=BLUE, lw=2.5))
    components = ", ".join(f"{c:.3g}" for c in force)
    axes.set_title(f"Force {size:.3g}" + ("" if relative else f" {mesh.force_unit}") + f" ({components})")


def _least(mesh: Mesh) -> float:
    """The displacement under which nothing is marked and the colour scale does not shrink."""
    return LEAST_SCALE * np.ptp(mesh.rest_vertices, 0).max()


def _is_pressed(mesh: Mesh, frame) -> bool:
    return mesh.normal_displacement(frame).min() < -_least(mesh)


def _panels(count):
    drawing = Figure(figsize=(16 * count / 3, 6), dpi=100)
    return drawing, drawing.add_gridspec(
        1, count, left=0.135 / count, right=1 - 0.045 / count, top=0.87, bottom=0.19, wspace=0.2
    )


def _title(frame, mesh: Mesh, name: str) -> str:
    status = int(frame["status"])
    words = [name] * bool(name) + ["ok" if status == Status.OK else "NOT OK: " + Status(status).text.partition(":")[0]]
    if np.isfinite(frame["pressure_change"]):
        unit = "(relative)" if mesh.force_unit == "relative" else f"{mesh.force_unit}/{mesh.length_unit}²"
        words += [f"pressure change {frame['pressure_change']:+.3g} {unit}", f"residual {frame['residual']:.2f} px"]
    return "    ".join(words)


def _draw_failure(axes, frame) -> None:
    axes.set_axis_off()
    headline, _, remedy = Status(int(frame["status"])).text.removesuffix("; no surface").partition(": ")
    found = frame["confidence"] > 0
    count = f"{found.sum()} of {found.size} markers found"
    words = {"no surface for this frame": 24, headline: 17, remedy: 13, count: 13}
    for line, (text, size) in enumerate(words.items()):
        axes.text(0.5, 0.68 - 0.1 * line, text, ha="center", fontsize=size, color="k" if line else VERMILION)


def sensor_figure(sensor, reconstructor=None, frame=None) -> Figure:
    """A sensor as it was understood: side view with rays, rest surface in space, what is projected into the rest image.

    Arguments: a `Sensor`; its `Reconstructor` and its rest image's frame, as far as there are.
    """
    drawing, places = _panels(3)
    drawing.suptitle(f"Sensor {sensor.name!r}", fontsize=14)
    X, grid = sensor.membrane.rest.numpy(), sensor.membrane.grid
    markers = sensor.markers.positions if reconstructor is None else reconstructor.rest_markers.cpu().numpy()
    _draw_rays(drawing.add_subplot(places[0]), sensor, X)
    _draw_space(drawing.add_subplot(places[1], projection="3d"), X, grid, markers, sensor.length_unit)
    _draw_projection(drawing.add_subplot(places[2]), sensor, reconstructor, frame)
    return drawing


def _draw_rays(axes, sensor, X) -> None:
    grid, (m, n) = sensor.membrane.grid, sensor.membrane.grid
    across = int(np.ptp(X[:, 1]) > np.ptp(X[:, 0]))
    plane, line = [across, 2], _line_through(m // 2 * n + n // 2, X, grid, across)
    axes.add_collection(_mesh_lines(X[:, plane], grid, color=GREY, lw=0.6))
    ends = X[line[:: max(1, len(line) // LINES)]]
    path = np.stack([np.zeros_like(ends), ends], 1)
    for number, port in enumerate(sensor.camera.ports):
        label = "port" if number == 0 else None
        axes.axhspan(port.distance, port.distance + port.thickness, color=BLUE, alpha=0.2, lw=0, label=label)
        if number == len(sensor.camera.ports) - 1:
            path = np.insert(path, 1, _leaves_port(sensor.camera, ends, port.distance + port.thickness), 1)
    axes.add_collection(LineCollection(path[..., plane], colors=VERMILION, linewidths=0.8))
    axes.plot([], [], color=VERMILION, lw=0.8, label="viewing rays")
    axes.plot(*X[line][:, plane].T, color="k", lw=2, label="rest surface")
    axes.plot(0, 0, "^", ms=11, color="k", label="camera")
    _side_axes(axes, "xy"[across], sensor.length_unit)
    axes.set_title("From the side")
    _legend_below(axes)


def _leaves_port(camera, points, depth: float) -> np.ndarray:
    """Where the rays to points `[N, 3]` cross the plane `z = depth`."""
    with torch.no_grad():
        origin, direction = (a.numpy() for a in camera.pixel_to_ray(camera.point_to_pixel(torch.from_numpy(points))))
    return origin + direction * ((depth - origin[:, 2:]) / direction[:, 2:])


def _draw_space(axes, X, grid, markers, unit: str) -> None:
    axes.plot_wireframe(*X.T.reshape(3, *grid), color=BLUE, lw=0.5, rcount=LINES + 1, ccount=LINES + 1)
    if markers is not None:
        size = 3 if len(markers) < 300 else 1.5
        axes.plot(*np.asarray(markers).T, "o", ms=size, color="k", label=f"markers ({len(markers)})")
        axes.legend(loc="upper center", bbox_to_anchor=(0.5, 0.14), frameon=False)
    axes.set_aspect("equal")
    axes.set_box_aspect(axes.get_box_aspect(), zoom=0.85)
    axes.locator_params(nbins=4)
    axes.set(xlabel=f"x [{unit}]", ylabel=f"y [{unit}]", zlabel=f"z [{unit}]")
    axes.xaxis.labelpad = axes.yaxis.labelpad = 8
    axes.view_init(elev=22, azim=-60)
    axes.set_title("Rest surface")


def _draw_projection(axes, sensor, reconstructor, frame) -> None:
    grid, image = sensor.membrane.grid, sensor.markers.rest_image
    with torch.no_grad():
        pixels = sensor.camera.point_to_pixel(sensor.membrane.rest).numpy()
    _image_axes(axes, sensor.camera.image_size, image)
    axes.add_collection(_mesh_lines(pixels, grid, color=BLUE, lw=0.4))
    axes.plot(*pixels[_rim(grid)].T, color=BLUE, lw=1.8, label="rim and grid, projected")
    if frame is not None:
        place, found = reconstructor.observer.measured_rest.cpu().numpy(), frame["confidence"] > 0
        size, label = 6 if len(found) < 300 else 2.5, f"markers found ({found.sum()})"
        axes.plot(*place[found].T, "o", ms=size, mfc="none", mec=VERMILION, mew=1, label=label)
        if not found.all():
            axes.plot(*place[~found].T, "x", ms=7, mec="k", mew=1.6, label=f"not found ({(~found).sum()})")
    axes.set_title("Rest image" if image is not None else "Image (no rest image)")
    _legend_below(axes)


def _image_axes(axes, size, image) -> None:
    width, height = size
    if image is not None:
        axes.imshow(image, cmap="gray", vmin=-1, vmax=1, interpolation="nearest")
    axes.set(xlim=(-0.5, width - 0.5), ylim=(height - 0.5, -0.5), xlabel="u [px]", ylabel="v [px]")
    axes.set_aspect("equal", anchor="N")


def _side_axes(axes, letter: str, unit: str) -> None:
    axes.set_aspect("equal", anchor="N")
    axes.margins(0.06)
    axes.set(xlabel=f"{letter} [{unit}]", ylabel=f"z, away from the camera [{unit}]")
    axes.grid(lw=0.3, alpha=0.5)


def _legend_below(axes) -> None:
    axes.legend(loc="upper center", bbox_to_anchor=(0.5, 0), borderaxespad=4, ncols=2, frameon=False)


def _annotate(axes, text: str, place, size) -> None:
    """A label beside a point, on the side where the image has more room."""
    side, up = (-1 if place[0] > size[0] / 2 else 1), (1 if place[1] > size[1] / 2 else -1)
    axes.annotate(
        text, place, xytext=(34 * side, 44 * up), textcoords="offset points", ha="left" if side > 0 else "right",
        va="center", fontsize=12, fontweight="bold", arrowprops={"arrowstyle": "-", "lw": 1, "shrinkB": 5},
        bbox={"boxstyle": "round,pad=0.2", "fc": "w", "ec": "none", "alpha": 0.8},
    )  # fmt: skip


def _magnification(flow, width: float) -> int:
    """How much longer arrows may be drawn so that the longest stay under `LONGEST_ARROW` of the image's width."""
    longest = np.percentile(np.linalg.norm(flow, axis=1), 99) if len(flow) else 0.0
    return max((times for times in MAGNIFICATIONS if times * longest <= LONGEST_ARROW * width), default=1)


def _thinned(pixels, pitch: float) -> np.ndarray:
    """Which `[D]` of the points to draw: the first one in every cell of `pitch`, all of them where few would go."""
    first = np.zeros(len(pixels), bool)
    first[np.unique(pixels // pitch, axis=0, return_index=True)[1]] = True
    return first if first.sum() < 0.6 * len(pixels) else np.ones(len(pixels), bool)


def _few_lines(points, grid) -> np.ndarray:
    """Points `[V, 2]` as a lattice `[m, n, 2]` of at most about 17 lines each way."""
    m, n = (max(1, (size - 1) // LINES) for size in grid)
    return points.reshape(*grid, 2)[::m, ::n]


def _mesh_lines(points, grid, **look) -> LineCollection:
    """Rows and columns of a grid of points `[V, 2]`."""
    lattice = _few_lines(points, grid)
    return LineCollection([*lattice, *lattice.swapaxes(0, 1)], **look)


def _line_through(vertex: int, X, grid, across: int) -> np.ndarray:
    """Of the row and the column of a vertex the one that runs along the axis `across`: vertex indices."""
    index = np.arange(len(X)).reshape(grid)
    i, j = divmod(vertex, grid[1])
    return max(index[i], index[:, j], key=lambda line: np.ptp(X[line, across]))


def _rim(grid) -> np.ndarray:
    """Vertex indices once around the grid's border, closed."""
    return np.append(rim_loop(grid), 0)


def _side_axis(X, vertex: int) -> int:
    """0 to look at x and z, 1 for y and z: where the vertex is farther from the middle."""
    middle = (X.max(0) + X.min(0)) / 2
    return int(np.abs(X[vertex] - middle)[:2].argmax())
