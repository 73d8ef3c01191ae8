"""The status of a frame of several views in words, with the names of the views that were left out."""

from collections.abc import Mapping, Sequence

import numpy as np

from .status import Status


def status_in_words(frame: Mapping[str, np.ndarray], views: Sequence[str], lacking: Mapping[str, str] | None = None) -> str:
    """A frame's status in words; where a view was left out, which.

    Args:
        frame: its arrays.
        views: names of the views; none of a single one.
        lacking: why views had no image, by their names.

    Example:
        >>> frame = {"status": np.array(10), "confidence": np.array([[1.0, 0.9], [0.0, 0.0]])}
        >>> status_in_words(frame, ["left", "right"], {"right": "no picture"}).partition("left out: ")[2]
        "the answer is the others': right (no picture)"
    """
    status, lacking = Status(int(frame["status"])), lacking or {}
    if status != Status.VIEW_LEFT_OUT or not views:
        return status.text
    out = [name for name, sure in zip(views, frame["confidence"], strict=True) if not sure.any()]
    return f"{status.text}: {', '.join(f'{name} ({lacking[name]})' if name in lacking else name for name in out)}"
