"""A drawing of a sensor: rays from the side, rest surface, markers in the rest image; below them, if tried, its spec sheet."""

from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from ..accuracy.spec_sheet import SpecSheet
from ..camera.model import Camera
from ..sensor.sensor import Sensor
from .accuracy import BELOW, draw_sheet
from .drawing import (
    BLUE,
    GREY,
    LINES,
    SHORT,
    VERMILION,
    closed_rim,
    image_axes,
    legend_below,
    line_through,
    mesh_lines,
    panels,
    readable,
    side_axes,
)

if TYPE_CHECKING:
    from ..reconstruct import Reconstructor

TICKS = 4  # of the longest side of the rest surface in space, at most about


@readable
def sensor_figure(
    sensor: Sensor,
    reconstructor: "Reconstructor | None" = None,
    frame: dict[str, np.ndarray] | None = None,
    sheet: SpecSheet | None = None,
) -> Figure:
    """Side view with rays, rest surface in space, and what is projected into the rest image; below them its spec sheet.

    Args:
        sensor: the sensor.
        reconstructor: its `Reconstructor`, if there is one: its markers are drawn.
        frame: the result of its rest image, if there is one: the markers found are drawn.
        sheet: what to expect of it, if that was tried.

    Returns:
        A figure of three panels, with a sheet four more.

    Example:
        >>> from torchmembrane.presets import preset
        >>> [axes.get_title() for axes in sensor_figure(preset("bubble")).axes]
        ['From the side', 'Rest surface, markers (185)', 'Rest image']
    """
    drawing, places = panels(max(3, 2 + len(sensor.views)), 0.0 if sheet is None else BELOW)
    drawing.suptitle(f"Sensor {sensor.name!r}", fontsize=17)
    X, grid = sensor.membrane.rest.numpy(), sensor.membrane.grid
    markers = sensor.markers.positions if reconstructor is None else reconstructor.rest_markers.cpu().numpy()
    _draw_rays(drawing.add_subplot(places[0]), sensor, X)
    _draw_space(drawing.add_subplot(places[1], projection="3d"), X, grid, markers, sensor.length_unit)
    for number in range(max(1, len(sensor.views))):
        found = None if reconstructor is None or frame is None else _found(reconstructor, frame, number)
        _draw_projection(drawing.add_subplot(places[2 + number]), sensor, number, found)
    if sheet is not None:
        draw_sheet(drawing, sheet)
    return drawing


def _draw_rays(axes: Axes, sensor: Sensor, X: np.ndarray) -> None:
    grid, (m, n) = sensor.membrane.grid, sensor.membrane.grid
    across = int(np.ptp(X[:, 1]) > np.ptp(X[:, 0]))
    plane, line = [across, 2], line_through(m // 2 * n + n // 2, X, grid, across)
    axes.add_collection(mesh_lines(X[:, plane], grid, color=GREY, lw=0.6))
    ends = X[line[:: max(1, len(line) // LINES)]]
    path = np.stack([np.zeros_like(ends), ends], 1)
    for number, port in enumerate(sensor.camera.ports):
        label = "port" if number == 0 else None
        axes.axhspan(port.distance, port.distance + port.thickness, color=BLUE, alpha=0.2, lw=0, label=label)
        if number == len(sensor.camera.ports) - 1:
            path = np.insert(path, 1, _leaves_port(sensor.camera, ends, port.distance + port.thickness), 1)
    axes.add_collection(LineCollection([*path[..., plane]], colors=VERMILION, linewidths=0.8))
    axes.plot([], [], color=VERMILION, lw=0.8, label="viewing rays")
    axes.plot(*X[line][:, plane].T, color="k", lw=2, label="rest surface")
    axes.plot(0, 0, "^", ms=11, color="k", label="camera")
    for view in sensor.views[1:]:
        axes.plot(*view.pose.translation[plane], "^", ms=11, mfc="none", color="k", label=f"view {view.name}")
    side_axes(axes, "xy"[across], sensor.length_unit)
    axes.set_title("From the side")
    legend_below(axes)


def _leaves_port(camera: Camera, points: np.ndarray, depth: float) -> np.ndarray:
    """Return where the rays to points `[N, 3]` cross the plane `z = depth`."""
    with torch.no_grad():
        origin, direction = (a.numpy() for a in camera.pixel_to_ray(camera.point_to_pixel(torch.from_numpy(points))))
    return origin + direction * ((depth - origin[:, 2:]) / direction[:, 2:])


def _draw_space(axes: Any, X: np.ndarray, grid: tuple[int, int], markers: np.ndarray | None, unit: str) -> None:
    """Draw the rest surface and its markers `[D, 3]` on three-dimensional axes."""
    axes.plot_wireframe(*X.T.reshape(3, *grid), color=BLUE, lw=0.5, rcount=LINES + 1, ccount=LINES + 1)
    title = "Rest surface"
    if markers is not None:
        axes.plot(*np.asarray(markers).T, "o", ms=3 if len(markers) < 300 else 1.5, color="k")
        title += f", markers ({len(markers)})"
    axes.set_aspect("equal")
    axes.set_box_aspect(axes.get_box_aspect(), zoom=0.85)
    for axis, extent in zip((axes.xaxis, axes.yaxis, axes.zaxis), np.ptp(X, 0) / np.ptp(X, 0).max(), strict=True):
        axis.set_major_locator(MaxNLocator(max(1, round(TICKS * extent))))  # as many as a short side has room for
        axis.get_major_formatter().set_powerlimits(SHORT)
    axes.set(xlabel=f"x [{unit}]", ylabel=f"y [{unit}]", zlabel=f"z [{unit}]")
    axes.xaxis.labelpad = axes.yaxis.labelpad = 8
    axes.view_init(elev=22, azim=-60)
    axes.set_title(title)


def _found(reconstructor: "Reconstructor", frame: dict[str, np.ndarray], view: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the pixels of a view's markers in its rest image, `[D, 2]`, and which of them are found, `[D]` bool."""
    observer = reconstructor.observer
    place = observer.by_view(observer.measured_rest[None]).reshape(-1, *reconstructor.rest_markers.shape[:1], 2)
    return place[view].cpu().numpy(), frame["confidence"].reshape(len(place), -1)[view] > 0


def _draw_projection(axes: Axes, sensor: Sensor, view: int, markers: tuple[np.ndarray, np.ndarray] | None) -> None:
    """Draw a view's rest image with the grid and its markers as returned by `_found`."""
    name, sensor = sensor.views[view].name if sensor.views else "", sensor.in_view(view)
    grid, image = sensor.membrane.grid, sensor.markers.rest_image
    with torch.no_grad():
        pixels = sensor.camera.point_to_pixel(sensor.membrane.rest).numpy()
    image_axes(axes, sensor.camera.image_size, image)
    axes.add_collection(mesh_lines(pixels, grid, color=BLUE, lw=0.4))
    axes.plot(*pixels[closed_rim(grid)].T, color=BLUE, lw=1.8, label="rim and grid")
    if markers is not None:
        place, found = markers
        size, label = 6 if len(found) < 300 else 2.5, f"markers found ({found.sum()})"
        axes.plot(*place[found].T, "o", ms=size, mfc="none", mec=VERMILION, mew=1, label=label)
        if not found.all():
            axes.plot(*place[~found].T, "x", ms=7, mec="k", mew=1.6, label=f"not found ({(~found).sum()})")
    axes.set_title(("Rest image" if image is not None else "Image (no rest image)") + f" of view {name}" * bool(name))
    legend_below(axes)
