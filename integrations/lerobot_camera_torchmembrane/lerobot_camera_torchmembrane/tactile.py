"""Tactile results of a frame for robots and policies: wrench, contacts and status; points with displacement and force.

They are zeros if a frame has no surface, because one NaN would spoil the statistics of a data set; `status` marks these frames.
"""

from pathlib import Path

import numpy as np

from torchmembrane import MembraneError, Sensor
from torchmembrane.results.reconstruction import Frame
from torchmembrane.results.summary import UNREADABLE

WRENCH = ("Fx", "Fy", "Fz", "Mx", "My", "Mz")
CONTACTS = 4
"""Number of contacts of a frame, strongest first."""
OF_CONTACT = ("x", "y", "z", "Fx", "Fy", "Fz")
SIZES = {"wrench": 6, "contacts": CONTACTS * len(OF_CONTACT), "status": 1}


def refuse_views_apart(sensor: Sensor, path: Path | str) -> None:
    """Refuse a sensor whose views have images of their own: a camera of LeRobot gives one image.

    Raises:
        MembraneError: the sensor has such views.
    """
    if sensor.views_apart:
        raise MembraneError(
            f"{path}: the views {', '.join(sensor.views_apart)} have images of their own; expected a sensor file of one view, "
            "or of views that are regions of one image"
        )


def felt(frame: Frame) -> dict[str, np.ndarray]:
    """Return `wrench [6]`, `contacts [24]` and `status [1]` of a frame, float32.

    Args:
        frame: arrays of the frame, as returned by `Reconstruction.frame`. `contacts` holds x, y, z, Fx, Fy, Fz of four
            contacts, from `contact_points` and `contact_force`.
    """
    contacts = np.concatenate([frame["contact_points"], frame["contact_force"]], -1).ravel()
    values = {"wrench": frame["wrench"], "contacts": contacts, "status": np.atleast_1d(frame["status"])}
    return {name: np.nan_to_num(value).astype(np.float32) for name, value in values.items()}


def unreadable(vertices: int) -> dict[str, np.ndarray]:
    """Return the values of an image that could not be read, which has no frame: zeros, and status -1."""
    zeros = {name: np.zeros(size, np.float32) for name, size in SIZES.items()} | {"points": np.zeros((vertices, 6), np.float32)}
    return zeros | {"status": np.full(1, UNREADABLE, np.float32)}


def points(frame: Frame, area: np.ndarray) -> np.ndarray:
    """Return the displacement and contact force of every vertex, dx, dy, dz, Fx, Fy, Fz, `[V, 6]` float32.

    Args:
        frame: arrays of the frame.
        area: areas of the vertices at rest, `[V]`.
    """
    force = frame["traction"] * area[:, None]
    return np.nan_to_num(np.concatenate([frame["displacement"], force], -1)).astype(np.float32)


def scalars(frame: Frame, name: str) -> dict[str, float]:
    """Return wrench and status as the single numbers of a robot's observations: `NAME.Fx` ... `NAME.Mz`, `NAME.status`."""
    values = felt(frame)
    return dict(zip(scalar_names(name), [*values["wrench"].tolist(), *values["status"].tolist()], strict=True))


def scalar_names(name: str) -> list[str]:
    """Return the names of a sensor's single numbers in the observations."""
    return [f"{name}.{each}" for each in (*WRENCH, "status")]


def key(name: str, what: str) -> str:
    """Return the key of a sensor's array in a data set and in a policy's observations."""
    return f"observation.tactile.{name}.{what}"


def features(name: str, vertices: int | None = None) -> dict[str, dict]:
    """Return the declarations of a sensor's arrays for a LeRobot data set.

    Args:
        name: name of the sensor.
        vertices: number of vertices of the points; None: without points.
    """
    names = {"wrench": list(WRENCH), "status": ["status"]}
    names["contacts"] = [f"contact{k}.{each}" for k in range(1, CONTACTS + 1) for each in OF_CONTACT]
    declared = {key(name, what): {"dtype": "float32", "shape": (n,), "names": names[what]} for what, n in SIZES.items()}
    if vertices:
        declared[key(name, "points")] = {"dtype": "float32", "shape": (vertices, 6), "names": ["point", "value"]}
    return declared
