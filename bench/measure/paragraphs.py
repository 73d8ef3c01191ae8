"""Paragraphs that the documents quote of smaller measurements, from the results of parts."""

import numpy as np

from bench.measure.accuracy_tables import Rows

SAME = 1e-6
"""Of the displacement, between a frame solved from the one before and the same frame solved alone."""


def light_independent(found: dict) -> str:
    """What is found of the light strokes of an independent program."""
    bands = [row for row in found["bands"] if row["low"]]
    errors = ", ".join("{:.2f} / {:.2f}".format(*row["force"]) for row in bands)
    light, rest = next(row for row in found["bands"] if not row["low"]), found["rest"]
    seen = round(light["found"] * light["frames"])
    return (
        f"For {found['strokes']} strokes of an independent program, the errors of the force in the {len(bands)} bands from 2 % "
        f"on are {errors}. Below 2 %, {seen or 'none'} of {light['frames']} contacts {'are' if seen > 1 else 'is'} found. In "
        f"their {rest['frames']} frames at rest, a contact is reported in {rest['contacts'] or 'none'}."
    )


def light_independent_summary(results: dict) -> dict:
    """Errors by band, and contacts at rest."""
    rest = [row for row in results["rows"] if row["true_force"] == 0]
    contacts = sum(row["contacts"] > 0 for row in rest)
    strokes = len({row["sensor"] for row in results["rows"]})
    return dict(strokes=strokes, bands=results["bands"], rest=dict(frames=len(rest), contacts=contacts))


def at_rest(found: dict) -> str:
    """False contacts in images of random sensors that nothing touches."""
    rows, noise = found["rows"], found["noise"]
    frames, contacts, flagged = (sum(row[key] for row in rows) for key in ("frames", "contacts", "flagged"))
    return (
        f"In {frames} frames at rest, of {len(rows)} random sensors with {noise:.0f} dB of noise (several rest images each), "
        f"a contact is reported in {contacts or 'none'}. {flagged or 'None'} of them {'has' if flagged < 2 else 'have'} a "
        f"status other than ok."
    )


def sequence(found: dict) -> str:
    """Frames that are solved from the one before, against the same frames alone."""
    rows = found["rows"]
    apart = [row for row in rows if row["worst_frame"] > SAME]
    strokes, frames = len(rows), sum(row["frames"] for row in rows)
    text = f"In {strokes} strokes of random sensors ({frames} frames), tracked frames equal the same frames solved alone"
    if not apart:
        return f"{text}."
    off, most = (max(row[key] for row in apart) for key in ("difference", "worst_frame"))
    return (
        f"{text} in {strokes - len(apart)} strokes. In the rest, other dots are found, and the surfaces differ by up to "
        f"{100 * off:.2g} % of the displacement (rms; {100 * most:.2g} % in the worst frame)."
    )


def loading(found: dict) -> str:
    """Seconds to load an exported model, with onnxruntime's reuse of memory and without."""
    return (
        f"The model of {found['megabytes']:.1f} MB that `torchmembrane export examples/sensor.toml` writes then loads in "
        f"{found['load']:.1f} s of processor time instead of {found['load_reuse']:.1f} s, and a frame takes "
        f"{found['ratio']:.2f} times as long (onnxruntime {found['onnxruntime']})."
    )


def exports(found: dict) -> str:
    """Exported models of random sensors against torch, and what they cost."""
    from bench.accuracy.exports import CLOSE

    rows, refused = found["rows"], found["refused"]
    others = [row for row in rows if row["share"] > CLOSE]
    text = (
        f"Of {len(rows) + refused} exports, {refused or 'none'} {'is' if refused < 2 else 'are'} refused. Every status equals "
        f"that of torch in {sum(row['statuses'] for row in rows)} of them. In {len(rows) - len(others)}, the vertices agree "
        f"with torch within a thousandth of the largest displacement."
    )
    if others:
        low, high = (100 * f(row["share"] for row in others) for f in (min, max))
        near = sum(row["as_torch"] for row in others)
        text += (
            f" In the others (numbers {', '.join(str(row['number']) for row in others)}) they differ by up to {low:.2g} to "
            f"{high:.2g} % of it; in {near} of these, torch itself moves by half as much or more if the image changes by one "
            f"rounding error."
        )
    seconds, megabytes = (np.array([row[key] for row in rows]) for key in ("seconds", "megabytes"))
    return (
        f"{text} An export takes {np.median(seconds):.0f} s of processor time in the median and {seconds.max():.0f} s at most; "
        f"the largest file has {megabytes.max():.0f} MB."
    )


def exports_summary(results: dict) -> dict:
    """Of every exported model whether it equals torch, its time and its size."""
    from bench.accuracy.exports import AS_ROUNDING

    done = [row for row in results["rows"] if "error" not in row]
    rows = [
        {key: row[key] for key in ("number", "seconds", "megabytes")}
        | dict(
            statuses=row["statuses_equal"],
            share=row["apart"] / max(row["displacement"], 1.0),
            as_torch=row["apart"] <= AS_ROUNDING * row["rounding"],
        )
        for row in done
    ]
    return dict(rows=rows, refused=len(results["rows"]) - len(done))


def rim(found: dict) -> str:
    """Errors of the rim's circle that is found in photographs."""
    rows = found["rows"]
    done = [row["off"] for row in rows if "off" in row]
    refused = len(rows) - len(done)
    said = f"; {refused} were refused" if refused else ""
    return f"Centre and half axes were off by {np.median(done):.2f} px in the median and by {max(done):.2f} px at most{said}."


def throughput(found: dict) -> Rows:
    """Frames a second from files to results, by the number of workers."""
    rows = [
        [
            {"processes": "worker processes", "ray": "Ray (`--engine ray`)"}[row["engine"]],
            str(row["workers"]),
            f"{row['rate']:.0f}",
            f"{row['milliseconds']:.0f} ms" if row["engine"] == "processes" else "",  # Ray's workers are not our children
            f"{1e6 / row['rate'] / 3600:.1f} h",
        ]
        for row in found["rows"]
    ]
    return [["engine", "workers", "frames per second", "processor time per frame", "a million frames"], *rows]


def rough_gauge(found: dict) -> str:
    """What a gauge adds that is no better than one per cent of the rest pressure."""
    light, deep = ([band for band in found["bands"] if band["kind"] == kind] for kind in ("light", "press"))

    def said(band: dict) -> str:
        before, after = ("{:.2f} / {:.2f}".format(*band["force"][told]) for told in ("0.0", "0.01"))
        return f"{before} without and {after} with it"

    touch = next(band for band in light if band["low"] == 0.05)
    strong = next(band for band in light if band["low"] == 0.5)
    middle = next(band for band in deep if band["low"] == 0.05)
    return (
        f"With a gauge that is no better than 1 %, the error of the force at 50 to 100 % of the largest force is "
        f"{said(strong)}; of presses of 0.05 to 0.1 of the size, {said(middle)}; of light touches (5 to 15 %), {said(touch)}."
    )


def window_intervals(found: dict) -> str:
    """How many presses are ok, and how many intervals hold the truth."""
    from bench.accuracy.windows import MODULUS, STRETCH

    rows = found["rows"]
    statuses = [status for row in rows for status in row["statuses"]]
    limits = [(truth, *row[of][2:]) for row in rows for of, truth in (("prestretch", STRETCH), ("modulus", MODULUS))]
    held = [low <= truth <= high for truth, low, high in limits]
    return (
        f"{statuses.count('ok')} of the {len(statuses)} presses have status ok, and {sum(held)} of the {len(held)} intervals "
        f"of prestretch and modulus contain the true value."
    )
