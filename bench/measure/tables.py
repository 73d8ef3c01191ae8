"""Which tables and figures the documents have, and of which parts they are made."""

from collections.abc import Callable
from pathlib import Path

import bench.measure.accuracy_tables as accuracy
import bench.measure.paper_tables as paper
import bench.measure.scaling_tables as scaling
import bench.measure.simulator_tables as simulator
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
    "gpu": (("gpu",), speed.gpu),
    "solve-against-scipy": (("force-balance",), speed.balance_against_scipy),
    "paper-stages": (("paper-chain",), speed.paper_stages),
    "locators": (("locators",), paper.locators),
    "locators-by-sensor": (("locators",), paper.locators_by_sensor),
    "locator-times": (("locators",), paper.locator_times),
    "paper-dots": (("locators",), paper.paper_dots),
    "segmentation": (("segmentation",), paper.segmentation),
    "monge": (("monge",), paper.monge),
    "one-dimension": (("one-dimension",), paper.one_dimension),
    "closed-forms": (("simulator",), simulator.closed_forms),
    "simulated-presses": (("simulator",), simulator.simulated_presses),
    "rendered-dots": (("simulator",), simulator.rendered_dots),
    "simulator-seconds": (("simulator",), simulator.simulator_seconds),
    "agreement": (("simulator-independent",), simulator.agreement),
    "window-mistakes": (("window-mistakes",), simulator.window_mistakes),
    "windows": (("windows",), simulator.windows),
    "cli-errors": (("cli-errors",), simulator.cli_errors),
    "memory": (("memory",), simulator.memory),
    "ablation": (("ablation",), accuracy.ablation),
    "light": (("light",), accuracy.light_touches),
    "gauge": (("gauge",), accuracy.gauge),
    "intervals": (("intervals",), accuracy.intervals),
    "views": (("views",), accuracy.views),
    "range": (("range",), accuracy.working_range),
    "scaling-exponents": (("scaling",), scaling.exponents),
    "scaling-costs": (("scaling",), scaling.costs),
}
"""Of every table its parts, and the function of their results that makes its rows."""
FIGURES: dict[str, tuple[str, Callable[[dict, Path], None]]] = {"docs/figures/scaling.png": ("scaling", scaling.draw)}
"""Of every figure its part, and the function that draws it."""


def paths_of(table: str) -> tuple[str, ...]:
    """Paths that the figures of a table depend on."""
    return tuple(sorted({path for part in TABLES[table][0] for path in PARTS[part].paths}))


SUMMARIES: dict[str, Callable[[dict], dict]] = {
    "independent": accuracy.case_summary,
    "cases": accuracy.case_summary,
    "ablation": accuracy.ablation_summary,
    "light": accuracy.light_summary,
    "gauge": accuracy.gauge_summary,
    "intervals": accuracy.intervals_summary,
    "views": accuracy.views_summary,
    "range": accuracy.range_summary,
    "segmentation": paper.segmentation_summary,
    "monge": paper.monge_summary,
    "simulator-independent": simulator.agreement_summary,
}
"""Of a part whose results have a row for every case: what its record keeps of them."""
