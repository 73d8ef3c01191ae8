"""The paper's figures from this project's own simulated sensors, minimum energy and force balance side by side.

python docs/figures.py [--out docs/figures] [--only 6,19]

Presses are simulated on a finer grid, rendered with 30 dB noise, and reconstructed from the images alone.
Under each reconstruction stands its rms error at the dots over the rms displacement, in the sensor's unit.
"""

import argparse
import textwrap
import warnings
from functools import cache
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from PIL import Image

from torchmembrane import Reconstruction, Reconstructor, Status
from torchmembrane.estimators.flow import FlowInterpolation
from torchmembrane.estimators.segmentation import PolarAngle, Segmented, reconstruct_and_segment
from torchmembrane.markers.observer import FOUND
from torchmembrane.paper.pressed_strip import Disc, PressedStrip
from torchmembrane.paper.profile import ForceBalanceProfile, MinimumEnergyProfile
from torchmembrane.paper.strip import Strip
from torchmembrane.plot.drawing import BLUE, GREY, VERMILION
from torchmembrane.presets import preset_file
from torchmembrane.simulate import Appearance, Cylinder, Simulator, Sphere, press

NOISE = 30.0  # dB below white
ROUNDS = 8  # of the reconstruct / segment loop
ESTIMATORS = {"minimum energy": "minimum-energy", "force balance": "force-balance"}
MISMATCHED = 0.05
MAGNIFICATIONS, LONGEST_ARROW = (2, 3, 5, 10), 60  # px
WIDTHS = {"width_ratios": (1, 1, 1.4, 1.4)}


class Shown(NamedTuple):
    """One simulated press: image `[H, W]` in 0..1, the dots' true places and pixels `[D, ...]`, the true contacts `[I, 3]`."""

    sensor: str
    image: np.ndarray
    rest_dots: np.ndarray
    dots: np.ndarray
    pixels: np.ndarray
    contacts: np.ndarray


@cache
def simulator(sensor: str) -> Simulator:
    return Simulator(reconstructor(sensor).sensor, appearance=Appearance(noise=NOISE))


@cache
def reconstructor(sensor: str, estimator="minimum-energy") -> Reconstructor:
    return Reconstructor.from_file(preset_file(sensor), estimator=estimator)


@cache
def pressed(sensor: str, *strokes) -> Shown:
    """Bodies `(radius, from, travel, depth)` or `(radius, from, travel, depth, axis)` pressed at once, without friction."""
    sim, paths = simulator(sensor), []
    for radius, start, travel, depth, *axis in strokes:
        unit = torch.nn.functional.normalize(torch.tensor(travel, dtype=torch.float64), dim=0)
        body = Cylinder(radius, axis=axis[0], translation=start) if axis else Sphere(radius, translation=start)
        body = body.touching(sim.membrane, unit)
        paths.append([body, body.moved(depth * unit)])
    state = press(sim.membrane, sim.elasticity, paths, **sim.cavity)
    dots, rest = sim.renderer.dots(state.vertices), sim.rest_dots
    image = sim.image(state.vertices, np.random.default_rng(0)) / 255
    arrays = (rest.positions, dots.positions, dots.pixels, state.contact_points)
    return Shown(sensor, image.astype(np.float32), *(np.asarray(a) for a in arrays))


@cache
def reconstructed(sensor: str, strokes, estimator: str) -> Reconstruction:
    with torch.no_grad():
        return reconstructor(sensor, estimator)(torch.from_numpy(pressed(sensor, *strokes).image))


def error_words(shown: Shown, result: Reconstruction) -> str:
    """The error at the dots and their displacement, in words."""
    return relative_words(result.markers[0].numpy() - shown.dots, shown.dots - shown.rest_dots)


def relative_words(error: np.ndarray, moved: np.ndarray) -> str:
    """Rms of errors and of displacements, `[D, ...]`, in words."""
    error, moved = (float(np.sqrt((a**2).sum(1).mean())) for a in (error, moved))
    return f"error {error:.3f} of {moved:.3f} mm ({100 * error / moved:.0f} %)"


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


def measured_flow(shown: Shown, result: Reconstruction) -> torch.Tensor:
    return result.pixels[0] - reconstructor(shown.sensor).rest_pixels


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


def reconstruction_rows(name: str, across: int, *rows: tuple[str, tuple]) -> Figure:
    """Image, matches, and both reconstructions, a row for each press."""
    drawing = Figure(figsize=(16, 0.8 + 3.9 * len(rows)), dpi=100, layout="constrained")
    drawing.suptitle(name)
    for axes, (sensor, strokes) in zip(drawing.subplots(len(rows), 4, squeeze=False, gridspec_kw=WIDTHS), rows, strict=True):
        shown = pressed(sensor, *strokes)
        draw_image(axes[0], shown.image, "deformed image")
        for place, (title, estimator) in zip(axes[2:], ESTIMATORS.items(), strict=True):
            result = reconstructed(sensor, strokes, estimator)
            draw_surface(place, shown, result, across, title)
        draw_matches(axes[1], shown, measured_flow(shown, result))
    drawing.legend(*axes[-1].get_legend_handles_labels(), loc="outside lower right", ncols=3, frameon=False)
    return drawing


TOP = ((1.2, (0, 0, 6), (-0.35, -0.1, -1.0), 2.5),)
TWO = ((1.5, (0, 0, 6), (-0.7, -0.2, -1.0), 1.8), (1.5, (0, 0, 6), (0.7, 0.3, -1.0), 1.5))
SIDE = ((3.0, (0, 0, 24), (0.0, -0.8, -0.6), 2.5, (1, 0, 0)),)
BOTH_SIDES = tuple((3.0, (0, 0, 24), (0.0, side, -0.6), 1.2, (1, 0, 0)) for side in (-0.8, 0.8))
BUBBLE = ((7.0, (0, 0, 45), (-0.3, 0.2, -1.0), 6.0),)


def figure_6() -> Figure:
    """Flow: images at rest and pressed, the measured flow, the same on a 16 x 16 grid by bilinear interpolation."""
    shown, r = pressed("fingertip", *TOP), reconstructor("fingertip")
    results = {title: reconstructed("fingertip", TOP, e) for title, e in ESTIMATORS.items()}
    result = results["minimum energy"]
    drawing = Figure(figsize=(11, 9.2), dpi=100, layout="constrained")
    (a, b), (c, d) = drawing.subplots(2, 2)
    draw_image(a, r.sensor.markers.rest_image, "(a) undeformed")
    draw_image(b, shown.image, "(b) pressed 2.5 mm by a ball of radius 1.2 mm")
    draw_matches(c, shown, measured_flow(shown, result), "(c) measured flow")
    fine = r.sensor.surface.membrane((16, 16))
    points = fine.closest_points(r.rest_markers.double().numpy())
    moved = measured_flow(shown, result).double()
    flow = FlowInterpolation(fine, points, "bilinear")(moved, torch.ones(len(moved)).double()).numpy()
    place = r.sensor.camera.point_to_pixel(fine.rest).numpy()
    draw_flow(d, np.ones_like(shown.image), place, flow, "(d) on a 16 x 16 grid, bilinear", 0.003)
    words = "; ".join(f"{title}: {error_words(shown, got)}" for title, got in results.items())
    drawing.supxlabel(words, fontsize=10)
    return drawing


def segmented(shown: Shown, result: Reconstruction) -> Segmented:
    """The segmentation loop's outcome."""
    r = reconstructor(shown.sensor)
    rays = r.observation(result.pixels - r.rest_pixels, result.confidence)
    return reconstruct_and_segment(r.estimator, r.estimator.segmentation, rays, ROUNDS)


def contact_words(found: np.ndarray, true: np.ndarray) -> str:
    found = found[np.isfinite(found).all(1)]
    if not len(found):
        return "none found"
    gap = np.linalg.norm(found[:, None] - true, axis=2)
    return f"{len(found)} found; in space {max(gap.min(0).mean(), gap.min(1).mean()):.2f} mm from the true"


def draw_contacts(axes, shown: Shown, values, points, title: str, words: str, symmetric=True) -> None:
    """A field on the rest vertices in the image, contacts found (x) and true (o)."""
    r = reconstructor(shown.sensor)
    place, camera = r.vertex_pixels.numpy(), r.sensor.camera
    triangles = r.estimator.membrane.triangles.numpy()
    limit = max(float(np.abs(values).max()), 1e-9)
    levels, colours = (np.linspace(-limit, limit, 41), "RdBu_r") if symmetric else (np.linspace(0, limit, 41), "Reds")
    draw_image(axes, np.ones_like(shown.image), title)
    axes.tricontourf(*place.T, triangles, values, levels=levels, cmap=colours)
    axes.plot(*r.rest_pixels.numpy().T, "o", ms=3, mfc="none", mec="0.6", mew=0.5)
    found, true = (camera.point_to_pixel(torch.as_tensor(a, dtype=torch.float64)).numpy() for a in (points, shown.contacts))
    axes.plot(*found.T, "x", ms=11, mew=2.5, color="k", label="found")
    axes.plot(*true.T, "o", ms=14, mew=2, mfc="none", mec="k", label="true")
    axes.legend(fontsize=8, loc="lower left", labelspacing=1.4, borderpad=0.9)
    axes.set_xlabel(words, fontsize=10)


def figure_8() -> Figure:
    """Initial segmentation: motion of the dots, change of the polar angle, the region that bulges in."""
    shown, result = pressed("bubble", *BUBBLE), reconstructed("bubble", BUBBLE, "minimum-energy")
    r = reconstructor("bubble")
    got = segmented(shown, result)
    drawing = Figure(figsize=(15, 4.4), dpi=100, layout="constrained")
    a, b, c = drawing.subplots(1, 3)
    draw_matches(a, shown, measured_flow(shown, result), "(a) matches")
    normals = (r.marker_weights[..., None] * r.estimator.membrane.rest_normals[r.marker_vertices]).sum(-2)
    polar = PolarAngle(r.rest_markers, normals, *r.camera.pixel_to_ray(r.rest_pixels))
    change = np.rad2deg(polar.change(r.camera.pixel_to_ray(result.pixels[0]).direction).numpy())
    draw_image(b, 0.6 + 0.4 * shown.image, "(b) $d\\beta$ of each dot, degrees (red: towards the axis)")
    limit = np.abs(change).max()
    dots = b.scatter(*r.rest_pixels.numpy().T, c=change, cmap="RdBu_r", vmin=-limit, vmax=limit, s=40, edgecolors="0.3")
    drawing.colorbar(dots, ax=b, shrink=0.8)
    first = got.first
    words = contact_words(first.points[0].numpy(), shown.contacts)
    region = first.bulge[0].numpy() * (first.region[0].numpy() > 0)
    draw_contacts(
        c, shown, region, first.points[0].numpy(), "(c) region that bulges in, its centroid on the rest surface", words
    )
    other = reconstructed("bubble", BUBBLE, "force-balance")
    drawing.supxlabel(f"minimum energy: {error_words(shown, result)}; force balance: {error_words(shown, other)}", fontsize=10)
    return drawing


def contacts_figure(name: str, sensor: str, strokes) -> Figure:
    """Eq. 29 alone, the reconstruct and segment loop, and force balance's tractions."""
    shown = pressed(sensor, *strokes)
    least, balance = (reconstructed(sensor, strokes, e) for e in ESTIMATORS.values())
    got = segmented(shown, least)
    drawing = Figure(figsize=(15, 4.6), dpi=100, layout="constrained")
    drawing.suptitle(name)
    a, b, c = drawing.subplots(1, 3)
    for axes, contacts, title in ((a, got.first, "eq. 29 alone"), (b, got.contacts, "reconstruct and segment")):
        points = contacts.points[0].numpy()
        draw_contacts(axes, shown, contacts.bulge[0].numpy(), points, title, contact_words(points, shown.contacts))
    points = balance.contact_points[0].numpy()
    words = contact_words(points, shown.contacts)
    draw_contacts(c, shown, balance.contact[0].numpy(), points, "contact indicator of force balance", words, symmetric=False)
    drawing.supxlabel(f"minimum energy: {error_words(shown, least)}; force balance: {error_words(shown, balance)}", fontsize=10)
    return drawing


def figure_9() -> Figure:
    return contacts_figure("one contact", "fingertip", TOP)


def figure_10() -> Figure:
    return contacts_figure("two contacts", "fingertip", TWO)


def figure_12() -> Figure:
    return reconstruction_rows("point indenter, side view", 0, ("fingertip", TOP), ("fingertip", TWO))


def figure_13() -> Figure:
    return reconstruction_rows(
        "squeezed by cylinders on one side and on both, end view", 1, ("half_cylinder", SIDE), ("half_cylinder", BOTH_SIDES)
    )


def figure_15() -> Figure:
    return reconstruction_rows("a larger sensor, filled with air", 0, ("bubble", BUBBLE))


def figure_16() -> Figure:
    """5 % of the markers matched to a neighbour: what it does, and what the screen saves."""
    shown, r = pressed("fingertip", *TOP), reconstructor("fingertip")
    right = measured_flow(shown, reconstructed("fingertip", TOP, "minimum-energy"))
    rest, rng = r.rest_pixels, np.random.default_rng(2)
    bad = rng.choice(len(rest), max(3, round(MISMATCHED * len(rest))), replace=False)
    near = torch.cdist(rest[bad], rest).argsort(1)[:, 1:5][np.arange(len(bad)), rng.integers(0, 4, len(bad))]
    flow = right.clone()
    flow[bad] = rest[near] + right[near] - rest[bad]
    believed = torch.ones(1, len(rest))
    trusts = {"believed": believed, "screened": r.observer.screen(flow[None], believed)}
    drawing = Figure(figsize=(16, 8.6), dpi=100, layout="constrained")
    for axes, (name, trust) in zip(drawing.subplots(2, 3), trusts.items(), strict=True):
        kept = trust[0] > FOUND
        for place, (title, estimator) in zip(axes[1:], ESTIMATORS.items(), strict=True):
            result = from_flow(reconstructor("fingertip", estimator), flow[None], trust)
            draw_surface(place, shown, result, 0, f"{title}, mismatches {name}")
        title = f"{len(bad)} of {len(rest)} markers mismatched, {int((~kept).sum())} flagged"
        draw_matches(axes[0], shown, torch.where(kept[:, None], flow, 0.0), title)
        axes[0].plot(*rest[~kept].T, "x", ms=8, mew=1.6, color="k")
    drawing.legend(*axes[-1].get_legend_handles_labels(), loc="outside lower right", ncols=3, frameon=False)
    return drawing


def from_flow(r: Reconstructor, flow: torch.Tensor, trust: torch.Tensor) -> Reconstruction:
    """Displacements `[B, D, 2]` px and confidence `[B, D]`, as they are given: no screen."""
    with torch.no_grad():
        usable, trust, status = r.observer.judge(flow, trust, torch.full((len(flow),), Status.OK.value))
        return r.result(r.estimator(r.observation(usable, trust)), flow, trust, status)


def profile_figure(name: str, discs: list[Disc], radius=15.0, noise=2e-4) -> Figure:
    """One dimension: the strip seen from its centre; closed-form truth and both reconstructions."""
    truth, strip = PressedStrip(radius, discs), Strip("neo_hookean", 1.2)
    theta = np.linspace(0, np.pi, 33)[1:-1]
    place = truth.positions(np.rad2deg(theta))
    psi = np.arctan2(place[:, 1], place[:, 0]) + noise * np.random.default_rng(0).standard_normal(len(theta))
    estimators = MinimumEnergyProfile(radius, strip, 61), ForceBalanceProfile(radius, strip, 61, 2 * noise)
    drawing = Figure(figsize=(13, 4.6), dpi=100, layout="constrained")
    drawing.suptitle(name)
    for axes, title, estimator in zip(drawing.subplots(1, 2), ESTIMATORS, estimators, strict=True):
        got = estimator(theta, psi)
        rest = radius * np.stack([np.cos(theta), np.sin(theta)], -1)
        axes.add_collection(LineCollection([[(0, 0), p] for p in place], colors=GREY, linewidths=0.4))
        axes.plot(*estimator.rest.T, "--", color="k", lw=0.8, label="at rest")
        axes.plot(*truth.positions(np.linspace(0, 180, 721)).T, color=VERMILION, lw=2.5, label="true")
        axes.plot(*got.nodes.T, color=BLUE, lw=1.4, label="found")
        for disc in discs:
            circle = np.linspace(0, 2 * np.pi, 90)
            outline = np.array(disc.centre) + max(disc.radius, 0.15) * np.stack([np.cos(circle), np.sin(circle)], -1)
            axes.fill(*outline.T, color="0.8", zorder=0)
        axes.set_aspect("equal")
        axes.set(title=title, xlim=(-1.25 * radius, 1.25 * radius), ylim=(-0.5, 1.35 * radius))
        axes.set_ylabel("mm", fontsize=10)
        axes.set_xlabel(f"mm\n{relative_words(got.at(theta) - place, place - rest)}", fontsize=10)
        axes.legend(fontsize=8, loc="lower center", frameon=False)
    return drawing


def figure_19() -> Figure:
    return profile_figure("one cylinder of radius 5 mm, pressed 4 mm", [Disc.pressed(15.0, 90, 4.0, 5.0)])


def figure_20() -> Figure:
    return profile_figure("two points, pressed 2 mm", [Disc.pressed(15.0, angle, 2.0, 0.0) for angle in (60, 120)])


FIGURES = {int(name.removeprefix("figure_")): make for name, make in list(globals().items()) if name.startswith("figure_")}


def main():
    parser = argparse.ArgumentParser(description=textwrap.dedent(__doc__), formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "figures")
    parser.add_argument("--only", type=lambda text: [int(n) for n in text.split(",")], default=sorted(FIGURES))
    args = parser.parse_args()
    warnings.simplefilter("ignore")
    torch.set_num_threads(2)
    args.out.mkdir(parents=True, exist_ok=True)
    for number in args.only:
        path = args.out / f"figure_{number:02d}.png"
        FIGURES[number]().savefig(path)
        Image.open(path).convert("RGB").quantize(256).save(path, optimize=True)
        print(path, flush=True)


if __name__ == "__main__":
    main()
