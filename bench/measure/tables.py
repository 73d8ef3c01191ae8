"""Which tables and figures the documents have, and of which parts they are made."""

from collections.abc import Callable
from pathlib import Path

import numpy as np

from bench.measure import accuracy_tables as accuracy
from bench.measure import scaling_tables as scaling
from bench.measure import speed_tables as speed

TABLES: dict[str, tuple[tuple[str, ...], Callable[..., accuracy.Rows]]] = {
    "readme": (("independent", "frame"), speed.readme),
    "accuracy-independent": (("independent",), accuracy.default_accuracy),
    "frame-times": (("frame", "exported-models"), speed.frame_times),
    "frame-units": (("frame",), speed.frame_units),
    "markers-independent": (("independent",), accuracy.marker_errors),
    "exported-models": (("exported-models",), speed.exported_models),
    "training": (("training",), speed.training),
    "solve-by-batch": (("solve",), speed.solve_by_batch),
    "solve-against-scipy": (("solve",), speed.balance_against_scipy),
    "paper-stages": (("solve",), speed.paper_stages),
    "scaling-exponents": (("scaling",), scaling.exponents),
    "scaling-costs": (("scaling",), scaling.costs),
}
"""Of every table its parts, and the function of their results that makes its rows."""
FIGURES: dict[str, tuple[str, Callable[[dict, Path], None]]] = {"docs/figures/scaling.png": ("scaling", scaling.draw)}
"""Of every figure its part, and the function that draws it."""


def kept(part: str, results: dict) -> dict:
    """What a record keeps of the results of a part: of errors case by case the median and the worst."""
    if part in ("independent", "cases"):
        of_each = {name: [float(np.nanmedian(values)), float(np.nanmax(values))] for name, values in results["surface"].items()}
        return results | dict(surface=of_each)
    return results
