"""The picture that moves, figures/press.gif: a ball presses the preset fingertip and is dragged; what is found of it."""

from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from matplotlib import colormaps
from matplotlib.colors import Normalize
from matplotlib.figure import Figure

import torchmembrane as tm
from torchmembrane.plot.drawing import BLUE, VERMILION
from torchmembrane.plot.film import picture_of
from torchmembrane.plot.film import write_film as write_pictures

FRICTION, RADIUS, DEPTH, DRAG = 0.5, 4.0, 2.0, 2.5  # lengths in mm
PUSHED, DRAGGED, SECONDS = 9, 10, 0.13


class Film(NamedTuple):
    """Frames of the press as the camera has them, the ball's centres, what is found of them, and the true forces `[F, 3]`."""

    images: list[np.ndarray]
    centres: np.ndarray
    found: list[tm.Reconstruction]
    forces: np.ndarray
    tracker: tm.Tracker


def film() -> Film:
    """Simulated and tracked."""
    sensor = tm.preset("fingertip")
    simulator = tm.simulate.Simulator(sensor, grid=(37, 37), appearance=tm.simulate.Appearance(noise=35.0))
    ball = tm.simulate.Sphere(RADIUS).touching(simulator.membrane, (0, 0, -1))
    offsets = [(0, 0, -DEPTH * k / PUSHED) for k in range(1, PUSHED + 1)]
    offsets += [(DRAG * k / DRAGGED, 0, -DEPTH) for k in range(1, DRAGGED + 1)]
    path = [ball, *(ball.moved(offset) for offset in offsets)]
    cavity = simulator.cavity
    states = list(tm.simulate.presses(simulator.membrane, simulator.elasticity, [path], friction=FRICTION, **cavity))
    tracker = tm.Tracker(tm.Reconstructor(sensor))
    images = [simulator.image(state.vertices, np.random.default_rng(k)) for k, state in enumerate(states)]
    centres = torch.stack([body.translation for body in path]).numpy()
    forces = torch.stack([state.force for state in states]).numpy()
    return Film(images, centres, [tracker(image) for image in images], forces, tracker)


def drawn(film: Film, k: int) -> Figure:
    """Frame k: image with the dots' motion, the surface with the ball, force over the frames."""
    reconstructor, result = film.tracker.reconstructor, film.found[k]
    drawing = Figure(figsize=(8.4, 2.9), dpi=100, layout="constrained")
    left, middle, right = (drawing.add_subplot(1, 3, i, projection="3d" if i == 2 else None) for i in (1, 2, 3))
    left.imshow(film.images[k], cmap="gray")
    rest, flow = reconstructor.rest_pixels.numpy(), (result.pixels[0] - reconstructor.rest_pixels).numpy()
    arrows = dict(angles="xy", scale_units="xy", scale=0.5, width=0.008, color=VERMILION)
    left.quiver(*rest.T, *flow.T, **arrows)
    left.set(xticks=[], yticks=[], xlim=(130, 510), ylim=(430, 50))
    left.set_title("one image", fontsize=13)
    m, n = reconstructor.estimator.membrane.grid
    x, y, z = result.vertices[0].numpy().T.reshape(3, m, n)
    depth = (result.displacement[0] * reconstructor.estimator.membrane.rest_normals).sum(-1).numpy().reshape(m, n)
    colours = colormaps["RdBu"](Normalize(-DEPTH, DEPTH)(depth))
    middle.plot_surface(x, y, z, facecolors=colours, rstride=1, cstride=1, lw=0.3, edgecolor="0.55", shade=False)
    a, b = np.meshgrid(np.linspace(0, 2 * np.pi, 25), np.linspace(0, np.pi, 13))
    sphere = RADIUS * np.stack([np.cos(a) * np.sin(b), np.sin(a) * np.sin(b), np.cos(b)])
    middle.plot_surface(*(sphere + film.centres[k][:, None, None]), color="0.6", alpha=0.25, lw=0)
    middle.set(xlim=(-8, 8), ylim=(-8, 8), zlim=(4, 20))
    middle.view_init(elev=20, azim=-80)
    middle.set_box_aspect((1, 1, 1), zoom=1.5)
    middle.set_axis_off()
    middle.set_title("shape", fontsize=13)
    found = torch.cat([each.force for each in film.found]).numpy()
    for values, colour, name in ((-found[:, 2], BLUE, "push"), (found[:, 0], VERMILION, "shear")):
        right.plot(values[: k + 1], color=colour, lw=2.5, label=name)
    right.plot(-film.forces[:, 2], "--", color="0.5", lw=1, zorder=0, label="true")
    right.plot(film.forces[:, 0], "--", color="0.5", lw=1, zorder=0)
    right.set(xlim=(0, len(found) - 1), ylim=(0.1 * found[:, 2].min(), 1.15 * -film.forces[:, 2].min()), xticks=[])
    right.tick_params(labelsize=11)
    right.set_title("force, N", fontsize=13)
    right.legend(fontsize=11, frameon=False, loc="upper left")
    return drawing


def write_film(path: Path) -> None:
    """The animated GIF."""
    shown = film()
    pictures = (picture_of(drawn(shown, k)) for k in range(len(shown.images)))
    write_pictures(path, pictures, 1 / SECONDS, last=9 * SECONDS)
    print(f"{path}: {path.stat().st_size / 1e6:.2f} MB", flush=True)
