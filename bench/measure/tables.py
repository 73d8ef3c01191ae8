"""Which tables and figures the documents have, and of which parts they are made."""

from collections.abc import Callable
from pathlib import Path

import numpy as np

import bench.measure.accuracy_tables as accuracy
import bench.measure.scaling_tables as scaling
import bench.measure.speed_tables as speed
from bench.measure.parts import PARTS

TABLES: dict[str, tuple[tuple[str, ...], Callable[..., accuracy.Rows]]] = {
    "readme": (("independent", "frame"), speed.readme),
    "accuracy-independent": (("independent",), accuracy.default_accuracy),
    "accuracy-cases": (("cases",), accuracy.default_accuracy),
    "estimators-independent": (("independent",), accuracy.estimators),
    "estimators-cases": (("cases",), accuracy.estimators),
    "frame-times": (("frame", "exported-models"), speed.frame_times),
    "frame-units": (("frame",), speed.frame_units),
    "markers-independent": (("independent",), accuracy.marker_errors),
    "markers-cases": (("cases",), accuracy.marker_errors),
    "exported-models": (("exported-models",), speed.exported_models),
    "training": (("training",), speed.training),
    "solve-by-batch": (("minimum-energy", "force-balance"), speed.solve_by_batch),
    "solve-against-scipy": (("force-balance",), speed.balance_against_scipy),
    "paper-stages": (("paper-chain",), speed.paper_stages),
    "scaling-exponents": (("scaling",), scaling.exponents),
    "scaling-costs": (("scaling",), scaling.costs),
}
"""Of every table its parts, and the function of their results that makes its rows."""
FIGURES: dict[str, tuple[str, Callable[[dict, Path], None]]] = {"docs/figures/scaling.png": ("scaling", scaling.draw)}
"""Of every figure its part, and the function that draws it."""


def paths_of(table: str) -> tuple[str, ...]:
    """Paths that the figures of a table depend on."""
    return tuple(sorted({path for part in TABLES[table][0] for path in PARTS[part].paths}))


def kept(part: str, results: dict) -> dict:
    """What a record keeps of the results of a part: of errors case by case the median and the worst."""
    if part in ("independent", "cases"):
        of_each = {name: [float(np.nanmedian(values)), float(np.nanmax(values))] for name, values in results["surface"].items()}
        return results | dict(surface=of_each)
    return results
