"""Files of the contact-pressure law for robot simulators: coefficients, the presses they were fitted to, a figure; SI units."""

import csv
import io
from pathlib import Path

import numpy as np

from ..accuracy.contact_law import DEPTH, RADIUS, ContactLaw
from ..files.atomic import make_folder, write_text
from ..plot.contact_law import contact_figure
from ..plot.files import save
from ..pose import Pose
from ..sensor.sensor import Sensor
from ..sensor.table import toml_lines
from ..sensor.units import METRE

HEAD = """\
# A ball of radius r, m, pressed d, m, deep into the top of the membrane, without friction:
#   a = ln(r / reference_radius)    b = ln(d / reference_depth)    n = depth_exponent + exponent_change a
#   force      F = reference_force exp(radius_exponent a + n b)
#   pressure   p = n F / d sqrt((1 / r + curvatures[0]) (1 / r + curvatures[1])) / (2 pi)
# p over the depth below the rest surface, integrated over what the ball overlaps of it, is F. place and inward: in the frame
# of the model's root. radii, depths: where the law was fitted; errors: largest, over the simulated force."""
COLUMNS = ("radius", "depth", "simulated_force", "force", "pressure", "held_out")


def write_contact_law(law: ContactLaw, sensor: Sensor, folder: str | Path) -> Path:
    """Write `contact.toml`, `contact.csv` and `contact.png`, in m, N and Pa; forces stay relative if the sensor's are.

    Args:
        law: contact law of the sensor.
        sensor: sensor; positions are in the frame of its tool, or else of its camera, as in `write_robot_model`.
        folder: folder of the files; it is created if it does not exist, and files of these names are replaced.

    Returns:
        The path of the folder.
    """
    folder, metre = make_folder(folder), METRE[law.length_unit]
    pose = sensor.tool or Pose(np.eye(3), np.zeros(3))
    radii, depths = ([getattr(press, name) / metre for press in law.presses] for name in ("radius", "depth"))
    numbers = {
        "place": (pose.points(np.array(law.place)) / metre).tolist(),
        "inward": pose.vectors(np.array(law.inward)).tolist(),
        "curvatures": [each * metre for each in law.curvatures],
        "reference_radius": RADIUS * law.size / metre,
        "reference_depth": DEPTH * law.size / metre,
        "reference_force": law.reference,
        "radius_exponent": law.radius_exponent,
        "depth_exponent": law.depth_exponent,
        "exponent_change": law.change,
        "force_unit": law.force_unit,
        "radii": [min(radii), max(radii)],
        "depths": [min(depths), max(depths)],
        "fitted_error": float(np.abs(law.errors(False)).max()),
        "held_out_error": float(np.abs(law.errors()).max(initial=0.0)),
    }
    rounded = {key: _rounded(value) for key, value in numbers.items()}
    write_text(folder / "contact.toml", "\n".join([HEAD, *toml_lines("", rounded)]) + "\n")
    table = io.StringIO()
    rows = csv.writer(table, lineterminator="\n")
    rows.writerow(COLUMNS)
    for press in law.presses:
        found = float(law.force(press.radius, press.depth)), float(law.pressure(press.radius, press.depth)) * metre**2
        lengths = (press.radius / metre, press.depth / metre)
        rows.writerow([*(f"{each:.6g}" for each in (*lengths, press.force, *found)), int(press.held_out)])
    write_text(folder / "contact.csv", table.getvalue())
    save(contact_figure(law, sensor.name), folder / "contact.png", "check")
    return folder


def _rounded(value: object) -> object:
    if isinstance(value, list):
        return [_rounded(each) for each in value]
    return float(f"{round(value, 12):.6g}") + 0.0 if isinstance(value, float) else value
