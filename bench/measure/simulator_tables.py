"""Tables of the simulator and of wrong numbers in a sensor file: rows of cells, the first of which is the head."""

from bench.measure.accuracy_tables import Rows

CLOSED_FORMS = {
    "spherical cap, p = 2 T / R": "liquid in a spherical cap, p = 2 T / R",
    "half cylinder, p = T / R": "liquid in a half cylinder, p = T / R",
    "neo-Hookean sphere inflated to 1.5": "neo-Hookean sphere inflated to 1.5 times its radius",
    "flat square, Fourier series": "flat square under little pressure, Fourier series",
}


def closed_forms(found: dict) -> Rows:
    """Relative errors on three grids, and their order of convergence."""
    rows = [
        [CLOSED_FORMS[row["name"]], *map(scientific, row["errors"]), ", ".join(f"{rate:.2f}" for rate in row["rates"])]
        for row in found["closed_forms"]
    ]
    return [["", *map(str, found["closed_forms"][0]["grids"]), "rates"], *rows]


def scientific(value: float, digits: int = 1) -> str:
    """A number with one digit before the point.

    >>> scientific(0.00423), scientific(5e-12, 0), scientific(0.0)
    ('4.2e-3', '5e-12', '0')
    """
    mantissa, _, power = f"{value:.{digits}e}".partition("e")
    return f"{mantissa}e{int(power)}" if value else "0"


def simulated_presses(found: dict) -> Rows:
    rows = [
        [
            f"{row['friction']:g}",
            *(scientific(row[key], 0) for key in ("imbalance", "volume_error", "penetration")),
            str(row["steps"]),
            f"{row['seconds']:.2f}",
        ]
        for row in found["presses"]
    ]
    return [["friction", "imbalance", "volume error", "penetration, mm", "Newton steps", "seconds"], *rows]


def rendered_dots(found: dict) -> Rows:
    """Errors of the centroids of rendered dots, px."""
    of = {(row["preset"], row["surface"]): row for row in found["dots"]}
    rows = []
    for name in dict.fromkeys(preset for preset, _ in of):
        each = [f"{of[name, surface][key]:.{d}f}" for surface in ("rest", "pressed") for key, d in (("rms", 4), ("worst", 3))]
        rows.append([f"`{name}`", str(of[name, "rest"]["dots"]), *each])
    return [["", "dots", "rest, rms", "rest, worst", "pressed, rms", "pressed, worst"], *rows]


def simulator_seconds(found: dict) -> Rows:
    """Of an image and of a frame of a random data set."""
    names = {
        "image": "an image of 640 x 480",
        "frame of a data set, friction 0.0": "a frame of a random data set on `fingertip`, 37 x 37",
        "frame of a data set, friction 0.4": "the same with friction 0.4",
    }
    return [["", "seconds"], *([text, f"{found['seconds'][name]:.2f}"] for name, text in names.items())]


def agreement(found: dict) -> Rows:
    """Largest differences from another program, %, by friction."""
    rows = []
    for name, group in found["groups"].items():
        worst, seconds = [f"{value:.2f}" for value in group["worst"]], [f"{value:.1f}" for value in group["seconds"]]
        rows.append([name, str(group["cases"]), *worst, " to ".join(seconds)])
    head = ["", "cases", "dots", "probes", "force vector", "force magnitude", "pressure change", "seconds per press"]
    return [head, *rows]


def agreement_summary(results: dict) -> dict:
    """The largest differences, and the least and the largest time, of the presses of every group."""
    parts = {
        "without friction": lambda row: row["friction"] == 0,
        "with friction": lambda row: row["friction"] > 0,
        "all": bool,
    }
    groups = {}
    for name, belongs in parts.items():
        chosen = [row for row in results["agreement"] if belongs(row) and "failed" not in row]
        worst = [max(abs(row[key]) for row in chosen) for key in ("dots", "probes", "force", "force_size", "pressure")]
        seconds = [row["seconds"] for row in chosen]
        groups[name] = dict(cases=len(chosen), worst=worst, seconds=[min(seconds), max(seconds)])
    return dict(groups=groups)


def window_mistakes(found: dict) -> Rows:
    """Forces found over true, and the rise of the pressure, where one number of a window is wrong."""
    true = ", ".join(f"{rise:.2f}" for rise in found["true_rises"])
    rows = [
        [row["wrong"], *(f"{ratio:.2f}" for ratio in row["forces"]), ", ".join(f"{rise:.2f}" for rise in row["rises"])]
        for row in found["rows"]
    ]
    return [["wrong", "pressed at an angle", "pressed in the middle", f"rise of the pressure, hPa (true {true})"], *rows]


RIMS = {"triangle": "triangle with rounded corners", "bean": "bean (concave)", "saddle": "saddle (not planar)"}


def windows(found: dict) -> Rows:
    """Forces and depths found over true of membranes on several rims, and the material that is calibrated."""
    rows = []
    for row in found["rows"]:
        ratios = [", ".join(f"{ratio:.2f}" for ratio in row[key]) for key in ("forces", "depths")]
        material = [f"{value:.3f} ({low:.3f} to {high:.3f})" for value, _, low, high in (row["prestretch"], row["modulus"])]
        rows.append([RIMS.get(row["rim"], row["rim"]), *ratios, *material])
    errors = [f"{found[of][key]:.1%}".replace("%", " %") for of in ("median", "most") for key in ("forces", "depths")]
    rows.append(["error, median (largest)", f"{errors[0]} ({errors[2]})", f"{errors[1]} ({errors[3]})", "", ""])
    return [["rim", "force found over true", "depth found over true", "prestretch (95 %)", "modulus, N/mm (95 %)"], *rows]


def cli_errors(found: dict) -> Rows:
    """Force and depth of the tutorial's press where one number of `init` is wrong."""
    rows = [[row["wrong"], f"{row['force']:.2f}", f"{row['deepest']:.2f}"] for row in found["rows"]]
    return [["in `init`", "force, N", "deepest, mm"], *rows, ["the truth", f"{found['force']:.3f}", f"{found['deepest']:.2f}"]]


def memory(found: dict) -> Rows:
    """Memory of a batch beside what `--batch auto` assumes for a frame."""
    of: dict[tuple[int, int, int], dict] = {}
    for row in found["rows"]:
        of.setdefault((row["lines"], *row["size"]), {})[row["batch"]] = row
    rows = [
        [
            f"{lines} x {lines}, {width} x {height}",
            *(f"{row['bytes'] / 2**20:.0f} MB" for row in each.values()),
            f"{each[1]['assumed'] / 2**20:.0f} MB",
        ]
        for (lines, width, height), each in of.items()
    ]
    return [["grid, image", "batch 1", "4", "16", "assumed per frame"], *rows]
