"""The shapes of a frame's arrays: `V` vertices, `D` markers, `P` contact patches."""

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


def shape_of(key: str, sizes: Mapping[str, int]) -> tuple[int, ...]:
    """The shape of an array for given numbers of vertices, markers and patches.

    Example:
        >>> shape_of("contact_force", {"P": 4})
        (4, 3)
    """
    return tuple(sizes[length] if isinstance(length, str) else length for length in SHAPES[key])


def unlike(frame: Mapping[str, np.ndarray], vertices: int, markers: int) -> str:
    """What of a frame is not as of a surface with so many vertices and markers; "" where all is.

    Example:
        >>> unlike({key: np.zeros(shape_of(key, {"V": 9, "D": 2, "P": 4})) for key in SHAPES}, 9, 3)
        'markers is float64 (2, 3), expected numbers (3, 3)'
    """
    sizes = {"V": vertices, "D": markers, "P": len(np.atleast_1d(frame["contact_points"]))}
    for key, array in ((key, np.asarray(value)) for key, value in frame.items()):
        if array.dtype.kind not in "iuf" or array.shape != shape_of(key, sizes):
            return f"{key} is {array.dtype} {array.shape}, expected numbers {shape_of(key, sizes)}"
    return ""
