"""Panels of the figures: images, flow, matches, surfaces seen from the side, contacts."""

import numpy as np
import torch
from matplotlib.collections import LineCollection
from pressed import Shown, error_words, reconstructor

from torchmembrane import Reconstruction
from torchmembrane.plot.drawing import BLUE, GREY, VERMILION

MAGNIFICATIONS, LONGEST_ARROW = (2, 3, 5, 10), 60  # px


def draw_image(axes, image, title: str) -> None:
    axes.imshow(image, cmap="gray", vmin=0, vmax=1)
    axes.set_title(title, fontsize=10)
    axes.set_xticks([])
    axes.set_yticks([])


def draw_flow(axes, image, places, flow, title: str, width: float) -> None:
    """Arrows of `flow [D, 2]` px from `places`, as many times as long as fits."""
    times = max((k for k in MAGNIFICATIONS if k * np.nanmax(np.linalg.norm(flow, axis=1)) < LONGEST_ARROW), default=1)
    draw_image(axes, image, title + (f", arrows {times} times as long" if times > 1 else ""))
    axes.quiver(*places.T, *(times * flow).T, angles="xy", scale_units="xy", scale=1, color=VERMILION, width=width)


def draw_matches(axes, shown: Shown, flow: torch.Tensor, title="matches") -> None:
    """Circles at the dots of the rest image, arrows `flow [D, 2]` px towards where they have gone."""
    r = reconstructor(shown.sensor)
    rest = r.rest_pixels.numpy()
    draw_flow(axes, 0.6 + 0.4 * r.sensor.markers.rest_image, rest, flow.numpy(), title, 0.004)
    axes.plot(*rest.T, "o", ms=5, mfc="none", mec=BLUE, mew=0.8)


def draw_surface(axes, shown: Shown, result: Reconstruction, across: int, title: str) -> None:
    """Crosses at rest, the mesh found, dots where they truly are; seen along x (`across` 1) or y (0)."""
    membrane = reconstructor(shown.sensor).estimator.membrane
    plane = [across, 2]
    m, n = membrane.grid
    found = result.vertices[0].numpy()[:, plane].reshape(m, n, 2)
    lattice = [*found[:: max(1, m // 16)], *found.swapaxes(0, 1)[:: max(1, n // 16)]]
    axes.plot(*membrane.rest.numpy()[:, plane].T, "+", ms=4, mew=0.6, color=GREY, label="at rest")
    axes.add_collection(LineCollection(lattice, colors=BLUE, linewidths=0.5, label="found"))
    axes.plot(*shown.dots[:, plane].T, ".", ms=5, color=VERMILION, label="dots, true")
    axes.set_aspect("equal")
    axes.set_title(title, fontsize=10)
    axes.set_xlabel(f"{'xy'[across]}, mm\n{error_words(shown, result)}", fontsize=10)
    axes.set_ylabel("z, mm", fontsize=10)


def draw_field(axes, shown: Shown, values, title: str, symmetric=True):
    """A field on the rest vertices in the image, over circles at the dots; zero is white."""
    r = reconstructor(shown.sensor)
    limit = max(float(np.abs(values).max()), 1e-9)
    levels, colours = (np.linspace(-limit, limit, 41), "RdBu_r") if symmetric else (np.linspace(0, limit, 41), "Reds")
    draw_image(axes, np.ones_like(shown.image), title)
    triangles = r.estimator.membrane.triangles.numpy()
    field = axes.tricontourf(*r.vertex_pixels.numpy().T, triangles, values, levels=levels, cmap=colours)
    axes.plot(*r.rest_pixels.numpy().T, "o", ms=3, mfc="none", mec="0.6", mew=0.5)
    return field


def draw_contacts(axes, shown: Shown, values, points, title: str, words: str, symmetric=True) -> None:
    """A field on the rest vertices in the image, contacts found (x) and true (o)."""
    draw_field(axes, shown, values, title, symmetric)
    pixel = reconstructor(shown.sensor).sensor.camera.point_to_pixel
    found, true = (pixel(torch.as_tensor(a, dtype=torch.float64)).numpy() for a in (points, shown.contacts))
    axes.plot(*found.T, "x", ms=11, mew=2.5, color="k", label="found")
    axes.plot(*true.T, "o", ms=14, mew=2, mfc="none", mec="k", label="true")
    axes.legend(fontsize=8, loc="lower left", labelspacing=1.4, borderpad=0.9)
    axes.set_xlabel(words, fontsize=10)
