"""What a frame's reconstruction is to a robot and to a policy: wrench, contacts and status; points with displacement and force.

Where a frame has no surface they are zeros, as one NaN would spoil a data set's statistics: `status` tells them apart.
"""

import numpy as np

from torchmembrane.results.reconstruction import Frame

WRENCH = ("Fx", "Fy", "Fz", "Mx", "My", "Mz")
CONTACTS = 4
"""Of a frame, strongest first."""
OF_CONTACT = ("x", "y", "z", "Fx", "Fy", "Fz")
SIZES = {"wrench": 6, "contacts": CONTACTS * len(OF_CONTACT), "status": 1}


def felt(frame: Frame) -> dict[str, np.ndarray]:
    """`wrench [6]`, `contacts [24]` and `status [1]` of a frame, float32.

    Args:
        frame: its arrays, as `Reconstruction.frame` gives them. `contacts` are its `contact_points` and `contact_force`:
            x, y, z, Fx, Fy, Fz of each of four.
    """
    contacts = np.concatenate([frame["contact_points"], frame["contact_force"]], -1).ravel()
    values = {"wrench": frame["wrench"], "contacts": contacts, "status": np.atleast_1d(frame["status"])}
    return {name: np.nan_to_num(value).astype(np.float32) for name, value in values.items()}


def points(frame: Frame, area: np.ndarray) -> np.ndarray:
    """Displacement and contact force of every vertex, dx, dy, dz, Fx, Fy, Fz, `[V, 6]` float32.

    Args:
        frame: its arrays.
        area: `[V]`, of the vertices at rest.
    """
    force = frame["traction"] * area[:, None]
    return np.nan_to_num(np.concatenate([frame["displacement"], force], -1)).astype(np.float32)


def scalars(frame: Frame, name: str) -> dict[str, float]:
    """The same wrench and status one by one, as a robot's observations are: `NAME.Fx` ... `NAME.Mz`, `NAME.status`."""
    values = felt(frame)
    return dict(zip(scalar_names(name), [*values["wrench"].tolist(), *values["status"].tolist()], strict=True))


def scalar_names(name: str) -> list[str]:
    """Of the observations of a sensor one by one."""
    return [f"{name}.{each}" for each in (*WRENCH, "status")]


def key(name: str, what: str) -> str:
    """Of an array of a sensor in a data set and in a policy's observations."""
    return f"observation.tactile.{name}.{what}"


def features(name: str, vertices: int | None = None) -> dict[str, dict]:
    """A sensor's arrays as a LeRobot data set declares them.

    Args:
        name: name of the sensor.
        vertices: vertices of its points; None: without points.
    """
    names = {"wrench": list(WRENCH), "status": ["status"]}
    names["contacts"] = [f"contact{k}.{each}" for k in range(1, CONTACTS + 1) for each in OF_CONTACT]
    declared = {key(name, what): {"dtype": "float32", "shape": (n,), "names": names[what]} for what, n in SIZES.items()}
    if vertices:
        declared[key(name, "points")] = {"dtype": "float32", "shape": (vertices, 6), "names": ["point", "value"]}
    return declared
