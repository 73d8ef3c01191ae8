"""The picture of docs/slip.md, drawn from what the page's own code makes when it is run, with its friction and with another."""

import re
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from torchmembrane.plot.drawing import BLUE, VERMILION

PAGE = Path(__file__).with_name("slip.md")
FRICTIONS = {0.4: BLUE, 0.7: VERMILION}


def page_names(friction: float) -> dict[str, Any]:
    """What the page's code has defined after it ran with this friction."""
    code = "\n".join(re.findall(r"```python\n(.*?)```", PAGE.read_text(), re.S))
    code = code.replace("friction, pushed, dragged = 0.4", f"friction, pushed, dragged = {friction}")
    names: dict[str, Any] = {}
    exec(compile(code, PAGE.name, "exec"), names)
    return names


def slip_figure() -> Figure:
    drawing = Figure(figsize=(8, 4.2), dpi=100, layout="constrained")
    axes = drawing.subplots()
    for friction, colour in FRICTIONS.items():
        names = page_names(friction)
        frame = np.arange(1, len(names["slip"]) + 1) - names["pushed"]
        axes.plot(frame, names["true"], color=colour, lw=1.4, label=f"true, friction {friction}")
        axes.plot(frame, names["slip"], "o", color=colour, ms=5, label=f"found: plateau {names['plateau']:.2f}")
        axes.plot(names["onset"], names["plateau"], "x", color=colour, ms=13, mew=2.5)
        axes.axhline(friction, color=colour, lw=0.7, ls=":")
        share = np.array(names["sliding"])
        some = frame[(share > 0.15) & (share < 0.999)]
        axes.axvspan(some[0] - 0.5, names["true_onset"], ymax=friction / 0.9, color=colour, alpha=0.1, lw=0)
        print(f"friction {friction}: plateau {names['plateau']:.3f}, onset {names['onset']:.2f}, true {names['true_onset']}")
    axes.axvline(0, color="0.7", lw=0.8)
    axes.set(xlabel="frame of the drag", ylabel="shear force over normal force", ylim=(0, 0.9))
    axes.legend(fontsize=8, loc="upper left")
    return drawing
