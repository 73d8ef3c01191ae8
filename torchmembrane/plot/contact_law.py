"""The law of contact force and pressure over depth, drawn beside the simulated presses."""

import numpy as np
from matplotlib.figure import Figure

from ..accuracy.contact_law import ContactLaw
from .drawing import BLUE, VERMILION, readable

COLOURS = (BLUE, VERMILION, "k", "#009E73", "#CC79A7")


@readable
def contact_figure(law: ContactLaw, name: str) -> Figure:
    """Force and pressure over depth for each ball: the law as lines, presses that it was fitted to and tried on as marks.

    Args:
        law: what is drawn.
        name: name of the sensor.

    Returns:
        A figure of two panels.
    """
    drawing = Figure(figsize=(11, 5), layout="constrained")
    worst = 100 * np.abs(law.errors()).max(initial=0.0)
    drawing.suptitle(
        f"Balls pressed into the top of {name!r}: the law is off by {worst:.1f} % of the force at most", fontsize=13
    )
    force, pressure = drawing.subplots(1, 2)
    for radius, colour in zip(sorted({press.radius for press in law.presses}), COLOURS, strict=False):
        mine = [press for press in law.presses if press.radius == radius]
        depths = np.linspace(min(press.depth for press in mine), max(press.depth for press in mine), 60)
        label = f"r = {radius:.3g} {law.length_unit}"
        force.plot(depths, law.force(radius, depths), color=colour, label=label)
        pressure.plot(depths, law.pressure(radius, depths), color=colour, label=label)
        for press in mine:
            force.plot(press.depth, press.force, "o", color=colour, mfc="none" if press.held_out else colour, ms=7)
    relative = law.force_unit == "relative"
    per_area = "relative" if relative else f"{law.force_unit}/{law.length_unit}²"
    deep = f"depth [{law.length_unit}]"
    force.set(xlabel=deep, ylabel=f"force [{law.force_unit}]", title="Force; rings: held out")
    pressure.set(xlabel=deep, ylabel=f"pressure [{per_area}]", title="Pressure over the depth below the rest surface")
    for axes in (force, pressure):
        axes.set_xlim(left=0)
        axes.set_ylim(bottom=0)
        axes.grid(lw=0.3, alpha=0.5)
        axes.legend(frameon=False)
    return drawing
