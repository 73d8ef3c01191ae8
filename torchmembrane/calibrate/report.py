"""Report of a calibration: values with standard deviations and correlations, as text and as JSON."""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import ArrayLike

from ..files.atomic import make_folder, write_text
from ..files.digits import decimals

FINEST = 1e-6  # smallest relative deviation for the number of digits of a value
HIGH_CORRELATION = 0.95  # correlation above which two parameters are reported as hard to identify separately


class Estimate(Protocol):
    """The members of a fit, such as `calibrate.Fit`, that a report uses."""

    @property
    def values(self) -> np.ndarray:
        """Fitted values of the unknowns, `[n]`."""
        ...

    @property
    def covariance(self) -> np.ndarray:
        """Covariance of the values, `[n, n]`."""
        ...

    @property
    def deviations(self) -> np.ndarray:
        """Standard deviations of the values, `[n]`."""
        ...

    @property
    def noise(self) -> float:
        """Standard deviation of one residual."""
        ...


class Report(NamedTuple):
    """Values of a calibration with their uncertainty, and the residuals.

    Attributes:
        title: name of the calibration.
        names: names of the n parameters.
        units: units of the parameters.
        design: values of the parameters before the calibration, `[n]`.
        values: fitted values, `[n]`.
        deviations: standard deviations of the values, `[n]`.
        correlations: correlations of the values, `[n, n]`.
        pixels: pixels of the N points used, `[N, 2]`.
        residuals: residuals of these points, `[N, 2]`, px.
        noise: standard deviation of one residual, px.
        notes: further lines of text.
        intervals: lower and upper bounds of 95 % intervals of the values, `[n, 2]`; None: not computed.

    Example:
        >>> none = np.zeros((0, 2))
        >>> numbers = np.array([[380.0], [385.3], [0.2]])
        >>> found = Report("lens", ["fx"], ["px"], *numbers, np.eye(1), none, none, 0.0, [])
        >>> print("\\n".join(found.lines))
        lens
          fx                    385.30 ± 0.2       px      (before: 380)
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
    intervals: np.ndarray | None = None

    @classmethod
    def from_fit(
        cls,
        title: str,
        names: Sequence[str],
        units: Sequence[str],
        design: ArrayLike,
        fit: Estimate,
        pixels: np.ndarray,
        residuals: np.ndarray,
        notes: Sequence[str] = (),
    ) -> "Report":
        """Make a report of a fit whose first parameters are `names`; `residuals [..., 2]` are NaN for points not used."""
        n = len(names)
        covariance, deviations = fit.covariance[:n, :n], fit.deviations[:n]
        correlations = covariance / np.maximum(np.outer(deviations, deviations), 1e-300)
        used = np.isfinite(residuals).all(-1)
        return cls(
            title,
            list(names),
            list(units),
            np.asarray(design, float),
            fit.values[:n],
            deviations,
            correlations,
            pixels[used],
            residuals[used],
            fit.noise,
            list(notes),
        )

    @classmethod
    def without_parameters(cls, title: str, notes: Sequence[str] = ()) -> "Report":
        """Make a report of a calibration that has no parameters, only a surface."""
        numbers, none = np.zeros(0), np.zeros((0, 2))
        return cls(title, [], [], numbers, numbers, numbers, np.zeros((0, 0)), none, none, 0.0, list(notes))

    @property
    def confounded(self) -> list[tuple[str, str, float]]:
        """Pairs of parameters that the data can hardly identify separately, with their correlation."""
        rows, columns = np.nonzero(np.triu(np.abs(self.correlations) > HIGH_CORRELATION, 1))
        return [(self.names[i], self.names[j], float(self.correlations[i, j])) for i, j in zip(rows, columns, strict=True)]

    @property
    def lines(self) -> list[str]:
        """The report as text."""
        rows = zip(self.names, self.values, self.deviations, self.units, self.design, strict=True)
        lines = [
            f"  {name:<16}{value:>z12.{decimals(max(sd, FINEST * abs(value)), 2)}f} ± {sd:<10.2g}{unit:<7} (before: {old:g})"
            for name, value, sd, unit, old in rows
        ]
        for name, (low, high) in self._intervals.items():
            lines.append(f"  {name}: from {low:.3g} to {high:.3g} with a probability of 95 %")
        if len(self.residuals):
            rms = float(np.sqrt((self.residuals**2).mean()))
            lines.append(
                f"  residuals: {len(self.residuals)} points, {rms:.3f} px rms, at most {np.abs(self.residuals).max():.3f} px"
            )
        lines += [f"  hard to identify separately: {a} and {b} (correlation {c:+.4f})" for a, b, c in self.confounded]
        return [self.title, *lines, *(f"  {note}" for note in self.notes)]

    @property
    def _intervals(self) -> dict[str, list[float]]:
        """Interval of each parameter by its name; empty if intervals were not computed."""
        return {} if self.intervals is None else dict(zip(self.names, self.intervals.tolist(), strict=True))

    def write(self, folder: Path) -> None:
        """Write `report.json` to a folder, which is created if it does not exist."""
        rows = zip(self.names, self.values, self.deviations, self.units, self.design, strict=True)
        parameters: dict[str, dict[str, Any]] = {n: dict(value=v, deviation=s, unit=u, before=b) for n, v, s, u, b in rows}
        for name, interval in self._intervals.items():
            parameters[name]["interval"] = interval
        content = {
            "title": self.title,
            "parameters": parameters,
            "correlations": self.correlations.tolist(),
            "hardly_told_apart": self.confounded,
            "points": len(self.residuals),
            "noise_px": self.noise,
            "notes": self.notes,
        }
        write_text(make_folder(folder) / "report.json", json.dumps(content, indent=1))
