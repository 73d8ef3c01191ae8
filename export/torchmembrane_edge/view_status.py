"""The status of a frame of several views in words, with the names of the views that were left out or have moved."""

from collections.abc import Mapping, Sequence

import numpy as np

from .session import Session

STILL = (1.0, 0.3, 0.005)
"""Largest image motion found for a camera that stands still: px, degrees, scale."""
LEFT_OUT = 10
"""Status of a frame that was reconstructed without one of its views."""


def status_in_words(session: Session, result: Mapping[str, np.ndarray], lacking: Mapping[str, str]) -> str:
    """Return a frame's status in the words of `torchmembrane reconstruct`.

    Arguments: `session`, which computed the frame; `result`, its arrays; `lacking`, the reason for each view without an image,
        by name.
    """
    status, views = int(result["status"]), session.mesh.get("view_names", "").split()
    text = session.status_text(status)
    if not views or not np.isfinite(result["vertices"]).all():
        return text
    moved = moved_views(result, views)
    said = f"; view {', '.join(moved)} has moved since the rest image" if moved else ""
    if status != LEFT_OUT:
        return text + said
    seen = result.get("confidence", np.ones((len(views), 1)))
    out = [name for name, sure in zip(views, seen, strict=False) if name in lacking or not sure.any()]
    return f"{text}: {', '.join(f'{name} ({lacking[name]})' if name in lacking else name for name in out)}{said}"


def moved_views(result: Mapping[str, np.ndarray], views: Sequence[str]) -> list[str]:
    """Return the names of the views whose camera has moved relative to the rim since the rest image, by `camera_motion`."""
    if "camera_motion" not in result:
        return []
    du, dv, degrees, scale = np.moveaxis(np.asarray(result["camera_motion"]), -1, 0)
    sizes = np.hypot(du, dv), abs(degrees), abs(scale - 1)
    has_moved = np.any([size > least for size, least in zip(sizes, STILL, strict=True)], 0)
    return [name for name, moved in zip(views, has_moved, strict=False) if moved]
