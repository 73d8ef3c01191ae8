"""Which tables and figures the documents have, and of which parts they are made."""

from collections.abc import Callable
from pathlib import Path

import bench.measure.accuracy_tables as accuracy
import bench.measure.calibration_tables as calibration
import bench.measure.paper_tables as paper
import bench.measure.paragraphs as paragraphs
import bench.measure.range_tables as working_range
import bench.measure.recording_tables as recordings
import bench.measure.robustness_tables as robustness
import bench.measure.scaling_tables as scaling
import bench.measure.simulator_tables as simulator
import bench.measure.speed_tables as speed
from bench.measure.parts import PARTS

TABLES: dict[str, tuple[tuple[str, ...], Callable[..., accuracy.Rows | str]]] = {
    "readme": (("independent", "real-bubble", "frame", "live"), speed.readme),
    "accuracy-independent": (("independent",), accuracy.default_accuracy),
    "accuracy-cases": (("cases",), accuracy.default_accuracy),
    "estimators-independent": (("independent",), accuracy.estimators),
    "estimators-cases": (("cases",), accuracy.estimators),
    "frame-times": (("frame",), speed.frame_times),
    "markers-independent": (("independent",), accuracy.marker_errors),
    "markers-cases": (("cases",), accuracy.marker_errors),
    "exported-models": (("exported-models",), speed.exported_models),
    "loading": (("loading",), paragraphs.loading),
    "exports": (("exports",), paragraphs.exports),
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
    "window-intervals": (("windows",), paragraphs.window_intervals),
    "rim": (("rim",), paragraphs.rim),
    "calibration-coverage": (("calibration-coverage",), calibration.interval_coverage),
    "cli-errors": (("cli-errors",), simulator.cli_errors),
    "memory": (("memory",), simulator.memory),
    "throughput": (("throughput",), paragraphs.throughput),
    "ablation": (("ablation",), accuracy.ablation),
    "iterations": (("iterations",), accuracy.iterations),
    "light": (("light",), accuracy.light_touches),
    "light-independent": (("light-independent",), paragraphs.light_independent),
    "at-rest": (("at-rest",), paragraphs.at_rest),
    "sequence": (("sequence",), paragraphs.sequence),
    "gauge": (("gauge",), accuracy.gauge),
    "rough-gauge": (("rough-gauge",), paragraphs.rough_gauge),
    "intervals": (("intervals",), accuracy.intervals),
    "views": (("views",), accuracy.views),
    "views-deep-and-soft": (("views-deep", "views-soft"), accuracy.deep_and_soft_views),
    "knocked": (("knocked",), accuracy.knocked),
    "range": (("range",), accuracy.working_range),
    "readme-range": (("range",), working_range.readme_range),
    "limits": (("range", "light", "intervals", "degraded-images", "weight"), working_range.limits),
    "pins": (("pins",), working_range.pins),
    "bubble-surface": (("real-bubble",), recordings.bubble_surface),
    "bubble-estimators": (("real-bubble",), recordings.bubble_estimators),
    "bubble-forces": (("real-bubble",), recordings.bubble_forces),
    "bubble-gauge": (("real-bubble",), recordings.bubble_gauge),
    "tactip": (("real-pins",), recordings.tactip),
    "finger": (("real-pins",), recordings.finger),
    "finger-levers": (("real-pins",), recordings.finger_levers),
    "drift": (("drift",), robustness.drift),
    "life": (("life",), robustness.life),
    "mistakes": (("mistakes",), robustness.mistakes),
    "mismatched": (("mismatched",), robustness.mismatched),
    "degraded-images": (("degraded-images",), robustness.degraded_images),
    "crash-recovery": (("crash-npz", "crash-parquet", "crash-ray"), robustness.crash_recovery),
    "fuzz": (("fuzz",), robustness.fuzz),
    "calibration-steps": (("calibration",), calibration.calibration_steps),
    "calibrated-surfaces": (("calibration",), calibration.calibrated_surfaces),
    "layout": (("calibration",), calibration.layout),
    "pose-effect": (("calibration",), calibration.pose_effect),
    "pose-effect-alone": (("calibration",), calibration.pose_effect_alone),
    "material": (("material",), calibration.material),
    "gauge-modulus": (("gauge-modulus",), calibration.gauge_modulus),
    "rest-shapes": (("rest-shapes",), calibration.rest_shapes),
    "weight": (("weight",), calibration.weight),
    "contact-law": (("contact-law",), calibration.contact_law),
    "example-sheet": (("spec-sheets",), calibration.example_sheet),
    "bubble-sheet": (("spec-sheets",), calibration.bubble_sheet),
    "live": (("live", "live-exported"), speed.live),
    "walk-sensor": (("walks",), speed.walk_sensor),
    "walk-bubble": (("walks",), speed.walk_bubble),
    "ros": (("ros",), speed.ros),
    "precision": (("precision",), speed.precision),
    "energy-steps": (("energy-steps",), paper.energy_steps),
    "scaling-exponents": (("scaling",), scaling.exponents),
    "scaling-costs": (("scaling",), scaling.costs),
}
"""Of every table its parts, and the function of their results that makes its rows, or its paragraph."""
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
    "rough-gauge": accuracy.gauge_summary,
    "light-independent": paragraphs.light_independent_summary,
    "exports": paragraphs.exports_summary,
    "real-bubble": recordings.bubble_summary,
    "intervals": accuracy.intervals_summary,
    "views": accuracy.views_summary,
    "views-deep": accuracy.views_summary,
    "views-soft": accuracy.views_summary,
    "knocked": accuracy.knocked_summary,
    "range": accuracy.range_summary,
    "segmentation": paper.segmentation_summary,
    "monge": paper.monge_summary,
    "simulator-independent": simulator.agreement_summary,
    "pins": working_range.pins_summary,
    "drift": robustness.drift_summary,
    "life": robustness.life_summary,
    "mistakes": robustness.mistakes_summary,
    "mismatched": robustness.mismatched_summary,
    "degraded-images": robustness.degraded_summary,
    "crash-npz": robustness.crash_summary,
    "crash-parquet": robustness.crash_summary,
    "crash-ray": robustness.crash_summary,
    "fuzz": robustness.fuzz_summary,
    "calibration": calibration.calibration_summary,
    "calibration-coverage": calibration.coverage_summary,
    "weight": calibration.weight_summary,
}
"""Of a part whose results have a row for every case: what its record keeps of them."""
