"""The picture of the indentation in docs/results.md: a ball pressed aslant into the example's finger, simulated."""

from dataclasses import replace

import numpy as np
import torch
from matplotlib.figure import Figure

import torchmembrane as tm
from torchmembrane.plot.drawing import BLUE, GREY, VERMILION
from torchmembrane.sensor.factories import elastic_energy

RADIUS, DEPTH = 4.0, 2.5  # mm
DIRECTION = (-0.4, 0.0, -0.9)


def pressed_finger() -> tuple[tm.Membrane, tm.Reconstruction]:
    """The rest surface, and what is found of the markers' simulated pixels."""
    sensor = tm.Sensor.from_file("examples/sensor.toml")
    sensor = replace(sensor, membrane=sensor.surface.membrane((33, 33)))
    fine = sensor.surface.membrane((38, 38))
    ball, step = tm.simulate.Sphere(RADIUS).touching(fine, DIRECTION), np.array(DIRECTION) / np.linalg.norm(DIRECTION)
    state = tm.simulate.press(fine, elastic_energy(sensor, fine), [[ball, ball.moved(DEPTH * step)]])
    reconstructor = tm.Reconstructor(sensor)
    on_fine = fine.closest_points(sensor.markers.positions)
    corners = torch.as_tensor(state.vertices)[torch.as_tensor(on_fine.vertices).long()]
    markers = (torch.as_tensor(on_fine.weights)[..., None] * corners).sum(-2)
    with torch.no_grad():
        return sensor.membrane, reconstructor.from_pixels(reconstructor.camera.point_to_pixel(markers.float())[None])


def indentation_figure() -> Figure:
    """Left the section through the middle, right the map from below."""
    membrane, result = pressed_finger()
    fields = membrane.rest, result.vertices[0], membrane.rest_normals
    rest, now, normal = (field.unflatten(0, membrane.grid).numpy() for field in fields)
    depth = result.indentation(membrane)[0].numpy()
    drawing = Figure(figsize=(9, 3.3), dpi=110)
    section, plan = drawing.subplots(
        1, 2, width_ratios=(1.15, 1), gridspec_kw={"left": 0.06, "right": 0.96, "bottom": 0.15, "top": 0.9}
    )
    middle = membrane.grid[1] // 2
    _draw_section(section, *(field[:, middle] for field in (rest, now, normal, depth)))
    across, most = np.moveaxis(rest[..., :2], -1, 0), depth.max()
    shown = plan.pcolormesh(*across, depth, cmap="RdBu_r", vmin=-most, vmax=most, shading="gouraud")
    plan.contour(*across, depth, [0.0], colors=GREY, linewidths=0.8)
    plan.axhline(0, color="0.5", lw=0.8, ls=":")
    plan.set(xlabel="x at rest, mm", ylabel="y at rest, mm", aspect="equal", title="indentation, mm")
    drawing.colorbar(shown, ax=plan, shrink=0.75)
    print(f"deepest {most:.2f} mm, bulge {depth.min():.2f} mm, status {int(result.status[0])}")
    return drawing


def _draw_section(axes, rest, now, normal, depth) -> None:
    """Of a line of vertices `[m, 3]` rest and pressed surface; where a vertex went, and how much of that is indentation."""
    x, z = [0], [2]
    axes.plot(rest[:, x], rest[:, z], color=GREY, lw=1.5, label="rest surface")
    axes.plot(now[:, x], now[:, z], color=BLUE, lw=1.8, label="pressed surface")
    arrows = dict(angles="xy", scale_units="xy", scale=1, width=0.004)
    some = slice(2, -2, 2)
    start, moved, inward = rest[some], (now - rest)[some], -(depth[:, None] * normal)[some]
    axes.quiver(*start[:, ::2].T, *moved[:, ::2].T, color="0.45", label="displacement", **arrows)
    axes.quiver(*start[:, ::2].T, *inward[:, ::2].T, color=VERMILION, label="indentation, along the normal", **arrows)
    axes.set(xlabel="x, mm", ylabel="z, mm", aspect="equal", title="section at y = 0")
    axes.legend(fontsize=8, loc="lower center")
