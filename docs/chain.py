"""Pictures of docs/paper_chain.md, drawn from what the page's own code makes when it is run."""

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import torch
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from panels import draw_contacts, draw_field, draw_flow, draw_image, draw_surface
from pressed import Shown, contact_words

from torchmembrane.plot.drawing import BLUE, GREY, VERMILION
from torchmembrane.simulate.quasi_static import carried
from torchmembrane.solve.grid_system import UPPER

PAGE = Path(__file__).with_name("paper_chain.md")
CROSSES, LONGER = 4, 6.0  # every so many quadrilaterals a cross; how many times its change is drawn
CLOSE_UP = (235, 415, 325, 155)  # px: left, right, lower, upper
SOME_ROWS = 2  # rows of quadrilaterals of which Q is shown


def page_names() -> dict[str, Any]:
    """What the page's code has defined after it ran."""
    names: dict[str, Any] = {}
    code = "\n".join(re.findall(r"```python\n(.*?)```", PAGE.read_text(), re.S))
    exec(compile(code, PAGE.name, "exec"), names)
    return names


def chain_figures() -> Iterator[tuple[str, Figure]]:
    names = page_names()
    dots, rest = names["dots"], names["simulator"].rest_dots
    arrays = (rest.positions, dots.positions, dots.pixels, names["truth"].contact_points)
    shown = Shown("fingertip", names["grey"][0, 0].numpy(), *(np.asarray(a) for a in arrays))
    for part, draw in {
        "dots": dots_figure,
        "flow": flow_figure,
        "maps": maps_figure,
        "q": q_figure,
        "solve": solve_figure,
        "contacts": contacts_figure,
        "surface": surface_figure,
    }.items():
        yield part, draw(names, shown)


def row_of_panels(count: int, height: float = 4.4) -> tuple[Figure, list]:
    drawing = Figure(figsize=(11, 0.78 * height), dpi=100, layout="constrained")
    return drawing, list(drawing.subplots(1, count))


def dots_figure(names: dict, shown: Shown) -> Figure:
    """Large dots found, small ones predicted from them, all refined."""
    drawing, (a, b, c) = row_of_panels(3)
    locator, rest = names["locator"], names["reconstructor"].rest_pixels.numpy()
    at_rest, large = rest[locator.large], names["large"][0].numpy()
    draw_image(a, shown.image, "large dots, grown from the rim inwards")
    a.add_collection(LineCollection(np.stack([at_rest, large], 1), colors=VERMILION, linewidths=1))
    a.plot(*large.T, "o", ms=9, mfc="none", mec=VERMILION, label="found")
    true, small = shown.pixels[locator.small], {"predicted": names["predicted"], "found": names["small"]}
    draw_image(b, shown.image, "small dots, predicted from the large ones around them")
    marks, words = {"predicted": ("s", BLUE), "found": ("+", VERMILION)}, []
    for what, place in small.items():
        b.plot(*place[0].numpy().T, marks[what][0], ms=6, mfc="none", mec=marks[what][1], mew=1, label=what)
        words.append(f"{what} {np.median(np.linalg.norm(place[0].numpy() - true, axis=1)):.2f} px off")
    b.set_xlabel("\n".join(words) + " in the median, on a coarse level", fontsize=10)
    draw_image(c, shown.image, "all refined, close up")
    found = rest + names["u"][0].numpy()
    c.plot(*shown.pixels.T, "o", ms=9, mfc="none", mec=BLUE, label="true")
    c.plot(*found.T, "+", ms=9, mec=VERMILION, mew=1.3, label="found")
    c.set(xlim=CLOSE_UP[:2], ylim=CLOSE_UP[2:])
    off = np.linalg.norm(found - shown.pixels, axis=1)
    c.set_xlabel(f"{np.median(off):.3f} px off in the median,\n{off.max():.2f} at most; against the rest image", fontsize=10)
    for axes in (a, b, c):
        axes.legend(fontsize=8, loc="lower left")
    return drawing


def flow_figure(names: dict, shown: Shown) -> Figure:
    drawing, (a, b) = row_of_panels(2, 6.2)
    r, blank = names["reconstructor"], np.ones_like(shown.image)
    draw_flow(a, 0.6 + 0.4 * shown.image, r.rest_pixels.numpy(), names["u"][0].numpy(), "at the 119 dots", 0.003)
    m, n = names["membrane"].grid
    every = np.arange(m * n).reshape(m, n)[::2, ::2].ravel()
    place, flow = r.vertex_pixels.numpy()[every], names["flow"][0].numpy()[every]
    draw_flow(b, blank, place, flow, "bilinear at the grid (every second vertex)", 0.003)
    return drawing


def draw_quadrilaterals(drawing: Figure, axes, names: dict, values: np.ndarray, title: str) -> None:
    """Values `[m-1, n-1]` on the quadrilaterals, where they are seen at rest."""
    place = names["reconstructor"].vertex_pixels.numpy().reshape(*names["membrane"].grid, 2)
    limit = np.abs(values).max()
    draw_image(axes, np.ones(names["grey"].shape[-2:]), title)
    mesh = axes.pcolormesh(*np.moveaxis(place, -1, 0), values, cmap="RdBu_r", vmin=-limit, vmax=limit)
    drawing.colorbar(mesh, ax=axes, shrink=0.8)


def maps_figure(names: dict, shown: Shown) -> Figure:
    """Change of area of the local affine maps, in the image and in space, with crosses of the image's maps."""
    drawing, (a, b) = row_of_panels(2, 5.4)
    A, estimator = names["A"][0], names["estimator"]
    draw_quadrilaterals(drawing, a, names, (torch.linalg.det(A) - 1).numpy(), "in the image: change of area, det A - 1")
    place = names["reconstructor"].vertex_pixels.numpy().reshape(*names["membrane"].grid, 2)
    centre = (place[:-1, :-1] + place[1:, :-1] + place[1:, 1:] + place[:-1, 1:]) / 4
    half = 0.3 * CROSSES * float(np.linalg.norm(np.diff(centre[16], axis=0), axis=1).mean())
    axes_of = np.eye(2) + LONGER * (A.numpy() - np.eye(2))
    for way in range(2):
        arm = half * axes_of[..., way]
        lines = np.stack([centre - arm, centre + arm], -2)[CROSSES // 2 :: CROSSES, CROSSES // 2 :: CROSSES].reshape(-1, 2, 2)
        a.add_collection(LineCollection(lines, colors="k", linewidths=0.9))
    a.set_xlabel(f"crosses: A's columns, its difference from 1 drawn {LONGER:.0f} times", fontsize=10)
    stretches = torch.linalg.svdvals(estimator.energy.affine_maps(names["result"].vertices[0]))
    area = (stretches.prod(-1) - 1).numpy()
    draw_quadrilaterals(drawing, b, names, area, "in space, of the surface found in the end: change of area")
    least, largest = float(stretches.min()), float(stretches.max())
    b.set_xlabel(f"principal stretches from {least:.3f} to {largest:.3f}", fontsize=10)
    return drawing


def stencil_table(axes, values: np.ndarray, title: str) -> None:
    """Entries `[5, 5]` of one row of a matrix on the grid around its vertex."""
    limit = np.abs(values).max()
    axes.imshow(values, cmap="RdBu_r", vmin=-limit, vmax=limit)
    for (i, j), value in np.ndenumerate(values):
        if abs(value) > 1e-12:
            axes.text(
                j, i, f"{value:.3f}", ha="center", va="center", fontsize=9, color="k" if abs(value) < 0.6 * limit else "w"
            )
    axes.set_title(title, fontsize=10)
    axes.set_xticks([])
    axes.set_yticks([])


def q_figure(names: dict, shown: Shown) -> Figure:
    """Q's sparsity, and the rows of `Q^T Q` and of the whole matrix around one vertex."""
    drawing, (a, b, c) = row_of_panels(3, 4.8)
    m, n = names["membrane"].grid
    Q, K, M = (names[key].numpy() for key in ("Q", "K", "M"))
    rows, columns = 6 * (n - 1) * SOME_ROWS, n * (SOME_ROWS + 1)
    a.spy(np.abs(Q[:rows, :columns]) > 0, markersize=0.8, color=BLUE, aspect="auto")
    a.set_title(f"Q: rows of the first {SOME_ROWS} of {m - 1} rows of quadrilaterals", fontsize=10)
    a.set_xlabel("column: range of a vertex", fontsize=10)
    a.set_ylabel("row: six for each quadrilateral", fontsize=10)
    a.xaxis.set_ticks_position("bottom")
    at = next(k for k in names["membrane"].free_vertices.tolist() if not names["relaxed"][0, k] and k >= (m // 2) * n + 6)
    around = at + np.arange(-2, 3)[:, None] * n + np.arange(-2, 3)
    stencil_table(b, K[at, around], f"$Q^TQ$ around vertex {at}")
    stencil_table(c, M[at, around], "with the smoother: 13 points")
    blocks, directions = names["estimator"].energy.q_blocks, names["directions"]
    local = names["estimator"].energy.stiffness_along(names["membrane"].rest, directions)
    gap = float((blocks(directions).mT @ blocks(directions) - local).abs().max() / local.abs().max())
    b.set_xlabel(f"differs from the element's K by {gap:.0e}", fontsize=10)
    kept, inner = names["programme"].stencil[0].numpy(), names["membrane"].free_vertices.tolist()
    column = inner.index(at)
    gap = max(abs(kept[k, column] - M[at, at + i * n + j]) for k, (i, j) in enumerate(UPPER)) / M[at, at]
    c.set_xlabel(f"differs from the stencil in the solve by {gap:.0e}", fontsize=10)
    return drawing


def true_on_grid(names: dict) -> np.ndarray:
    """Where the vertices of the estimator's grid truly are, `[V, 3]`."""
    return np.asarray(carried(names["truth"].vertices, names["simulator"].membrane, names["membrane"].rest))


def solve_figure(names: dict, shown: Shown) -> Figure:
    """The KKT solution: displacement along the rays, beside the true one."""
    drawing, (a, b, c) = row_of_panels(3)
    membrane, (origins, along) = names["membrane"], (names["origins"][0].numpy(), names["directions"][0].numpy())
    psi = np.zeros(len(membrane.rest))
    psi[membrane.free_vertices] = names["psi"][0].numpy()
    true = ((true_on_grid(names) - origins) * along).sum(1) - names["estimator"].rest_range.numpy()
    for axes, values, title in ((a, psi, "$\\psi$ found, mm"), (b, true, "true $\\psi$, mm")):
        drawing.colorbar(draw_field(axes, shown, values, title), ax=axes, shrink=0.8)
        axes.set_xlabel(f"from {values.min():.3f} to {values.max():.3f} mm", fontsize=10)
    n = membrane.grid[1]
    line = np.arange(len(psi)).reshape(-1, n)[:, n // 2]
    x = membrane.rest.numpy()[line, 0]
    c.plot(x, true[line], color=VERMILION, label="true")
    c.plot(x, psi[line], color=BLUE, label="found")
    c.axhline(0, color=GREY, lw=0.8)
    c.set_title("along the grid's line at y = 0", fontsize=10)
    c.set_xlabel("x at rest, mm", fontsize=10)
    c.set_ylabel("$\\psi$, mm", fontsize=10)
    c.legend(fontsize=8)
    found, truth = float(names["pressure"] - names["estimator"].rest_pressure), names["truth"]
    rise = float(truth.pressure - truth.rest_pressure)
    drawing.supxlabel(f"pressure change found {1e3 * found:+.2f} kPa, true {1e3 * rise:+.2f} kPa", fontsize=10)
    return drawing


def contacts_figure(names: dict, shown: Shown) -> Figure:
    """Regions of eq. 29, and those of the surface after the loop."""
    drawing, panels = row_of_panels(2, 5.6)
    titles = ("first: regions that bulge in by eq. 29", "after the loop: regions of the surface found, along the normals")
    for axes, regions, title in zip(panels, (names["first"], names["loop"].contacts), titles, strict=True):
        points = regions.points[0].numpy()
        values = regions.bulge[0].numpy() * (regions.region[0].numpy() > 0)
        draw_contacts(axes, shown, values, points, title, contact_words(points, shown.contacts))
    return drawing


def surface_figure(names: dict, shown: Shown) -> Figure:
    """The surface found from the side, with the true dots, and a section beside the truth."""
    drawing, (a, b) = row_of_panels(2, 5.0)
    draw_surface(a, shown, names["result"], 0, "the paper's surface, from the side")
    membrane = names["membrane"]
    line = np.arange(len(membrane.rest)).reshape(membrane.grid)[:, membrane.grid[1] // 2]
    surfaces = {
        "at rest": (membrane.rest.numpy(), {"color": "k", "ls": "--", "lw": 0.8}),
        "true": (true_on_grid(names), {"color": VERMILION, "lw": 2.2}),
        "found": (names["result"].vertices[0].numpy(), {"color": BLUE, "lw": 1.4}),
    }
    for label, (surface, style) in surfaces.items():
        b.plot(*surface[line][:, [0, 2]].T, label=label, **style)
    b.set_aspect("equal")
    b.set_title("the grid's line at y = 0", fontsize=10)
    b.set_xlabel("x, mm", fontsize=10)
    b.set_ylabel("z, mm", fontsize=10)
    for axes in (a, b):
        axes.legend(fontsize=8, loc="upper left")
    return drawing
