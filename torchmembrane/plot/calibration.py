"""Figures of calibration results: residuals, correlations, surface correction, material likelihood, dot layout."""

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from ..calibrate.report import Report
from ..sensor.sensor import Sensor
from .drawing import BLUE, GREY, SHORT, VERMILION

PARAMETERS_DRAWN = 24
GAINS = np.array([1, 2, 5, 10, 20, 50, 100, 200, 500, 1000, 2000, 5000])


def fit_figure(report: Report, image_size: tuple[int, int]) -> Figure:
    """Draw the residuals in the image (magnified arrows), their scatter, and the correlations of the fitted parameters.

    Args:
        report: the calibration's numbers.
        image_size: width and height of the image, px.

    Example:
        >>> report = Report("lens", ["focal"], ["px"], *np.ones((3, 1)), np.eye(1), np.ones((4, 2)), np.eye(4, 2), 0.5, [])
        >>> [axes.get_title() for axes in fit_figure(report, (640, 480)).axes[1:3]]
        ['residuals; circles: 1 and 3 x 0.500 px', 'correlations']
    """
    drawing = Figure(figsize=(15, 4.6), layout="constrained")
    drawing.suptitle(report.title)
    axes = drawing.subplots(1, 3, width_ratios=(1.3, 1, 1.15))
    draw_residuals(axes[0], report, image_size)
    draw_scatter(axes[1], report)
    draw_correlations(axes[2], report)
    return drawing


def draw_residuals(axes: Axes, report: Report, image_size: tuple[int, int]) -> None:
    """Draw residuals as arrows at their pixels, magnified by the largest of `GAINS` that keeps them short."""
    width, height = image_size
    typical = np.sqrt((report.residuals**2).sum(-1).mean()) if len(report.residuals) else 1.0
    gain = max(GAINS[GAINS <= max(1.0, 0.03 * width / max(typical, 1e-9))])
    axes.quiver(*report.pixels.T, *(gain * report.residuals).T, angles="xy", scale_units="xy", scale=1, width=0.002, color=BLUE)
    axes.set(xlim=(-0.5, width - 0.5), ylim=(height - 0.5, -0.5), aspect="equal", xlabel="u, px", ylabel="v, px")
    axes.set_title(f"measured less modelled, x {gain:g}")


def draw_scatter(axes: Axes, report: Report) -> None:
    """Draw residuals as points, with circles of one and three standard deviations of the noise."""
    angle = np.linspace(0, 2 * np.pi, 200)
    axes.plot(*report.residuals.T, ".", ms=2, color=BLUE)
    for times in (1, 3):
        axes.plot(times * report.noise * np.cos(angle), times * report.noise * np.sin(angle), color=VERMILION, lw=1)
    axes.set(aspect="equal", xlabel="u, px", ylabel="v, px", title=f"residuals; circles: 1 and 3 x {report.noise:.3f} px")
    axes.axhline(0, color=GREY, lw=0.5)
    axes.axvline(0, color=GREY, lw=0.5)


def draw_correlations(axes: Axes, report: Report) -> None:
    """Draw the correlation matrix of the first `PARAMETERS_DRAWN` parameters."""
    names = report.names[:PARAMETERS_DRAWN]
    n = len(names)
    shown = axes.imshow(report.correlations[:n, :n], vmin=-1, vmax=1, cmap="RdBu")
    axes.set_xticks(range(n), names, rotation=60, ha="right", fontsize=8)
    axes.set_yticks(range(n), names, fontsize=8)
    axes.set_title("correlations")
    axes.figure.colorbar(shown, ax=axes, shrink=0.8)


def surface_figure(report: Report, image_size: tuple[int, int], places: np.ndarray, correction: Any, unit: str) -> Figure:
    """Draw the residuals in the image, if there are any, and the correction of the surface with its standard deviation, viewed
    along the axis.

    Args:
        report: the calibration's numbers.
        image_size: width and height of the image, px.
        places: vertices of the surface, `[V, 3]`.
        correction: its `offsets [V]` along the normals and their `deviations [V]`.
        unit: unit of lengths.

    Example:
        >>> from torchmembrane.calibrate.surface import Correction
        >>> places = np.array([[0.0, 0.0, 5.0], [1.0, 0.0, 5.0], [0.0, 1.0, 5.0]])
        >>> found = Correction(places, np.array([0.0, 0.1, -0.1]), np.full(3, 0.01))
        >>> drawing = surface_figure(Report.without_parameters("depth"), (640, 480), places, found, "mm")
        >>> [axes.get_title() for axes in drawing.axes[:2]]
        ['moved outwards, mm', 'standard deviation, mm']
    """
    panels = 3 if len(report.residuals) else 2
    drawing = Figure(figsize=(5 * panels, 4.6), layout="constrained")
    drawing.suptitle(report.title)
    axes = drawing.subplots(1, panels)
    if panels == 3:
        draw_residuals(axes[0], report, image_size)
    offset = np.abs(correction.offsets).max()
    maps: list[tuple[Axes, np.ndarray, str, dict[str, Any]]] = [
        (axes[-2], correction.offsets, "moved outwards", dict(cmap="RdBu", vmin=-offset, vmax=offset)),
        (axes[-1], correction.deviations, "standard deviation", dict(cmap="viridis")),
    ]
    for ax, values, title, options in maps:
        shown = ax.tripcolor(places[:, 0], places[:, 1], values, shading="gouraud", **options)
        ax.set(aspect="equal", xlabel=f"x, {unit}", ylabel=f"y, {unit}", title=f"{title}, {unit}")
        ax.ticklabel_format(scilimits=SHORT)
        ax.invert_yaxis()
        drawing.colorbar(shown, ax=ax, shrink=0.8)
    return drawing


def material_figure(report: Report, found: Any, names: list[str]) -> Figure:
    """Draw the loss over the prestretch with the estimate, and the reconstructed forces or pressures over those measured.

    Args:
        report: the calibration's numbers, the prestretch first.
        found: a material's fit: its `profile` (prestretches `[S]`, losses `[S, B]` of B images), `forces [B, 2]`
            and `pressures [B, 2]`.
        names: names of the B images.

    Example:
        >>> from types import SimpleNamespace
        >>> none, stretches = np.zeros((0, 2)), np.array([1.1, 1.3, 1.5])
        >>> losses = np.array([[4.0], [0.0], [1.0]])
        >>> report = Report("material", ["prestretch"], [""], *np.ones((3, 1)), np.eye(1), none, none, 0.0, [])
        >>> found = SimpleNamespace(profile=(stretches, losses), forces=np.array([[1.0, 1.1]]), pressures=none)
        >>> [axes.get_xlabel() for axes in material_figure(report, found, ["press.png"]).axes]
        ['prestretch', 'force found, N']
    """
    of_forces = bool(np.isfinite(found.forces).all(1).any())
    pairs, kind = (found.forces, "force {}, N") if of_forces else (found.pressures, "pressure change {}, N per area")
    known = np.isfinite(pairs).all(1)
    panels = 2 if known.any() else 1
    drawing = Figure(figsize=(1 + 6 * panels, 4.6), layout="constrained")
    drawing.suptitle(report.title)
    axes = drawing.subplots(1, panels, squeeze=False)[0]
    stretches, losses = found.profile
    axes[0].plot(stretches, losses - losses.min(0), "-", color=GREY, lw=1, label="each image")
    axes[0].plot(stretches, losses.sum(1) - losses.sum(1).min(), ".-", color=BLUE, label="all")
    value, deviation = report.values[0], report.deviations[0]
    axes[0].axvspan(value - deviation, value + deviation, color=VERMILION, alpha=0.2)
    axes[0].axvline(value, color=VERMILION, label=f"{value:.3f} ± {deviation:.2g}")
    axes[0].set(xscale="log", yscale="symlog", xlabel="prestretch", ylabel="loss above the lowest")
    axes[0].set_ylim(bottom=0)
    axes[0].set_xticks([1, 1.2, 1.5, 2, 3], ["1", "1.2", "1.5", "2", "3"])
    axes[0].minorticks_off()
    handles, labels = axes[0].get_legend_handles_labels()
    axes[0].legend(handles[-3:], labels[-3:])
    if known.any():
        axes[1].plot(*pairs[known].T, "o", color=BLUE)
        for name, pair in zip(names, pairs, strict=True):
            if np.isfinite(pair).all():
                axes[1].annotate(name, pair, fontsize=8)
        top = 1.1 * pairs[known].max()
        axes[1].plot([0, top], [0, top], color=GREY, lw=1)
        axes[1].set(xlabel=kind.format("found"), ylabel=kind.format("measured"), aspect="equal")
    return drawing


def layout_figure(title: str, sensor: Sensor, dots: Any) -> Figure:
    """Draw the wanted pattern in the image, and its dots on the rest surface from above and from the side.

    Args:
        title: title of the figure.
        sensor: the sensor for which the dots are designed.
        dots: their `pixels [D, 2]` as wanted, `positions [D, 3]` on the rest surface and `radii [D]`.

    Example:
        >>> from types import SimpleNamespace
        >>> sensor = Sensor.from_file("examples/sensor.toml")
        >>> pixels, X = np.array([[320.0, 240.0]]), np.array([[0.0, 0.0, 24.0]])
        >>> dots = SimpleNamespace(pixels=pixels, positions=X, radii=np.array([0.3]))
        >>> [axes.get_title() for axes in layout_figure("one dot", sensor, dots).axes]
        ['wanted in the image', 'to make: along the axis', 'from the side']
    """
    drawing = Figure(figsize=(15, 4.6), layout="constrained")
    drawing.suptitle(title)
    axes = drawing.subplots(1, 3)
    width, height = sensor.camera.image_size
    area = 900 * dots.radii**2 / dots.radii.max() ** 2 / len(dots.radii) ** 0.5
    axes[0].scatter(*dots.pixels.T, s=area, color=BLUE)
    axes[0].set(xlim=(0, width), ylim=(height, 0), aspect="equal", xlabel="u, px", ylabel="v, px", title="wanted in the image")
    rest, unit = sensor.membrane.rest.numpy(), sensor.length_unit
    for ax, (a, b), title in ((axes[1], (0, 1), "to make: along the axis"), (axes[2], (0, 2), "from the side")):
        ax.plot(rest[:, a], rest[:, b], ".", ms=1.5, color=GREY)
        ax.scatter(dots.positions[:, a], dots.positions[:, b], s=area, color=BLUE)
        ax.set(aspect="equal", xlabel=f"{'xyz'[a]}, {unit}", ylabel=f"{'xyz'[b]}, {unit}", title=title)
        ax.ticklabel_format(scilimits=SHORT)
    axes[1].invert_yaxis()
    return drawing
