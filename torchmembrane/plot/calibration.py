"""What a calibration found: numbers with uncertainties as text and JSON, and figures."""

import json
from pathlib import Path
from typing import NamedTuple

import numpy as np
from matplotlib.figure import Figure

from .frames import BLUE, GREY, VERMILION, save

INDISTINGUISHABLE = 0.95  # correlation above which two settings are said to be hardly distinguishable
PARAMETERS_DRAWN = 24
GAINS = np.array([1, 2, 5, 10, 20, 50, 100, 200, 500, 1000, 2000, 5000])


class Report(NamedTuple):
    """A calibration's numbers and what they leave.

    names, units, design (value before), values, deviations: `[n]` each; correlations `[n, n]`; pixels and residuals `[N, 2]`
    px, of all points used; noise: of one residual, px; notes: lines for people.
    """

    title: str
    names: list[str]
    units: list[str]
    design: np.ndarray
    values: np.ndarray
    deviations: np.ndarray
    correlations: np.ndarray
    pixels: np.ndarray
    residuals: np.ndarray
    noise: float
    notes: list[str]

    @classmethod
    def of(cls, title, names, units, design, fit, pixels, residuals, notes=()) -> "Report":
        """From a `Fit` whose first numbers are those of `names`; pixels and residuals `[..., 2]`, NaN where not used."""
        n = len(names)
        covariance, deviations = fit.covariance[:n, :n], fit.deviations[:n]
        correlations = covariance / np.maximum(np.outer(deviations, deviations), 1e-300)
        used = np.isfinite(residuals).all(-1)
        return cls(
            title, list(names), list(units), np.asarray(design, float), fit.values[:n], deviations, correlations,
            pixels[used], residuals[used], fit.noise, list(notes),
        )  # fmt: skip

    @classmethod
    def without_parameters(cls, title: str, notes=()) -> "Report":
        """Of a calibration that gives a surface, and no numbers."""
        numbers, none = np.zeros(0), np.zeros((0, 2))
        return cls(title, [], [], numbers, numbers, numbers, np.zeros((0, 0)), none, none, 0.0, list(notes))

    @property
    def confused(self) -> list[tuple[str, str, float]]:
        """Pairs that the data hardly distinguish, with their correlation."""
        rows, columns = np.nonzero(np.triu(np.abs(self.correlations) > INDISTINGUISHABLE, 1))
        return [(self.names[i], self.names[j], float(self.correlations[i, j])) for i, j in zip(rows, columns, strict=True)]

    @property
    def lines(self) -> list[str]:
        rows = zip(self.names, self.values, self.deviations, self.units, self.design, strict=True)
        lines = [f"  {name:<16}{value:>12.5f} ± {sd:<10.2g}{unit:<7} (before: {old:g})" for name, value, sd, unit, old in rows]
        if len(self.residuals):
            rms = float(np.sqrt((self.residuals**2).mean()))
            lines.append(
                f"  residuals: {len(self.residuals)} points, {rms:.3f} px rms, at most {np.abs(self.residuals).max():.3f} px"
            )
        lines += [f"  hardly distinguishable: {a} and {b} (correlation {c:+.4f})" for a, b, c in self.confused]
        return [self.title, *lines, *(f"  {note}" for note in self.notes)]

    def write(self, folder: Path, drawing: Figure) -> None:
        """`report.json` and `report.png` in the folder."""
        rows = zip(self.names, self.values, self.deviations, self.units, self.design, strict=True)
        content = {
            "title": self.title,
            "parameters": {n: dict(value=v, deviation=s, unit=u, before=b) for n, v, s, u, b in rows},
            "correlations": self.correlations.tolist(),
            "hardly_told_apart": self.confused,
            "points": len(self.residuals),
            "noise_px": self.noise,
            "notes": self.notes,
        }
        folder.mkdir(parents=True, exist_ok=True)
        (folder / "report.json").write_text(json.dumps(content, indent=1), encoding="utf-8")
        save(drawing, folder / "report.png")


def fit_figure(report: Report, image_size: tuple[int, int]) -> Figure:
    """Residuals in the image (arrows, magnified), their scatter, and the correlations of what was fitted."""
    drawing = Figure(figsize=(15, 4.6), layout="constrained")
    drawing.suptitle(report.title)
    axes = drawing.subplots(1, 3, width_ratios=(1.3, 1, 1.15))
    draw_residuals(axes[0], report, image_size)
    draw_scatter(axes[1], report)
    draw_correlations(axes[2], report)
    return drawing


def draw_residuals(axes, report: Report, image_size: tuple[int, int]) -> None:
    width, height = image_size
    typical = np.sqrt((report.residuals**2).sum(-1).mean()) if len(report.residuals) else 1.0
    gain = max(GAINS[GAINS <= max(1.0, 0.03 * width / max(typical, 1e-9))])
    axes.quiver(*report.pixels.T, *(gain * report.residuals).T, angles="xy", scale_units="xy", scale=1, width=0.002, color=BLUE)
    axes.set(xlim=(-0.5, width - 0.5), ylim=(height - 0.5, -0.5), aspect="equal", xlabel="u, px", ylabel="v, px")
    axes.set_title(f"measured less modelled, x {gain:g}")


def draw_scatter(axes, report: Report) -> None:
    angle = np.linspace(0, 2 * np.pi, 200)
    axes.plot(*report.residuals.T, ".", ms=2, color=BLUE)
    for times in (1, 3):
        axes.plot(times * report.noise * np.cos(angle), times * report.noise * np.sin(angle), color=VERMILION, lw=1)
    axes.set(aspect="equal", xlabel="u, px", ylabel="v, px", title=f"residuals; circles: 1 and 3 x {report.noise:.3f} px")
    axes.axhline(0, color=GREY, lw=0.5)
    axes.axvline(0, color=GREY, lw=0.5)


def draw_correlations(axes, report: Report) -> None:
    names = report.names[:PARAMETERS_DRAWN]
    n = len(names)
    shown = axes.imshow(report.correlations[:n, :n], vmin=-1, vmax=1, cmap="RdBu")
    axes.set_xticks(range(n), names, rotation=60, ha="right", fontsize=8)
    axes.set_yticks(range(n), names, fontsize=8)
    axes.set_title("correlations")
    axes.figure.colorbar(shown, ax=axes, shrink=0.8)


def surface_figure(report: Report, image_size: tuple[int, int], places: np.ndarray, correction, unit: str) -> Figure:
    """Residuals in the image where there are any, and how far the surface was moved and how surely, seen along the axis.

    Arguments: `places [V, 3]` of the surface's vertices, its `Correction`.
    """
    panels = 3 if len(report.residuals) else 2
    drawing = Figure(figsize=(5 * panels, 4.6), layout="constrained")
    drawing.suptitle(report.title)
    axes = drawing.subplots(1, panels)
    if panels == 3:
        draw_residuals(axes[0], report, image_size)
    offset = np.abs(correction.offsets).max()
    for ax, values, title, options in (
        (axes[-2], correction.offsets, "moved outwards", dict(cmap="RdBu", vmin=-offset, vmax=offset)),
        (axes[-1], correction.deviations, "standard deviation", dict(cmap="viridis")),
    ):
        shown = ax.tripcolor(*places[:, :2].T, values, shading="gouraud", **options)
        ax.set(aspect="equal", xlabel=f"x, {unit}", ylabel=f"y, {unit}", title=f"{title}, {unit}")
        ax.invert_yaxis()
        drawing.colorbar(shown, ax=ax, shrink=0.8)
    return drawing


def material_figure(report: Report, found, names: list[str]) -> Figure:
    """Losses over the prestretch and the estimate, and forces found and measured where any are, of a `MaterialFit`."""
    known = np.isfinite(found.forces).all(1)
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
        axes[1].plot(*found.forces[known].T, "o", color=BLUE)
        for name, force in zip(names, found.forces, strict=True):
            if np.isfinite(force).all():
                axes[1].annotate(name, force, fontsize=8)
        top = 1.1 * found.forces[known].max()
        axes[1].plot([0, top], [0, top], color=GREY, lw=1)
        axes[1].set(xlabel="force found, N", ylabel="force measured, N", aspect="equal")
    return drawing


def layout_figure(title: str, sensor, dots) -> Figure:
    """The wanted pattern in the image, and its dots on the rest surface, from above and from the side."""
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
    axes[1].invert_yaxis()
    return drawing
