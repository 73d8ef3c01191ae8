"""Tables of what is in and out of range: pins, and the limits at a glance."""

import numpy as np

from bench.measure.accuracy_tables import Rows, percent

PINS = {
    "feet and height": "feet listed, `height`",
    "height": "`height`, tips from the rest image",
    "no height": "tips taken for dots",
}


def pins(found: dict) -> Rows:
    """Errors with pins of several heights, with the height in the file and without."""
    head = ["height of the pins", "file", "displacement", "force", "status ok", "of these off by over a quarter"]
    rows = []
    for row in found["groups"]:
        errors = ["{:.2g} / {:.2g}".format(*row[key]) for key in ("surface", "force")]
        height = f"{row['height']:g} mm" if row["height"] else "0 (painted)"
        file = PINS[row["file"]] if row["height"] else "dots listed"
        rows.append([height, file, *errors, f"{row['ok']} of {row['presses']}", str(row["wrong"])])
    return [head, *rows]


def pins_summary(results: dict) -> dict:
    """Medians and worst errors; of painted dots one file, as the three are alike."""
    groups = []
    rows = results["presses"]
    for height in dict.fromkeys(row["height"] for row in rows):
        for file in PINS if height else ("feet and height",):
            chosen = [row for row in rows if (row["height"], row["file"]) == (height, file)]
            group = dict(height=height, file=file, presses=len(chosen), ok=sum(row["status"] == 0 for row in chosen))
            for key in ("surface", "force"):
                values = [row[key] for row in chosen]
                group[key] = [float(np.nanmedian(values)), float(np.nanmax(values))]
            groups.append(group | dict(wrong=sum(row["status"] == 0 and row["surface"] > 0.25 for row in chosen)))
    return dict(groups=groups)


def by_depth(found: dict) -> tuple[dict[str, int], dict[str, int]]:
    """Of presses up to a fifth of the size deep, and of deeper ones: %, right with any status, right with ok, wrong with ok."""
    groups = found["groups"]
    first = next(k for k, row in enumerate(groups) if row["name"] == "depth up to 0.05")
    parts = []
    for chosen in (groups[first : first + 3], groups[first + 3 : first + 4]):
        presses = sum(row["presses"] for row in chosen)
        ok, cautious, wrong = (
            sum(row["presses"] * row[key] for row in chosen) / presses for key in ("right", "cautious", "wrong")
        )
        parts.append({key: round(100 * share) for key, share in (("right", ok + cautious), ("ok", ok), ("wrong", wrong))})
    return parts[0], parts[1]


def readme_range(found: dict) -> str:
    """A paragraph on how deep a press may be."""
    (of, deep), every = by_depth(found), round(1 / found["groups"][0]["wrong"])
    return (
        f"Of the presses of random sensors that are up to a fifth of the membrane's size deep, {of['right']} % are right, and "
        f"{of['ok']} % are right and have status `ok`; from there to 0.3 of the size, these shares are {deep['right']} % and "
        f"{deep['ok']} %. Of all presses, one in {every} is wrong although its status is `ok`. A press is right if the errors "
        f"of its surface and force are below a quarter (a force at the rim may be a lower bound)."
    )


def limits(range_: dict, light: dict, intervals_: dict, degraded: dict, weights: dict) -> Rows:
    """What holds to which limit, from the records of the tables that say more."""
    of, deep = by_depth(range_)
    firm = [row["force"][0] for row in light["bands"] if 0.05 <= row["low"] < 0.15]
    held = next(row for row in intervals_["bands"] if row["low"] is None)
    middle, most, largest = (f"{100 * value:.1f} %" for value in weights["errors"])
    return [
        ["", "", "measured"],
        [
            "depth",
            f"presses up to a fifth of the membrane's size: {of['right']} % are right, {of['wrong']} % wrong with status ok; "
            f"from there to 0.3: {deep['right']} % and {deep['wrong']} %; deeper ones have status 9",
            "[range](force_balance.md#range), [status 9](#range)",
        ],
        [
            "near the rim",
            "the rim bears a part of the force: the result is a lower bound and marked as one",
            "[range](force_balance.md#range)",
        ],
        [
            "light touches",
            f"5 to 15 % of the force of a firm press: the median error of the force is {percent(max(firm))}",
            "[light touches](force_balance.md#light-touches)",
        ],
        [
            "small contacts",
            "contacts narrower than the spacing of the dots are not resolved",
            "[range](force_balance.md#range)",
        ],
        [
            "two contacts",
            "the spec sheet says from which distance on they are resolved",
            "[spec sheet](spec_sheet.md#measured)",
        ],
        [
            "intervals",
            f"the true force lies within one `force_deviation` of the result in {100 * held['force']['held']:.0f} % of frames, "
            f"the true depth within one `depth_deviation` in {100 * held['depth']['held']:.0f} %",
            "[intervals](force_balance.md#intervals)",
        ],
        [
            "degraded images",
            f"{degraded['ok']} of {degraded['images']} have status ok; the surfaces of {degraded['wrong']} of these are off by "
            f"more than a quarter (images that are mirrored or upside down: {degraded['mirrored']})",
            "[range](force_balance.md#range)",
        ],
        ["drift of the rest state", "noticed while nothing touches the membrane", "[drift](drift.md#measured)"],
        ["friction", "estimated from a drag", "[slip](slip.md)"],
        [
            "forces after one weight",
            f"the error is {middle} in the median, below {most} in nine of ten cases, and at most {largest} in all "
            f"{weights['forces']}",
            "[recipes](recipes.md#newtons-from-one-known-weight)",
        ],
    ]
