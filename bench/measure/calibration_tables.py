"""Tables of calibration, known weights, laws of contact and spec sheets: rows of cells, the first the head, or a paragraph."""

import re

import numpy as np

from bench.measure.accuracy_tables import Rows

STEPS = {
    "lens, pinhole": "`camera`: pinhole, 640 x 480, 12 images",
    "lens, fisheye": "`camera`: fisheye, 12 images",
    "ports, pinhole, air": "`ports`: pinhole, images in air (truth: distance 4 mm, thickness 3 mm, index 1.49, medium 1.33)",
    "ports, pinhole, medium": "`ports`: six images in the medium",
    "ports, pinhole, both": "`ports`: both together",
    "rest, fingertip": "`rest`: `fingertip`, 1 degree and 0.3 mm off",
    "rest, half_cylinder": "`rest`: `half_cylinder`, through Plexiglas and water",
    "rest, bubble": "`rest`: `bubble`",
    "views, fingertip": "`views`: `fingertip`, five, travel 1.5 mm known to 0.005",
    "views, half_cylinder": "`views`: `half_cylinder`, five, travel 3 mm known to 0.005",
}
NUMBERS = {
    "focal": "focal length {:.2f} px",
    "centre": "centre {:.2f} px",
    "port_distance": "distance {:.3f} mm",
    "port_thickness": "thickness {:.3f} mm",
    "port_index": "index {:.3f}",
    "medium_index": "medium {:.5f}",
    "tilt": "tilt {:.3f} degrees",
    "offset": "offset {:.3f} mm",
    "turn": "turns {:.3f} degrees",
    "place": "places {:.3f} mm",
}
"""What is fitted, by the names of the numbers without their index."""
SURFACES = {
    "views, fingertip": "`views`: `fingertip`",
    "views, half_cylinder": "`views`: `half_cylinder`",
    "depth, fingertip": "`depth`: `fingertip`, 0.2 mm noise a pixel",
    "depth, half_cylinder": "`depth`: `half_cylinder`",
}


def calibration_steps(found: dict) -> Rows:
    """Reported deviations, and the largest error over its deviation."""
    rows = []
    for what, text in STEPS.items():
        step = found["steps"][what]
        deviations = ", ".join(NUMBERS[name].format(value) for name, value in step["deviations"].items())
        seeds = f" ({step['seeds']} seeds)" if step["seeds"] > 1 else ""
        rows.append([text, deviations, f"{step['worst']:.1f}{seeds}"])
    return [["step", "deviations", "worst"], *rows]


def interval_coverage(found: dict) -> Rows:
    """How often one standard deviation holds the truth, and how wide it is."""
    rows = []
    for group in found["groups"]:
        told = [
            f"{held:.0%}, {width:.1%}".replace("%", " %") for held, width in zip(group["held"], group["width"], strict=True)
        ]
        off = "all" if group["off"] is None else f"{group['off']:.0%}".replace("%", " %")
        rows.append([off, str(group["sensors"]), *told])
    return [["height stated to", "windows", "prestretch", "modulus", "force of a third press"], *rows]


def coverage_summary(results: dict) -> dict:
    """Of all windows together, and by how well their height is known."""
    return dict(groups=results["groups"])


def calibrated_surfaces(found: dict) -> Rows:
    """Errors of dots and of surfaces, before and after."""
    rows = []
    for what, text in SURFACES.items():
        row = found["surfaces"][what]
        surface = f"{row['surface_before']:.3f} / {row['surface_after']:.3f}"
        rows.append([text, f"{row['dots']:.3f}", surface, f"{row['surface_deviation']:.3f}"])
    return [["step", "dots off by, mm rms", "surface off by, before / after, mm rms", "its deviation"], *rows]


def layout(found: dict) -> str:
    """A sentence on dots that are made for a lattice in the image."""
    rows = found["layout"]
    seen = ", ".join(f"{row['found']} of {row['dots']} found on `{row['sensor']}`" for row in rows)
    off = max(row["rms"] for row in rows)
    return (
        f"`layout`: dots for a lattice of 30 px, made and photographed, appear {off:.2f} px rms from where they were wanted "
        f"({seen})."
    )


def pose_effect(found: dict) -> Rows:
    """Errors of the dots with a wrong pose, a calibrated one and the true one."""
    names = {"minimum-energy": "minimum energy", "force-balance": "force balance"}
    rows = []
    for row in found["effect"]:
        cells = ["{:.3f} ({:.2f})".format(*row[file]) for file in ("design", "calibrated", "truth")]
        rows.append([f"`{row['sensor']}`", names[row["estimator"]], *cells])
    return [["sensor", "estimator", "design", "calibrated", "truth"], *rows]


def pose_effect_alone(found: dict) -> str:
    """A sentence on what rest offsets do that are not nulled."""
    of = {row["sensor"]: row["not nulled"] for row in found["effect"] if row["estimator"] == "force-balance"}
    design, calibrated = ([f"{100 * of[name][k]:.0f}" for name in ("fingertip", "half_cylinder")] for k in (0, 1))
    return (
        f"If the offsets of the dots at rest are not subtracted (`from_pixels` without `rest_pixels`), the displacement is "
        f"wrong by {design[0]} % (`fingertip`) and {design[1]} % (`half_cylinder`) "
        f"with the design and force balance, and by {calibrated[0]} and {calibrated[1]} % after calibration."
    )


def calibration_summary(results: dict) -> dict:
    """Of every step its deviations and worst error; of surfaces and poses their errors."""
    rows = [row for part in ("lens", "ports", "rest", "views", "depth") for row in results[part]]
    of = {what: [row for row in rows if row["what"] == what] for what in {row["what"] for row in rows}}
    steps = {what: step(of[what]) for what in STEPS}
    keys = ("dots", "surface_before", "surface_after", "surface_deviation")
    surfaces = {what: {key: of[what][0][key] for key in keys} for what in SURFACES}
    layouts = [row | dict(sensor=row["what"].removeprefix("pattern, ")) for row in results["layout"]]
    return dict(steps=steps, surfaces=surfaces, layout=layouts, effect=effects(results["effect"]))


def step(rows: list[dict]) -> dict:
    """Of the seeds of one step: the largest deviation of each kind of number, the largest error over its deviation."""
    deviations: dict[str, float] = {}
    for row in rows:
        for name, value in zip(row["names"], row["deviation"], strict=True):
            kind = re.sub(r"(_[xyz])?(\[\d+\])?$", "", name)
            if kind in NUMBERS:
                deviations[kind] = max(deviations.get(kind, 0.0), value)
    return dict(deviations=deviations, worst=max(row["worst"] for row in rows), seeds=len(rows))


def effects(rows: list[dict]) -> list[dict]:
    """One row for each sensor and estimator."""
    found: dict[tuple[str, str], dict] = {}
    for row in rows:
        of = found.setdefault((row["sensor"], row["estimator"]), dict(sensor=row["sensor"], estimator=row["estimator"]))
        if row["how"] == "nulled":
            of[row["file"]] = [row["surface"], row["displacement"]]
        elif row["file"] in ("design", "calibrated"):
            of.setdefault("not nulled", []).append(row["displacement"])
    return list(found.values())


def material(found: dict) -> Rows:
    """Prestretch and modulus from three presses of known force."""
    rows = []
    for row in found["material"]:
        if row["known"] == 3:
            each = ", ".join(f"{value:.2f} ± {deviation:.2f}" for value, deviation in row["each"])
            cells = [
                f"{value:.3f} ± {deviation:.3f}" for value, deviation in zip(row["values"], row["deviations"], strict=True)
            ]
            rows.append([f"`{row['sensor']}`", f"{row['prestretch']:g}", cells[0], each, cells[1], f"{row['worst']:.1f}"])
    head = ["sensor", "prestretch", "found", "from each image alone", "modulus found", "worst error / deviation"]
    return [head, *rows]


def gauge_modulus(found: dict) -> Rows:
    """The modulus from readings of a gauge: of one press or three, since rest, in brackets with an image at rest."""
    of: dict[tuple[str, float], dict] = {}
    for row in found["gauge"]:
        of.setdefault((row["sensor"], row["prestretch"]), {})[row["known"]] = row
    rows = []
    for (sensor, prestretch), known in of.items():
        cells = []
        for number in ("one", "three"):
            each = [known.get(key) for key in (number, f"rest and {number}")]
            alone, rest = (row and f"{row['values'][1]:.3f} ± {row['deviations'][1]:.3f}" for row in each)
            cells.append(f"{alone} ({rest})" if rest else str(alone))
        rises = ", ".join(f"{rise:.2f}" for rise in known["one"]["rises"][1:])
        rows.append([f"`{sensor}`", f"{prestretch:g}", rises, *cells])
    return [["sensor", "prestretch", "rise over rest pressure", "from one press", "from three"], *rows]


def rest_shapes(found: dict) -> Rows:
    """What `check` says of rest surfaces that are off by a known share."""
    rows = []
    for group in found["groups"]:
        digits = {"left over": 2 if group["wrong"] else 3, "distance / size": 3, "pressure ratio": 2}
        spans = ["{:.{d}f} ({:.{d}f}, {:.{d}f})".format(*group["spans"][name], d=d) for name, d in digits.items()]
        doubted = f"{100 * group['doubted']:.0f} %"
        rows.append([f"{100 * group['wrong']:.0f} % ({group['sensors']} surfaces)", *spans, doubted])
    head = [
        "off by",
        "left over",
        "distance from the nearest sheet / size",
        "its pressure over the file's",
        "doubted by `check`",
    ]
    return [head, *rows]


WEIGHED = {
    "five domes and fingertips with liquid": ("dome_24", "dome_24_slack", "dome_40", "fingertip_22", "fingertip_16"),
    "two flat caps with liquid": ("cap_30", "cap_50"),
    "three half cylinders": ("cylinder_20", "cylinder_12", "cylinder_40_gas"),
    "a dome, a fingertip, a cap and a bubble with gas, 16 to 80 mm": (
        "dome_16_gas",
        "fingertip_30_gas",
        "cap_80_gas",
        "bubble_80",
    ),
    "a bubble with gas, 40 mm": ("bubble_40",),
    "a bubble with gas, 60 mm, prestretch 1.1": ("bubble_60",),
    "the same bubble, prestretch 1.6": ("bubble_60_taut",),
    "an open fingertip, an open dome and an open flat cap": ("fingertip_24_open", "dome_60_open", "cap_36_open"),
}
"""Groups of the sensors of `bench.accuracy.weight`."""


def weight(found: dict) -> Rows:
    """Forces after one known weight, found over true, by groups of sensors."""
    rows = []
    for row in found["groups"]:
        accepted = f"{row['accepted']} of {row['weights']}"
        rows.append([row["sensors"], accepted, "{:.2f} to {:.2f}".format(*row["ratios"]), str(row["unsure"])])
    middle, most, largest = (f"{100 * value:.1f} %" for value in found["errors"])
    off = f"off by {middle} in the median, by less than {most} in nine of ten cases, by at most {largest}"
    rows.append([f"all: {found['forces']} forces", "", off, ""])
    return [["sensors", "weights accepted", "forces of the other presses, estimated / true", "said to be uncertain"], *rows]


def weight_summary(results: dict) -> dict:
    """The range of the ratios of every group, and the errors of all."""
    groups = []
    for text, sensors in WEIGHED.items():
        rows = [row for row in results["rows"] if row["sensor"] in sensors]
        accepted = [row for row in rows if "refused" not in row]
        ratios = [ratio for row in accepted for ratio in row["ratios"]]
        unsure = sum(len(row["unsure"]) for row in accepted)
        group = dict(sensors=text, weights=len(rows), accepted=len(accepted), unsure=unsure)
        groups.append(group | dict(ratios=[min(ratios), max(ratios)]))
    errors = [abs(ratio - 1) for row in results["rows"] for ratio in row.get("ratios", ())]
    return dict(groups=groups, forces=len(errors), errors=np.quantile(errors, (0.5, 0.9, 1)).tolist())


def contact_law(found: dict) -> Rows:
    """Errors of the law of contact, and forces elsewhere over the law's."""
    rows = []
    for row in found["rows"]:
        elsewhere = "{:.2f} to {:.2f}".format(*np.nanquantile(row["elsewhere"], (0, 1)))
        errors = [f"{100 * row[key]:.1f} %" for key in ("fitted", "held_out")]
        rows.append([f"`{row['sensor']}`", *errors, elsewhere, f"{row['plate']:.2g}"])
    head = ["", "law off by at most: fitted", "held out", "balls elsewhere, 0.25 of the size off the rim", "a plate on the top"]
    return [head, *rows]


def example_sheet(found: dict) -> str:
    """The spec sheet of the example sensor."""
    return sheet(found["sheets"][0])


def bubble_sheet(found: dict) -> str:
    """The spec sheet of the preset bubble."""
    return sheet(found["sheets"][1])


def sheet(of: dict) -> str:
    """A sheet as the command prints it, and the command."""
    lines = "\n".join(f"    {line}".rstrip() for line in of["lines"])
    took = f", {of['seconds']:.0f} s of processor time" if of["seconds"] else ""
    return f"`torchmembrane check {of['sensor']} --accuracy`{took}:\n\n{lines}"
