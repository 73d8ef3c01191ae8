"""What a frame's reconstruction is to a policy: points with displacement and force, and the wrench."""

import numpy as np

POINTS = ("dx", "dy", "dz", "Fx", "Fy", "Fz")
WRENCH = ("Fx", "Fy", "Fz", "Mx", "My", "Mz")


def points(displacement: np.ndarray, traction: np.ndarray, area: np.ndarray) -> np.ndarray:
    """Displacement and contact force of every vertex, `[..., V, 6]` float32, zero where there is no surface.

    Args:
        displacement: `[..., V, 3]`, length unit, camera frame.
        traction: `[..., V, 3]`, force per area.
        area: `[V]`, of the vertices at rest.
    """
    return np.nan_to_num(np.concatenate([displacement, traction * area[:, None]], -1)).astype(np.float32)


def keys(name: str) -> tuple[str, str]:
    """The observations of a sensor: its points, its wrench."""
    return f"observation.tactile.{name}.points", f"observation.tactile.{name}.wrench"


def features(name: str, vertices: int) -> dict[str, dict]:
    """The two observations as a LeRobot data set declares them."""
    of_points, of_wrench = keys(name)
    return {
        of_points: {"dtype": "float32", "shape": (vertices, 6), "names": ["point", "value"]},
        of_wrench: {"dtype": "float32", "shape": (6,), "names": list(WRENCH)},
    }
