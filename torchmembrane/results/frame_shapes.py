"""The shapes of a frame's arrays: `V` vertices, `D` markers, `P` contact patches and, with several views, `W` views."""

from collections.abc import Mapping

import numpy as np

SHAPES: dict[str, tuple[str | int, ...]] = {
    **{key: ("V", 3) for key in ("vertices", "displacement", "normals")},
    **{"markers": ("D", 3), "pixels": ("D", 2), "confidence": ("D",), "traction": ("V", 3), "contact": ("V",)},
    **{"contact_points": ("P", 3), "force": (3,)},
    **{key: () for key in ("pressure", "pressure_change", "volume_error", "residual", "status")},
    **{"wrench": (6,), "contact_force": ("P", 3), "contact_normal": ("P", 3), "contact_area": ("P",), "contact_slip": ("P",)},
    **{"contact_curvature": ("P", 2), "contact_at_rim": ("P",), "coverage": (), "camera_motion": (4,)},
    **{"force_deviation": (3,), "depth_deviation": ()},
}

FIELDS: dict[str, tuple[str | int, ...]] = {"stretch": ("V", 2), "tension": ("V", 2)}
"""Shapes of optional arrays of a frame: principal values, those of the larger stretch first."""
OF_EACH_VIEW = ("pixels", "confidence", "residual", "camera_motion")
"""Arrays that begin with an axis `W` if there are several views."""


def shape_of(key: str, sizes: Mapping[str, int]) -> tuple[int, ...]:
    """Return the shape of an array for given numbers of vertices, markers and patches, and of several views, `W`.

    Example:
        >>> shape_of("contact_force", {"P": 4})
        (4, 3)
    """
    alone = tuple(sizes[length] if isinstance(length, str) else length for length in (SHAPES | FIELDS)[key])
    return (sizes["W"], *alone) if key in OF_EACH_VIEW and sizes.get("W") else alone


def of_first_view(frame: Mapping[str, np.ndarray], key: str) -> np.ndarray:
    """Return an array of a frame; with several views, the first view's part of it.

    Example:
        >>> of_first_view({"residual": np.array([0.1, 0.2])}, "residual").item()
        0.1
    """
    array = np.asarray(frame[key])
    first: np.ndarray = np.asarray(array[0]) if array.ndim > len(SHAPES[key]) else array
    return first


def shape_mismatch(frame: Mapping[str, np.ndarray], vertices: int, markers: int, views: int = 0) -> str:
    """Describe the first array of a frame whose shape does not fit these numbers of vertices and markers; "" if all fit. For a
    sensor with one view, `views` is 0.

    Example:
        >>> shape_mismatch({key: np.zeros(shape_of(key, {"V": 9, "D": 2, "P": 4})) for key in SHAPES}, 9, 3)
        'markers is float64 (2, 3), expected numbers (3, 3)'
    """
    sizes = {"V": vertices, "D": markers, "P": len(np.atleast_1d(frame["contact_points"])), "W": views}
    for key, array in ((key, np.asarray(value)) for key, value in frame.items()):
        if array.dtype.kind not in "iuf" or array.shape != shape_of(key, sizes):
            return f"{key} is {array.dtype} {array.shape}, expected numbers {shape_of(key, sizes)}"
    return ""
