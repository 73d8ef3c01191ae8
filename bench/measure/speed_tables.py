"""Tables of time and size: rows of cells, the first of which is the head, from the results of parts."""

from bench.measure.accuracy_tables import Rows, default_accuracy
from bench.measure.recording_tables import balanced

TRACKED = "tracked, from the frame before"


def readme(independent: dict, bubble: dict, frame: dict, live: dict) -> Rows:
    """What to expect, at a glance."""
    head, surface, contact, force, _ = default_accuracy(independent)
    poke = balanced(bubble)["depth"], balanced(bubble)["rms_contact"]
    times = [f"{medians(found['rows'])} ms ({processor})" for processor, found in frame.items()]
    return [
        head,
        ["shape, relative to the displacement", *surface[1:]],
        contact,
        force,
        ["rms error of the shape of a real bubble, poked {:.1f} mm deep".format(*poke), "{:.2f} mm".format(*poke[1:]), ""],
        ["processor time of one image / in batches / tracked", "; ".join(times), ""],
        ["latency of a live camera of 30 Hz", f"{live['cases']['default grid']['median']:.0f} ms", ""],
    ]


def medians(rows: dict) -> str:
    """Return the times of one image, of a frame in batches and of a tracked one."""
    return " / ".join(f"{rows[name]['median']:.0f}" for name in ("one image", "in batches of 16", TRACKED))


def frame_times(frame: dict) -> Rows:
    """Time of a frame and of its markers on every processor, and in the unit of work that other machines can do."""
    names = {
        "one image": "one image",
        "in batches of 16": "a frame in batches of 16",
        TRACKED: "a tracked frame: its dots are followed from the frame before",
        "markers alone": "the markers alone",
        "markers alone, followed": "the markers alone, followed",
    }
    each = list(frame.values())
    return [
        ["", *(f"{processor} ({found['revision']})" for processor, found in frame.items())],
        [
            "the unit: 0.45 GFLOP as products of 186 x 186 matrices",
            *(f"{found['rows']['unit']['median']:.2g} ms" for found in each),
        ],
        *([text, *(in_units(found["rows"][name]) for found in each)] for name, text in names.items()),
    ]


def in_units(row: dict) -> str:
    """Return a time, and in brackets how many units it is.

    >>> in_units(dict(median=21.69, units=4.232))
    '22 ms (4.2)'
    """
    return f"{two_digits(row['median'])} ms ({row['units']:.1f})"


def two_digits(value: float) -> str:
    """Return a number with two digits, and all digits before the point.

    >>> two_digits(142.3), two_digits(8.83), two_digits(17.2)
    ('142', '8.8', '17')
    """
    return f"{value:.0f}" if value >= 100 else f"{value:.2g}"


def times(row: dict) -> str:
    """Median and least.

    >>> times(dict(median=46.1, least=9.66))
    '46 (9.7)'
    """
    return f"{two_digits(row['median'])} ({two_digits(row['least'])})"


def exported_models(models: dict) -> Rows:
    return [
        ["", "grid", "MB", "export, s", "time per frame, ms: median (least)"],
        *(
            [
                row["kind"],
                f"{row['grid']} x {row['grid']}",
                f"{row['megabytes']:.1f}",
                f"{row['export_seconds']:.0f}",
                times(row),
            ]
            for row in models["rows"]
        ),
    ]


def training(found: dict) -> Rows:
    names = {"images": "images", "markers": "markers' pixels (`from_pixels`)"}
    return [
        ["input", "forward without gradients", "training step", "ratio"],
        *(
            [names[row["of"]], f"{row['forward']:.2f} s", f"{row['step']:.2f} s", f"{row['ratio']:.1f}"]
            for row in found["rows"]
        ),
    ]


def solve_by_batch(energy: dict, balance: dict) -> Rows:
    """Markers and flow, and the solves of minimum energy, 33 x 33, and of force balance, 17 x 17."""
    chosen = [row for row in energy["rows"] if row["estimator"] == "the sensor's material" and "solve_alone" not in row]
    solve, names = balance_times(balance), ("markers", "flow", "solve")
    return [
        ["", "markers", "flow", "minimum energy, 33 x 33", "force balance, 17 x 17"],
        *(
            [
                f"batch {row['batch']}",
                *(two_digits(row["milliseconds_a_frame"][name][0]) for name in names),
                two_digits(solve["batch {batch}, cold".format(**row)]),
            ]
            for row in chosen
        ),
    ]


def gpu(found: dict) -> Rows:
    return [
        ["batch", "markers, ms", "solve, ms", "both, ms", "frames per second", "memory"],
        *(
            [
                str(row["batch"]),
                *(f"{float(f'{row[name]:.2g}'):g}" for name in ("markers", "solve", "whole")),
                f"{1000 / row['whole']:.0f}",
                f"{row['megabytes']:.0f} MB",
            ]
            for row in found["rows"]
        ),
    ]


def balance_times(found: dict) -> dict[str, float]:
    return {row["what"]: row["milliseconds_a_frame"] for row in found["rows"] if row["estimator"] == "force balance"}


def balance_against_scipy(found: dict) -> Rows:
    each = balance_times(found)
    twin = each.pop("scipy twin, cold")
    return [
        ["", "ms", "of the twin"],
        ["scipy twin", f"{twin:.0f}", "1"],
        *([name.removesuffix(", cold"), two_digits(value), f"{value / twin:.2f}"] for name, value in each.items()),
    ]


def paper_stages(found: dict) -> Rows:
    each = {row["what"]: row["milliseconds_a_frame"] for row in found["rows"] if row["estimator"] == "the paper"}
    names = {
        "dots": "dots (`--locator soft`)",
        "flow and rays (eq. 2)": "flow and rays (eq. 2)",
        "first contacts (eq. 29)": "first contacts (eq. 29)",
        "Q, Q^T Q, smoother, volume (eqs. 18, 21, 28)": "Q, `Q^T Q`, smoother, volume (eqs. 18, 21, 28), per round",
        "factor": "factorisation, per round",
        "two solves (eqs. 25-27)": "two solves (eqs. 25-27), per round",
        "the solve, all of these three": "these three together",
        "scipy twin of the solve": "the same in scipy (`bench/speed/paper_twin.py`): sparse assembly, `splu`",
        "contacts of the surface": "contacts of the surface, per round",
        "the whole loop": "the whole loop of two rounds",
        "image to result": "image to result",
    }
    return [["stage", "ms"], *([text, two_digits(each[name])] for name, text in names.items())]


LIVE = {
    "17 x 17": "17 x 17",
    "17 x 17; recorded": "17 x 17, `--record`",
    "default grid": "default grid, 33 x 33",
    "17 x 17; exported": "17 x 17, `--model`",
    "17 x 17; exported; recorded": "17 x 17, `--model`, `--record`",
}


def live(*found: dict) -> Rows:
    """Rate, dropped frames and latency of a live camera, by grid and what computes."""
    rows = []
    for name, row in (each for part in found for each in part["cases"].items()):
        dropped, latency = f"{row['dropped']} of {row['captured']}", "{median:.0f} ({percent_95:.0f})".format(**row)
        quarters = "{first_quarter:.0f}, {last_quarter:.0f}".format(**row)
        rows.append(
            [LIVE[name], f"{row['load']:.1f}", f"{row['rate']:.1f}", dropped, latency, quarters, f"{row['processor']:.0f}"]
        )
    head = ["", "load", "followed, Hz", "dropped", "latency, ms: median (95 %)", "median in the first, the last quarter"]
    return [head + ["processor time per frame followed, ms"], *rows]


def ros(found: dict) -> Rows:
    """Wrenches and latency of the node of ROS 2."""
    rows = [
        ["images sent at 30 Hz", str(found["sent"])],
        ["wrenches received", str(found["received"])],
        ["from the image's stamp to its wrench, median / 99 %", "{median_ms:.0f} / {most_ms:.0f} ms".format(**found)],
        ["the node's processor time for each wrench", f"{found['processor_ms']:.0f} ms"],
    ]
    return [["", ""], *rows]


PRECISIONS = {
    "float32": "float32",
    "float16": "float16, all (`onnxruntime.transformers.float16`)",
    "int8": "int8, weights (`quantize_dynamic`)",
}


def walk_sensor(found: dict) -> Rows:
    """Processor time of the commands of the page on one's own sensor."""
    return _walk(found, "own_sensor")


def walk_bubble(found: dict) -> Rows:
    """The same of the page on one's own bubble."""
    return _walk(found, "own_bubble")


def _walk(found: dict, page: str) -> Rows:
    rows = [row for row in found["rows"] if row["page"] == page and not row["stands_in"]]
    return [["", "processor time, s"], *([f"`{row['command'].partition(' --')[0]}`", f"{row['seconds']:.1f}"] for row in rows)]


def precision(found: dict) -> Rows:
    """Size and errors of a model in half precision and in integers."""
    rows = []
    for row in found["rows"]:
        cells = [PRECISIONS[row["precision"]], f"{row['megabytes']:.1f}"]
        if "not_loaded" in row:
            cells += ["onnxruntime refuses the file", "", ""]
        else:
            cells.append("ok" if not any(row["status"]) else ", ".join(map(str, row["status"])))
            for key, digits in (("vertices", 3), ("force", 2)):
                errors = row[key] if row["precision"] != "float32" else []
                cells.append(", ".join(f"{value:.{digits}f}" for value in errors))
        rows.append(cells)
    return [["", "MB", "status", "vertices against float32, mm", "force, relative"], *rows]
