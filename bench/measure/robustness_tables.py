"""Tables of wrong input, drift, wrong matches and killed jobs: rows of cells, the first the head, or a paragraph."""

import itertools

import numpy as np

from bench.measure.accuracy_tables import Rows, percent

WRONG = 0.25
"""Error over the press from which a result is wrong."""
LARGEST_GROWTH = 1000
"""Relative growth of an error above which its number says nothing more."""


def drift(found: dict) -> Rows:
    """False alarms, and after how many frames or at which size a drift is reported."""
    noise, touch, slow = (found[part] for part in ("noise", "touch", "slow"))
    frames, alarms = noise["frames"], noise["alarms"]
    rows = [
        [
            f"false alarms: {noise['streams']} streams of 200 frames at rest, each from another rest image",
            f"{alarms} of {frames:,} frames; z at most {noise['certainty']:.1f}",
        ],
        [f"false alarms in {touch['streams']} streams with light touches", str(touch["said"])],
        [
            f"drift of 0.001 px a frame, swelling or sagging across, {slow['streams']} streams",
            f"{slow['said']} reported, at {slow['median']:.3g} px in the median, {slow['most']:.3g} at most; "
            f"{slow['without_contact']} before any contact is found",
        ],
    ]
    for part, text in (("jump", "from one frame to the next"), ("start", "before the first frame")):
        rows += [jump_row(text, row) for row in found[part]]
    return [["", ""], *rows]


def jump_row(text: str, row: dict) -> list[str]:
    """Of drifts of one size that come at once."""
    said = f"{row['said']} reported, after {row['median']:.0f} frames in the median, at most {row['most']}"
    if "drift" in row:
        said += "; `drift` {:.3f} to {:.3f} px".format(*row["drift"])
    return [f"{row['size']:g} px {text} (swelling, softening, sagging, camera), {row['streams']} streams", said]


def drift_summary(results: dict) -> dict:
    """Counts and delays over all sensors."""
    from bench.robustness.drift import STREAM

    of = {part: [row for row in results["rows"] if row["part"] == part] for part in ("noise", "jump", "start", "slow", "touch")}
    noise, slow = of["noise"], of["slow"]
    true = [row["true"] for row in slow if row["said"]]
    found = dict(
        noise=dict(
            streams=len(noise) * (STREAM // 2 + 1),
            frames=sum(row["frames"] for row in noise),
            alarms=sum(row["alarms"] for row in noise),
            certainty=max(row["certainty"] for row in noise),
        ),
        touch=dict(streams=len(of["touch"]), said=sum(row["said"] for row in of["touch"])),
        slow=dict(streams=len(slow), said=len(true), median=float(np.median(true)), most=max(true)),
    )
    found["slow"]["without_contact"] = sum(bool(row["said"]) and row["contacts_before"] == 0 for row in slow)
    for part in ("jump", "start"):
        found[part] = [jump_summary(part, size, [row for row in of[part] if row["size"] == size]) for size in (0.1, 0.2)]
    return found


def jump_summary(part: str, size: float, rows: list[dict]) -> dict:
    said = [row for row in rows if row["said"]]
    delays = [row["said"] for row in said]
    found = dict(size=size, streams=len(rows), said=len(said), median=float(np.median(delays)), most=max(delays))
    drifts = [row["drift"] for row in said]
    return found | (dict(drift=[min(drifts), max(drifts)]) if part == "start" else {})


MISTAKES = {
    "none": ("none", ("",)),
    "far rest image": ("rest image: the camera has moved by 10 px or more since it was taken", ("shift 10 ", "shift 30 ")),
    "near rest image": (
        "rest image: the camera has moved by 3 px, rotated by 1 or 4 degrees, or zoomed by 2 or 6 %",
        ("shift 3 ", "turned", "zoom"),
    ),
    "radius": ("rest shape: radius wrong by 10 or 20 %", ("radius",)),
    "height": ("rest shape: height or a semi-axis wrong by 10 or 20 %", ("height", "semi_axes")),
    "camera": ("camera: focal length, distance or centre wrong by up to 10 %", ("focal", "base_z", "centre")),
}
"""Of a group of mistakes its text, and how the names of its mistakes begin."""


def mistakes(found: dict) -> Rows:
    """How often status 7 tells of a mistake."""
    head = ["mistake", "presses", "status 7", "status ok, force wrong by more than a quarter"]
    counts = ("presses", "status 7", "wrong")
    return [head, *([MISTAKES[row["group"]][0], *(str(row[key]) for key in counts)] for row in found["groups"])]


def mistakes_summary(results: dict) -> dict:
    """Counts of every group of mistakes."""
    groups = []
    for group, (_, begins) in MISTAKES.items():
        rows = [row for row in results["rows"] if (row["kind"] == "none") == (group == "none")]
        rows = [row for row in rows if row["what"].startswith(begins)]
        wrong = sum(row["status"] == 0 and not row["force"] < WRONG for row in rows)
        groups.append(
            {"group": group, "presses": len(rows), "status 7": sum(row["status"] == 7 for row in rows), "wrong": wrong}
        )
    return dict(groups=groups)


def mismatched(found: dict) -> Rows:
    """Errors without wrong matches, with them believed, and with them screened."""
    each = [found["estimators"][name] for name in ("minimum-energy", "force-balance")]
    lines = {
        "none mismatched, median": "clean",
        "5 %, not screened, median": "believed",
        "5 %, screened (the default), median": "screened",
        "none mismatched, mean over all draws of the noise": "mean without",
        "5 %, screened, mean over all draws": "mean screened",
    }
    grown = {
        "growth of the error if 5 % are mismatched, not screened: median, worst, draws above 20 %": "believed",
        "the same, screened": "screened",
        "growth with another draw of the noise, none mismatched": "noise",
    }
    rows = [[text, *(f"{of[key]:.3f}" for of in each)] for text, key in lines.items()]
    rows += [[text, *(growth(of["growth"][key]) for of in each)] for text, key in grown.items()]
    return [["error / displacement", "minimum energy", "force balance"], *rows]


def growth(of: list[float | None]) -> str:
    """Median, worst, and how many draws grow by more than a fifth; None: no surface.

    >>> growth([7.92, None, 67]), growth([7.14, 3e8, 67])
    ('792 %, no surface, 67', '714 %, over 100000 %, 67')
    """
    middle, worst, count = of
    if worst is None:
        most = "no surface"
    else:
        most = f"over {LARGEST_GROWTH:.0%}" if worst > LARGEST_GROWTH else f"{worst:.0%}"
    return f"{middle:.0%}, {most}, {count}".replace("%", " %")


def mismatched_summary(results: dict) -> dict:
    """Medians, means and growth for both estimators."""
    found = {}
    for estimator in ("minimum-energy", "force-balance"):
        mine = [row for row in results["mismatched"] if row["estimator"] == estimator]
        clean, noise, believed, screened = (
            np.array([row[key] for row in mine]) for key in ("clean", "noise", "believed", "screened")
        )
        rises = {}
        for name, errors in dict(believed=believed, screened=screened, noise=noise).items():
            rise = errors / clean[:, None] - 1
            worst = float(rise.max())
            rises[name] = [float(np.median(rise)), worst if np.isfinite(worst) else None, int(np.sum(rise > 0.2))]
        found[estimator] = {
            **{
                key: float(np.median(values)) for key, values in dict(clean=clean, believed=believed, screened=screened).items()
            },
            "mean without": float(np.append(clean[:, None], noise, 1).mean()),
            "mean screened": float(screened.mean()),
            "growth": rises,
        }
    return dict(estimators=found, screened=results["screened"])


def life(found: dict) -> str:
    """A paragraph: when a falling modulus is reported."""
    soft, firm = found["lives"]
    (least, middle, most), off = soft["press"], [f"{100 * value:.0f}" for value in soft["off"]]
    weights = [percent(value) for value in found["weights"]["off"]]
    return (
        f"The change is reported in {soft['said']} of {soft['lives']} lives, after {middle} presses in the median ({least} to "
        f"{most}), when forces are overestimated by {off[1]} % ({off[0]} to {off[2]} %). Of {firm['lives']} membranes that do "
        f"not soften, it is reported for {firm['said'] or 'none'}. The error of each weight is drawn from those of "
        f"{found['weights']['count']} simulated presses, which are off by {weights[0]} in the median and by less than "
        f"{weights[1]} in nine of ten cases."
    )


def life_summary(results: dict) -> dict:
    """Quantiles over all lives."""
    off = np.abs(np.array(results["weights"])[:, 0] - 1)
    lives = []
    for row in results["lives"]:
        said = np.array([each for each in row["lives"] if each is not None]).reshape(-1, 2)
        of = dict(softening=row["softening"], lives=len(row["lives"]), said=len(said))
        if len(said):
            of |= dict(
                press=[round(q) for q in np.quantile(said[:, 0], (0, 0.5, 1))],
                off=np.quantile(said[:, 1], (0, 0.5, 1)).tolist(),
            )
        lives.append(of)
    return dict(weights=dict(count=len(off), off=np.quantile(off, (0.5, 0.9)).tolist()), lives=lives)


def degraded_images(found: dict) -> Rows:
    """How many degraded images have a status, and how many surfaces are wrong with status ok."""
    rows = [
        ["images", str(found["images"])],
        ["with a status other than ok", str(found["images"] - found["ok"])],
        ["of these with a surface, off by less than a quarter of the press", str(found["cautious"])],
        ["with status ok", str(found["ok"])],
        ["of these off by more than a quarter of the press", str(found["wrong"])],
        ["of these mirrored or upside down, which cannot be noticed for a symmetric pattern", str(found["mirrored"])],
    ]
    return [["", "number"], *rows]


def degraded_summary(results: dict) -> dict:
    """Counts over all ways and sensors."""
    rows = [row for row in results["rows"] if row["way"] != "clean"]
    ok = [row for row in rows if row["status"] == 0]
    wrong = [row for row in ok if not row["surface"] < WRONG]
    mirrored = sum(row["way"] in ("mirrored", "upside down") for row in wrong)
    cautious = sum(row["status"] != 0 and row["surface"] < WRONG for row in rows)
    return dict(images=len(rows), ok=len(ok), wrong=len(wrong), mirrored=mirrored, cautious=cautious)


def crash_recovery(*found: dict) -> Rows:
    """Work lost by jobs that are killed, by format."""
    rows = []
    for name, each in zip(("npz", "Parquet", "Parquet by Ray"), found, strict=True):
        kept = "each time" if each["all_kept"] else "not always"
        end = f"{each['frames']} frames, {each['rows']} rows of `summary.csv`, {each['same']} identical bit for bit"
        rows.append([name, kept, *(f"{each['lost'][signal]:.1f} s" for signal in ("SIGTERM", "SIGKILL")), end])
    return [["", "finished frames kept", "most work lost by SIGTERM", "by SIGKILL", "at the end"], *rows]


def crash_summary(results: dict) -> dict:
    """The most that a signal cost, and whether frames once kept stayed."""
    kills, end = results["kills"], results["end"]
    lost = {name: max(kill["lost"] for kill in kills if kill["signal"] == name) for name in ("SIGTERM", "SIGKILL")}
    kept = all(kill["kept"] >= kill["before"] for kill in kills)
    kept &= all(later["before"] >= kill["kept"] for kill, later in itertools.pairwise(kills))
    return dict(lost=lost, all_kept=kept, rows=results["rows"], frames=end["frames"][0], same=end["same"])


KINDS = {
    "sensors": "sensor files",
    "images": "images",
    "npz": "folders of npz",
    "parquet": "folders of Parquet",
    "readings": "readings of a gauge",
    "dots": "dots of a draft",
    "motions": "motions of a camera",
    "forces": "forces of presses",
    "rims": "rims",
    "videos": "videos",
    "bags": "bags",
    "models": "exported models",
}


def fuzz(found: dict) -> Rows:
    """What came of damaged files, by kind."""
    rows = []
    for kind, text in KINDS.items():
        if each := found["kinds"].get(kind):
            memory = f"{each['megabytes']} MB" if each["megabytes"] else "under 1 MB"
            counts = [str(each["cases"]), str(each["refused"]), str(each["cases"] - each["refused"] - each["broken"])]
            rows.append([text, *counts, str(each["broken"]), f"{each['slowest']:.1f} s", memory])
    return [["", "cases", "refused", "accepted", "against the rules", "slowest", "most memory"], *rows]


def fuzz_summary(results: dict) -> dict:
    """Of each kind of damaged file: cases, refusals, broken rules, slowest case and most memory."""
    kinds = {}
    for kind, each in results.items():
        refused = sum(count for what, count in each["kinds"].items() if what == "refused")
        counts = dict(cases=each["cases"], refused=refused, broken=len(each["broken"]))
        kinds[kind] = counts | dict(slowest=each["slowest"], megabytes=each["largest_MB"])
    return dict(kinds=kinds)
