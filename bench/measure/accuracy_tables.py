"""Tables of errors: rows of cells, the first of which is the head, from the results of parts."""

import math
from collections.abc import Callable
from itertools import pairwise

import numpy as np

from bench.accuracy.bands import by_force

Rows = list[list[str]]
SENSORS = {
    "dome15_fisheye": "dome, fisheye, far",
    "dome15_pinhole": "dome, pinhole, far",
    "dome15_port": "dome, through Plexiglas and water",
    "dome3_fisheye": "dome, fisheye, near",
    "finger_fisheye": "elliptic fingertip, fisheye",
    "halfcyl_fisheye": "half cylinder, fisheye",
}


def percent(value: float) -> str:
    """In per cent, below 2 % with one digit after the point.

    >>> percent(0.0132), percent(0.163)
    ('1.3 %', '16 %')
    """
    return f"{100 * value:.1f} %" if value < 0.02 else f"{100 * value:.0f} %"


ESTIMATORS = {
    "force balance": "**force balance**, the default",
    "the sensor's material": "minimum energy: the sensor's own material",
    "harmonic, triangles": "minimum energy: harmonic, triangles, exact volume",
    "the paper": "the paper (`--estimator paper`): harmonic, affine quadrilaterals, linear volume",
}
FORCE_BALANCE = {
    "surface: error over displacement, rms at the dots": ("force balance", percent),
    "contact point": ("force balance: contact", "{:.1f} mm".format),
    "force": ("force balance: force", percent),
    "pressure change": ("force balance: pressure_change", percent),
}


def default_accuracy(found: dict) -> Rows:
    """Errors of force balance in images with noise."""
    rows = [
        [name, *(text(value) for value in found["surface"][f"{key}, snr30"])] for name, (key, text) in FORCE_BALANCE.items()
    ]
    return [["", "median", "worst"], *rows]


def case_summary(results: dict) -> dict:
    """Of the errors case by case the median and the worst."""
    of_each = {name: [float(np.nanmedian(values)), float(np.nanmax(values))] for name, values in results["surface"].items()}
    return results | dict(surface=of_each)


def estimators(found: dict) -> Rows:
    """Errors of the surface over the displacement, for every estimator, in images with noise."""
    errors = {name: found["surface"][f"{label}, snr30"] for label, name in ESTIMATORS.items()}
    return [
        ["error of the surface over the displacement", "median", "worst"],
        *([name, f"{median:.2f}", f"{worst:.2f}"] for name, (median, worst) in errors.items()),
    ]


def marker_errors(found: dict) -> Rows:
    """Median and 95 % of the error of a dot's pixel, by sensor."""
    each = {(row["sensor"], row["images"]): f"{row['median']:.3f} / {row['p95']:.3f} px" for row in found["markers"]}
    return [
        ["sensor", "clean", "30 dB noise"],
        *([name, each[sensor, "clean"], each[sensor, "snr30"]] for sensor, name in SENSORS.items()),
    ]


def ablation(found: dict) -> Rows:
    """Force balance with one thing changed at a time."""
    head = ["changed", "", "surface", "worst", "contact, mm", "force", "pressure change", "unsettled"]
    return [head, *(ablation_row(row) for row in found["rows"])]


def ablation_row(row: dict) -> list[str]:
    """One row; without a surface in any press only how many did not settle."""
    if row["surface"] is None or math.isnan(row["surface"]):
        return [row["group"], row["label"], "no surface", "", "", "", "", str(row["unsettled"])]
    shares = (f"{row[name]:.0%}" for name in ("force", "pressure_change"))
    lengths = f"{row['surface']:.3f}", f"{row['worst']:.2f}", f"{row['contact']:.2f}"
    return [row["group"], row["label"], *lengths, *shares, str(row["unsettled"])]


def iterations(found: dict) -> Rows:
    """Errors of narrow presses by the number of steps on the finest grid."""
    head = ["on the finest grid", "surface: median", "90 %", "worst", "force: median", "90 %", "worst"]
    quantiles = {name: np.quantile(errors, (0.5, 0.9, 1.0), axis=0).T.ravel() for name, errors in found["rows"].items()}
    return [head, *([name, *(f"{value:.3f}" for value in values)] for name, values in quantiles.items())]


def ablation_summary(results: dict) -> dict:
    """The rows without the errors case by case."""
    return results | dict(rows=[{key: value for key, value in row.items() if key != "each"} for row in results["rows"]])


def spans(values: dict[str, list[float]], digits: int = 2) -> list[str]:
    """Median and 90 % of several quantities.

    >>> spans({"force": [0.051, 0.218]})
    ['0.05 / 0.22']
    """
    return [" / ".join(f"{value:.{digits}f}" for value in pair) for pair in values.values()]


def light_touches(found: dict) -> Rows:
    """Errors by the share of a stroke's largest force."""
    return [
        ["force", "frames", "force", "surface", "found"],
        *(
            [
                band_name(row),
                str(row["frames"]),
                *spans({name: row[name] for name in ("force", "surface")}),
                f"{row['found']:.2f}",
            ]
            for row in found["bands"]
        ),
    ]


def light_summary(results: dict) -> dict:
    """Errors by bands of the force."""
    return dict(bands=by_force([row | dict(found=row["place"] < row["spacing"]) for row in results["rows"]]))


def band_name(row: dict) -> str:
    """A band of the largest force in per cent.

    >>> band_name(dict(low=0.02, high=0.05)), band_name(dict(low=0, high=0.02)), band_name(dict(low=0.5, high=1.01))
    ('2 to 5 %', 'up to 2 %', '50 to 100 %')
    """
    low, high = (min(round(100 * row[end]), 100) for end in ("low", "high"))
    return f"{low} to {high} %" if low else f"up to {high} %"


def gauge(found: dict) -> Rows:
    """Errors without a pressure gauge, and with readings told to be good to two shares of the rest pressure."""
    head = ["by force (light strokes) or depth over size (presses)", "frames", "force: no gauge", "told 0.1 %", "told 1 %"]
    rows = [head + ["surface: no gauge", "told 1 %"]]
    for row in found["bands"]:
        name = band_name(row) if row["kind"] == "light" else f"depth {row['low']:g} to {row['high']:g}"
        rows.append([name, str(row["frames"]), *spans(row["force"]), *spans({k: row["surface"][k] for k in ("0.0", "0.01")})])
    return rows


def gauge_summary(results: dict) -> dict:
    """Medians and 90 % quantiles of the errors, for every band and gauge."""
    from bench.accuracy.gauge import BANDS

    rows, bands = results["rows"], []
    for kind, edges in BANDS.items():
        for low, high in pairwise(edges):
            chosen = [row for row in rows if row["kind"] == kind and low < row["at"] <= high]
            band = dict(kind=kind, low=low, high=high, frames=sum(row["told"] == 0 for row in chosen))
            for name in ("force", "surface"):
                of_each = {told: [row[name] for row in chosen if row["told"] == told] for told in (0.0, 0.001, 0.01)}
                band[name] = {
                    str(t): np.percentile(np.nan_to_num(e, nan=9.0), (50, 90)).tolist() for t, e in of_each.items() if e
                }
            bands.append(band)
    return dict(bands=[band for band in bands if band["frames"]])


def views(found: dict) -> Rows:
    """Errors of one view, of two, and of two from each of which a third of the dots is hidden."""
    names = {"one": "one view", "two": "two views", "hidden": "two, a third of the dots hidden from each"}
    rows = [
        [row["group"], names[row["seen"]], str(row["presses"]), str(row["ok"])]
        + spans({key: row[key] for key in ("shape", "depth", "force")}, 3)
        for row in found["bands"]
    ]
    return [["presses", "seen by", "number", "ok", "shape: median / 90 %", "depth", "force"], *rows]


def deep_and_soft_views(deep: dict, soft: dict) -> Rows:
    """The same of deep presses alone, and of soft sensors alone."""
    chosen = [[band for band in found["bands"] if band["group"] == group] for found, group in ((deep, "deep"), (soft, "soft"))]
    return views(dict(bands=[*chosen[0], *chosen[1]]))


def views_summary(results: dict) -> dict:
    """Medians and 90 % quantiles of the errors."""
    from bench.accuracy.views import bands

    return dict(bands=bands(results["presses"]))


def knocked(found: dict) -> Rows:
    """What is found of a knock of one camera, and by how much the answer differs from that without it; a column for each."""
    bands = found["bands"]

    def row(name: str, cell: Callable[[dict], str]) -> list[str]:
        return [name, *map(cell, bands)]

    return [
        row("", lambda band: {"turned": "turned by 1 degree", "shifted": "shifted by 0.5 mm"}[band["knock"]]),
        row("its image's dots move by, px, median / 90 %", lambda band: spans({"shift": band["shift"]}, 1)[0]),
        row("of that found as the second view's motion, median", lambda band: f"{band['found']:.2f}"),
        row("of that found as the first view's", lambda band: f"{band['other']:.2f}"),
        row("presses in which the second view is named", lambda band: f"{band['named']} of {band['presses']}"),
        row("answer against that without the knock: shape, median / 90 %", lambda band: spans({"shape": band["shape"]}, 3)[0]),
        row("the same of the force", lambda band: spans({"force": band["force"]}, 3)[0]),
        row("ok before the knock, and after", lambda band: f"{band['still']}, {band['status']}"),
        row("`UNEXPLAINED` after it", lambda band: str(band["unexplained"])),
    ]


def knocked_summary(results: dict) -> dict:
    """Medians and 90 % quantiles of each knock, and counts."""
    from bench.accuracy.knocked import bands

    return dict(bands=bands(results["presses"]))


def working_range(found: dict) -> Rows:
    """Shares of presses that are right and wrong with status ok, by what the sensor and the press are like."""
    rows = [
        [row["name"], str(row["presses"]), *(f"{row[key]:.{row['digits']}f}" for key in ("right", "cautious", "wrong"))]
        for row in found["groups"]
    ]
    return [["", "presses", "right, status ok", "right, another status", "wrong, status ok"], *rows]


GROUPS = {
    "filling": {value: value for value in ("liquid", "gas", "open")},
    "prestretch": {
        (1, 1.02): "prestretch to 1.02",
        (1.02, 1.1): "1.02 to 1.1",
        (1.1, 1.3): "1.1 to 1.3",
        (1.3, 9): "1.3 to 1.8",
    },
    "dots": {(0, 80): "fewer than 80 dots", (80, 150): "80 to 150", (150, 1e9): "more"},
    "markers": {"texture": "texture"},
    "seen": {(0, 0.999): "a view that cuts the markers"},
    "depth": {(0, 0.05): "depth up to 0.05", (0.05, 0.1): "0.05 to 0.1", (0.1, 0.2): "0.1 to 0.2", (0.2, 9): "0.2 to 0.3"},
    "clear": {
        (0, 0.05): "the contact ends within 0.05 of the rim",
        (0.05, 0.1): "0.05 to 0.1",
        (0.1, 0.2): "0.1 to 0.2",
        (0.2, 9): "farther",
    },
}


def range_summary(results: dict) -> dict:
    """Shares right and wrong of the presses of every group, from one row a press."""
    from bench.accuracy.range import is_right, verdict

    presses = [row for row in results["rows"] if row["kind"] == "press"]
    wide, narrow = ([row for row in presses if (row["width"] >= 1) == is_wide] for is_wide in (True, False))
    groups = [("all", wide)]
    for key, parts in GROUPS.items():
        for part, name in parts.items():
            inside = (lambda v, p=part: v == p) if isinstance(part, str) else (lambda v, p=part: p[0] <= v < p[1])
            dotted = [row for row in wide if key != "dots" or row["markers"] == "dots"]
            groups.append((name, [row for row in dotted if inside(row[key])]))
    groups.append(("narrower than the dots' spacing, not among the above", narrow))
    found = []
    for name, chosen in groups:
        verdicts = [verdict(row) for row in chosen]
        counts = {key: verdicts.count(key) for key in ("right", "wrong")}
        counts["cautious"] = sum(row["status"] != 0 and is_right(row) for row in chosen)
        shares = {key: count / max(len(chosen), 1) for key, count in counts.items()}
        found.append(dict(name=name, presses=len(chosen), digits=3 if name == "all" else 2, **shares))
    return dict(groups=found)


def intervals(found: dict) -> Rows:
    """How often one standard deviation holds the truth, by the share of the largest force."""
    head = ["force", "frames", *(f"{of}{what}" for of, what in (("force: ", "held"), ("", "width"), ("", "ranks")))]
    rows = []
    for row in found["bands"]:
        name = "all" if row["low"] is None else band_name(row)
        shares = [row[of][key] for of in ("force", "depth") for key in ("held", "width", "ranks")] + [row["depth"]["shallow"]]
        rows.append([name, str(row["frames"]), *(f"{share:.2f}" for share in shares)])
    return [head + ["depth: held", "width", "ranks", "too shallow by"], *rows]


def intervals_summary(results: dict) -> dict:
    """The bands."""
    return dict(bands=results["bands"])
