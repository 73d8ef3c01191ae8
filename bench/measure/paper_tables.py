"""Tables of the paper's method and of the locators: rows of cells, the first of which is the head."""

import numpy as np

from bench.measure.accuracy_tables import SENSORS, Rows
from bench.measure.simulator_tables import scientific

METHODS = {
    "fit": "`fit`",
    "soft": "`soft`",
    "threshold": "threshold and components (the paper's)",
    "opencv": "OpenCV SimpleBlobDetector, nearest",
}
OURS = ("fit", "soft")
WAYS = {
    "eq. 29": "eq. 29 alone (the paper's first contacts, on the rest surface)",
    "loop, paper": "the paper",
    "loop, paper, free part only": "the paper, energy over the free part only",
    "force balance": "tractions of force balance",
}
FORMS = {
    "material points": "material points",
    "fixed x y, once (eq. 22)": "fixed (x, y), one solution: the paper's eq. 22",
    "fixed x y, five times": "fixed (x, y), five iterations",
}
EXPERIMENTS = {
    "one cylinder, radius 5, 4 mm": "one cylinder of radius 5, 4 mm (Fig. 19)",
    "the same, 60 degrees": "the same at 60 degrees",
    "two points, 2 mm": "two points, 2 mm (Fig. 20)",
}


def locators(found: dict) -> Rows:
    """Errors of all locators over all sensors."""
    rows = [
        [
            row["images"],
            METHODS[row["method"]],
            f"{row['median']:.3f}",
            f"{row['p95']:.3f}",
            f"{row['found']:.4f}",
            str(row["wrong"]),
        ]
        for row in found["dots"]
        if row["sensor"] == "all"
    ]
    return [["images", "locator", "median, px", "95 %, px", "found", "over 3 px off"], *rows]


def locators_by_sensor(found: dict) -> Rows:
    """Of the package's locators, in images with noise."""
    cells = {sensor: [dots_found(found, sensor, method) for method in OURS] for sensor in SENSORS}
    return [["sensor", "fit: median / 95 %, found", "soft"], *([SENSORS[sensor], *row] for sensor, row in cells.items())]


def paper_dots(found: dict) -> Rows:
    """The paper's way to find dots beside the default locator, in images with noise."""
    cells = {sensor: [dots_found(found, sensor, method) for method in ("threshold", "fit")] for sensor in SENSORS}
    head = ["sensor", "threshold and components: median / 95 %, px, found", "`fit`"]
    return [head, *([SENSORS[sensor], *row] for sensor, row in cells.items())]


def dots_found(found: dict, sensor: str, method: str) -> str:
    (row,) = (r for r in found["dots"] if (r["sensor"], r["images"], r["method"]) == (sensor, "snr30", method))
    return f"{row['median']:.3f} / {row['p95']:.3f}, {row['found']:.4f}"


def locator_times(found: dict) -> Rows:
    """Milliseconds a frame, alone and in batches of 16."""
    rows = [
        [METHODS[method], f"{each['1']:.0f}", f"{each['16']:.0f}" + ("" if method in OURS else " (one after another)")]
        for method, each in found["milliseconds"].items()
    ]
    return [["locator", "single frames", "in batches of 16"], *rows]


def segmentation(found: dict) -> Rows:
    """Errors of contacts in mm, and of the surface over the displacement."""
    rows = []
    for way, name in WAYS.items():
        contacts, surface = (found[way][key] for key in ("contacts", "surface"))
        shape = ["", ""] if way == "eq. 29" else [f"{value:.3f}" for value in surface]
        rows.append([name, *(f"{value:.2f}" for value in contacts), *shape])
    return [["", "contacts: median", "worst", "surface: median", "worst"], *rows]


def segmentation_summary(results: dict) -> dict:
    """Medians and worst of every way, from one row a press."""
    summary = {}
    for way in WAYS:
        contacts, surface, _ = np.array([row[way] for row in results["segmentation"]]).T
        summary[way] = {
            name: [float(np.nanmedian(values)), float(np.nanmax(values))]
            for name, values in (("contacts", contacts), ("surface", surface))
        }
    return summary


def monge(found: dict) -> Rows:
    """Errors of the surface over the displacement, and how far it is from that of material points."""
    rows = []
    for form, name in FORMS.items():
        median, worst = found[form]["error"]
        rows.append([name, f"{median:.3f} ({worst:.3f})", f"{found[form]['apart']:.3f}" if found[form]["apart"] else ""])
    return [["", "error / displacement, median (worst)", "rms distance from the first row, mm"], *rows]


def monge_summary(results: dict) -> dict:
    """Medians and worst of every form, from one row a press."""
    of = {form: [row for row in results["monge"] if row["form"] == form] for form in FORMS}
    return {
        form: dict(
            error=[float(np.median([row["error"] for row in mine])), max(row["error"] for row in mine)],
            apart=float(np.median([row["apart"] for row in mine])),
        )
        for form, mine in of.items()
    }


def one_dimension(found: dict) -> Rows:
    """Error over displacement and depth of the deepest point, on a cross-section."""
    of = {(row["experiment"], row["estimator"]): row for row in found["profile"] if row["material"] == "neo-Hookean"}
    estimators = ("MinimumEnergyProfile", "ForceBalanceProfile")
    rows = [
        [text, *("{error:.2f}; {depth:.2f} mm".format(**of[name, estimator]) for estimator in estimators)]
        for name, text in EXPERIMENTS.items()
    ]
    return [["", "minimum energy", "force balance"], *rows]


def energy_steps(found: dict) -> Rows:
    """Worst and median error of minimum energy after so many steps."""
    columns = (("the sensor's", "float64"), ("harmonic", "float64"), ("the sensor's", "float32"))
    of = {(row["material"], row["precision"], row["steps"]): row for row in found["rows"]}
    rows = []
    for steps in dict.fromkeys(row["steps"] for row in found["rows"]):
        chosen = [of[material, precision, steps] for material, precision in columns]
        rows.append([str(steps), *(f"{scientific(row['worst'])} ({scientific(row['median'])})" for row in chosen)])
    return [["steps", "the sensor's material", "harmonic", "the sensor's material, float32"], *rows]
