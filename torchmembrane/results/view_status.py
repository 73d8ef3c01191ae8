"""Text of the status of a frame with several views, naming views that were left out or have moved."""

from collections.abc import Mapping, Sequence

import numpy as np

from .status import Status

STILL = (1.0, 0.3, 0.005)
"""Largest apparent motion of a stationary camera's image: px, degrees, scale."""


def moved_views(frame: Mapping[str, np.ndarray], views: Sequence[str]) -> list[str]:
    """Return the names of views whose `camera_motion` shows that the camera has moved against the rim since the rest image.

    Example:
        >>> moved_views({"camera_motion": np.array([[0.1, 0, 0, 1], [8.7, 0.2, 0, 1]])}, ["left", "right"])
        ['right']
    """
    if not views:
        return []
    du, dv, degrees, scale = np.moveaxis(np.asarray(frame["camera_motion"]), -1, 0)
    sizes = np.hypot(du, dv), abs(degrees), abs(scale - 1)
    moved = np.any([size > least for size, least in zip(sizes, STILL, strict=True)], 0)
    return [name for name, has_moved in zip(views, moved, strict=True) if has_moved]


def status_in_words(frame: Mapping[str, np.ndarray], views: Sequence[str], lacking: Mapping[str, str] | None = None) -> str:
    """Return a frame's status as text, with the names of views that were left out or have moved.

    Args:
        frame: arrays of the frame.
        views: names of the views; empty for a sensor with one view.
        lacking: reasons why views have no image, by view name.

    Example:
        >>> frame = {"status": np.array(10), "confidence": np.array([[1.0, 0.9], [0.0, 0.0]])}
        >>> frame["camera_motion"] = np.array([[0.0, 0.0, 0.0, 1.0]] * 2)
        >>> status_in_words(frame, ["left", "right"], {"right": "no picture"}).partition("left out: ")[2]
        "the answer is the others': right (no picture)"
    """
    status, lacking = Status(int(frame["status"])), lacking or {}
    if not views or not status.has_surface:
        return status.text
    moved = moved_views(frame, views)
    said = f"; view {', '.join(moved)} has moved since the rest image" if moved else ""
    if status != Status.VIEW_LEFT_OUT:
        return status.text + said
    out = [name for name, sure in zip(views, frame["confidence"], strict=True) if not sure.any()]
    return f"{status.text}: {', '.join(f'{name} ({lacking[name]})' if name in lacking else name for name in out)}{said}"
