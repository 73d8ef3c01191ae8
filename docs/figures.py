"""The paper's figures from this project's own simulated sensors: the paper's estimator, minimum energy, force balance.

python docs/figures.py [--out docs/figures] [--only 6,19,chain,slip]

Presses are simulated on a finer grid, rendered with 30 dB noise, and reconstructed from the images alone. "The paper" is
`--estimator paper` with the soft locator, "minimum energy" that of the sensor's material. Under each reconstruction stands its
rms error at the dots over the rms displacement, in the sensor's unit. `chain` makes the pictures of docs/paper_chain.md, `slip`
that of docs/slip.md, `indentation` that of docs/results.md, `press` the moving one of the README.
"""

import argparse
import textwrap
import warnings
from pathlib import Path

import numpy as np
import torch
from chain import chain_figures
from indentation import indentation_figure
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from moving import write_film
from panels import draw_contacts, draw_flow, draw_image, draw_matches, draw_surface
from PIL import Image
from pressed import (
    BALANCE,
    BOTH_SIDES,
    BUBBLE,
    ENERGY,
    ESTIMATORS,
    PAPER,
    SIDE,
    TOP,
    TWO,
    Shown,
    contact_regions,
    contact_words,
    error_words,
    from_flow,
    measured_flow,
    pressed,
    reconstructed,
    reconstructor,
    relative_words,
    segmented,
)
from slip import slip_figure

from torchmembrane import Reconstruction
from torchmembrane.estimators.minimum_energy.segmentation import PolarAngle
from torchmembrane.estimators.paper.studies.pressed_strip import Disc, PressedStrip
from torchmembrane.estimators.paper.studies.profile import ForceBalanceProfile, MinimumEnergyProfile
from torchmembrane.estimators.paper.studies.strip import Strip
from torchmembrane.markers.observer import FOUND
from torchmembrane.plot.drawing import BLUE, GREY, VERMILION

MISMATCHED = 0.05
WIDTHS = {"width_ratios": (1, 1, 1.4, 1.4, 1.4)}
COLOURS = 256  # of a picture's file


def all_errors(shown: Shown, results: dict[str, Reconstruction]) -> str:
    return "; ".join(f"{title}: {error_words(shown, got)}" for title, got in results.items())


def reconstruction_rows(name: str, across: int, *rows: tuple[str, tuple], height: float = 3.4) -> Figure:
    """Image, matches, and all reconstructions, a row for each press."""
    drawing = Figure(figsize=(13.5, 0.8 + 0.8 * height * len(rows)), dpi=100, layout="constrained")
    drawing.suptitle(name)
    for axes, (sensor, strokes) in zip(drawing.subplots(len(rows), 5, squeeze=False, gridspec_kw=WIDTHS), rows, strict=True):
        shown = pressed(sensor, *strokes)
        draw_image(axes[0], shown.image, "deformed image")
        for place, title in zip(axes[2:], ESTIMATORS, strict=True):
            draw_surface(place, shown, reconstructed(sensor, strokes, title), across, title)
        draw_matches(axes[1], shown, measured_flow(shown, reconstructed(sensor, strokes, PAPER)))
    drawing.legend(*axes[-1].get_legend_handles_labels(), loc="outside lower right", ncols=3, frameon=False)
    return drawing


def figure_6() -> Figure:
    """Flow: images at rest and pressed, the measured flow, the same on a 16 x 16 grid by bilinear interpolation."""
    shown, r = pressed("fingertip", *TOP), reconstructor("fingertip", PAPER)
    results = {title: reconstructed("fingertip", TOP, title) for title in ESTIMATORS}
    drawing = Figure(figsize=(11, 9.2), dpi=100, layout="constrained")
    (a, b), (c, d) = drawing.subplots(2, 2)
    draw_image(a, r.sensor.markers.rest_image, "(a) undeformed")
    draw_image(b, shown.image, "(b) pressed 2.5 mm by a ball of radius 1.2 mm")
    draw_matches(c, shown, measured_flow(shown, results[PAPER]), "(c) measured flow")
    fine = r.sensor.surface.membrane((16, 16))
    flow = type(r.estimator.flow.interpolation)(fine, fine.closest_points(r.rest_markers.double().numpy()), "bilinear")
    moved = flow(measured_flow(shown, results[PAPER]).double().nan_to_num(), results[PAPER].confidence[0].double())
    place = r.sensor.camera.point_to_pixel(fine.rest).numpy()
    draw_flow(d, np.ones_like(shown.image), place, moved.numpy(), "(d) on a 16 x 16 grid, bilinear", 0.003)
    drawing.supxlabel(all_errors(shown, results).replace(f"; {BALANCE}", f"\n{BALANCE}"), fontsize=10)
    return drawing


def figure_8() -> Figure:
    """Initial segmentation: motion of the dots, change of the polar angle, the region that bulges in."""
    shown, results = pressed("bubble", *BUBBLE), {title: reconstructed("bubble", BUBBLE, title) for title in ESTIMATORS}
    r, result = reconstructor("bubble", PAPER), results[PAPER]
    first = segmented(shown, result).first
    drawing = Figure(figsize=(15, 4.4), dpi=100, layout="constrained")
    a, b, c = drawing.subplots(1, 3)
    draw_matches(a, shown, measured_flow(shown, result), "(a) matches")
    normals = (r.marker_weights[..., None] * r.estimator.membrane.rest_normals[r.marker_vertices]).sum(-2)
    polar = PolarAngle(r.rest_markers, normals, *r.camera.pixel_to_ray(r.rest_pixels))
    change = np.rad2deg(polar.change(r.camera.pixel_to_ray(result.pixels[0]).direction).numpy())
    draw_image(b, 0.6 + 0.4 * shown.image, "(b) $d\\beta$ of each dot, degrees (red: towards the axis)")
    limit = np.nanmax(np.abs(change))
    dots = b.scatter(*r.rest_pixels.numpy().T, c=change, cmap="RdBu_r", vmin=-limit, vmax=limit, s=40, edgecolors="0.3")
    drawing.colorbar(dots, ax=b, shrink=0.8)
    words, points = contact_words(first.points[0].numpy(), shown.contacts), first.points[0].numpy()
    region = first.bulge[0].numpy() * (first.region[0].numpy() > 0)
    draw_contacts(c, shown, region, points, "(c) region that bulges in, its centroid on the rest surface", words)
    drawing.supxlabel(all_errors(shown, results), fontsize=10)
    return drawing


def contacts_figure(name: str, sensor: str, strokes) -> Figure:
    """Contacts by eq. 29 alone, by the paper's loop, on the surface of minimum energy, and by force balance's tractions."""
    shown, results = pressed(sensor, *strokes), {title: reconstructed(sensor, strokes, title) for title in ESTIMATORS}
    paper, energy = segmented(shown, results[PAPER]), contact_regions(shown, results[ENERGY])
    drawing = Figure(figsize=(18, 4.6), dpi=100, layout="constrained")
    drawing.suptitle(name)
    *loops, c = drawing.subplots(1, 4)
    contacts = {
        "eq. 29 alone (the paper, first)": paper.first,
        "reconstruct and segment (the paper)": paper.contacts,
        "contacts of minimum energy's surface": energy,
    }
    for axes, (title, regions) in zip(loops, contacts.items(), strict=True):
        points = regions.points[0].numpy()
        draw_contacts(axes, shown, regions.bulge[0].numpy(), points, title, contact_words(points, shown.contacts))
    balance = results[BALANCE]
    points = balance.contact_points[0].numpy()
    words = contact_words(points, shown.contacts)
    draw_contacts(c, shown, balance.contact[0].numpy(), points, "contact indicator of force balance", words, symmetric=False)
    drawing.supxlabel(all_errors(shown, results), fontsize=10)
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
    return reconstruction_rows("a larger sensor, filled with air", 0, ("bubble", BUBBLE), height=2.4)


def figure_16() -> Figure:
    """5 % of the markers matched to a neighbour: what it does, and what the screen saves."""
    shown, r = pressed("fingertip", *TOP), reconstructor("fingertip", PAPER)
    right = measured_flow(shown, reconstructed("fingertip", TOP, PAPER))
    rest, rng = r.rest_pixels, np.random.default_rng(2)
    bad = rng.choice(len(rest), max(3, round(MISMATCHED * len(rest))), replace=False)
    near = torch.cdist(rest[bad], rest).argsort(1)[:, 1:5][np.arange(len(bad)), rng.integers(0, 4, len(bad))]
    flow = right.clone()
    flow[bad] = rest[near] + right[near] - rest[bad]
    believed = torch.ones(1, len(rest))
    trusts = {"believed": believed, "screened": r.observer.screen(flow[None], believed)}
    drawing = Figure(figsize=(18, 8.0), dpi=100, layout="constrained")
    drawing.suptitle("markers matched to a neighbour, believed and screened")
    places = drawing.subplots(2, 4, gridspec_kw={"width_ratios": (1, 1.1, 1.1, 1.1)})
    for axes, (name, trust) in zip(places, trusts.items(), strict=True):
        kept = trust[0] > FOUND
        for place, title in zip(axes[1:], ESTIMATORS, strict=True):
            result = from_flow(reconstructor("fingertip", title), flow[None], trust)
            draw_surface(place, shown, result, 0, f"{title}, mismatches {name}")
        title = f"{len(bad)} of {len(rest)} mismatched,\n{int((~kept).sum())} flagged"
        draw_matches(axes[0], shown, torch.where(kept[:, None], flow, 0.0), title)
        axes[0].plot(*rest[~kept].T, "x", ms=8, mew=1.6, color="k")
    drawing.legend(*axes[-1].get_legend_handles_labels(), loc="outside lower right", ncols=3, frameon=False)
    return drawing


def profile_figure(name: str, discs: list[Disc], radius=15.0, noise=2e-4) -> Figure:
    """One dimension: the strip seen from its centre; closed-form truth and both reconstructions."""
    truth, strip = PressedStrip(radius, discs), Strip("neo_hookean", 1.2)
    theta = np.linspace(0, np.pi, 33)[1:-1]
    place = truth.positions(np.rad2deg(theta))
    psi = np.arctan2(place[:, 1], place[:, 0]) + noise * np.random.default_rng(0).standard_normal(len(theta))
    estimators = {
        ENERGY: MinimumEnergyProfile(radius, strip, 61),
        BALANCE: ForceBalanceProfile(radius, strip, 61, 2 * noise),
    }
    drawing = Figure(figsize=(9.5, 3.6), dpi=100, layout="constrained")
    drawing.suptitle(name)
    for axes, (title, estimator) in zip(drawing.subplots(1, 2), estimators.items(), strict=True):
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


FIGURES = {name.removeprefix("figure_"): make for name, make in list(globals().items()) if name.startswith("figure_")}


def write(drawing: Figure, path: Path) -> None:
    drawing.savefig(path)
    Image.open(path).convert("RGB").quantize(COLOURS, dither=Image.Dither.NONE).save(path, optimize=True)
    print(path, flush=True)


PAGES = ("chain", "slip", "indentation", "press")


def main():
    parser = argparse.ArgumentParser(description=textwrap.dedent(__doc__), formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "figures")
    parser.add_argument("--only", type=lambda text: text.split(","), default=[*FIGURES, *PAGES])
    args = parser.parse_args()
    warnings.simplefilter("ignore")
    torch.set_num_threads(2)
    args.out.mkdir(parents=True, exist_ok=True)
    for name in args.only:
        if name == "chain":
            for part, drawing in chain_figures():
                write(drawing, args.out / f"chain_{part}.png")
        elif name == "slip":
            write(slip_figure(), args.out / "slip.png")
        elif name == "indentation":
            write(indentation_figure(), args.out / "indentation.png")
        elif name == "press":
            write_film(args.out / "press.gif")
        else:
            write(FIGURES[name](), args.out / f"figure_{int(name):02d}.png")


if __name__ == "__main__":
    main()
