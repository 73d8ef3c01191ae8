"""Tables and figure of what a frame costs against grid lines, dots, image width and batch."""

from pathlib import Path

import numpy as np

from bench.measure.accuracy_tables import Rows

PARTS = ("markers", "solve")
NAMES = dict(lines="grid lines per side", dots="dots", width="image width, px", batch="frames in a batch")


def exponent(rows: list[dict], sweep: str, part: str) -> float:
    """Of the cost of a part, over the upper half of a sweep; of a batch, of the whole batch."""
    upper = rows[len(rows) // 2 :]
    cost = [row[part] * (row["batch"] if sweep == "batch" else 1) for row in upper]
    return float(np.polyfit(np.log([row[sweep] for row in upper]), np.log(cost), 1)[0])


def exponents(found: dict) -> Rows:
    each = [[NAMES[sweep], *(f"{exponent(rows, sweep, part):z.1f}" for part in PARTS)] for sweep, rows in found["rows"].items()]
    return [["exponent of the cost in", *PARTS], *each]


def costs(found: dict) -> Rows:
    each = [
        [NAMES[sweep] if k == 0 else "", str(row[sweep]), *(f"{row[part]:.3g}" for part in PARTS)]
        for sweep, rows in found["rows"].items()
        for k, row in enumerate(rows)
    ]
    return [["varied quantity", "value", *(f"{part}, ms per frame" for part in PARTS)], *each]


def draw(found: dict, path: Path) -> None:
    """Milliseconds a frame against each quantity, in logarithms, with the exponents."""
    from matplotlib.figure import Figure

    table = found["rows"]
    figure = Figure(figsize=(11, 3.2), layout="constrained")
    axes = figure.subplots(1, len(table), sharey=True)
    for ax, (sweep, rows) in zip(axes, table.items(), strict=True):
        for part, mark in zip(PARTS, "os", strict=True):
            label = f"{part}: exponent {exponent(rows, sweep, part):z.1f}"
            ax.loglog([row[sweep] for row in rows], [row[part] for row in rows], marker=mark, markersize=4, label=label)
        values = [row[sweep] for row in rows]
        shown = values if len(values) < 5 else values[::2]
        ax.set(xlabel=NAMES[sweep])
        ax.set_xticks(shown, [str(value) for value in shown])
        ax.set_xticks([], minor=True)
        ax.grid(alpha=0.3)
        ax.legend(fontsize=8, loc="upper left")
    low, high = axes[0].get_ylim()
    axes[0].set_ylim(low, 3 * high)
    ticks = [value for value in (1, 3, 10, 30, 100, 300, 1000) if low < value < high]
    axes[0].set_yticks(ticks, [str(value) for value in ticks])
    axes[0].set_yticks([], minor=True)
    axes[0].set_ylabel("ms per frame")
    figure.savefig(path, dpi=110)
