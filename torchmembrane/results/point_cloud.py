"""Export of a frame's contact as a point cloud."""

from pathlib import Path

import numpy as np

from ..files.atomic import write_text
from .reconstruction import Frame

TOUCHED = 0.5
"""Smallest `contact` of a vertex in the point cloud."""


def save_contact_cloud(path: str | Path, frame: Frame) -> int:
    """Write the vertices in contact as a point cloud with normals and tractions.

    Args:
        path: path of the file, `.ply` (ASCII), written atomically.
        frame: arrays as returned by `Reconstruction.frame`.

    Returns:
        The number of points, those with `contact` above 0.5; 0 without a contact.

    Example:
        >>> import torch
        >>> from tempfile import TemporaryDirectory
        >>> from torchmembrane.results.reconstruction import Reconstruction
        >>> frame = Reconstruction(*torch.ones(26, 1, 2, 3)).frame(0) | {"contact": np.array([1.0, 0.0])}
        >>> with TemporaryDirectory() as folder:
        ...     save_contact_cloud(f"{folder}/press.ply", frame)
        1
    """
    touched = frame["contact"] > TOUCHED
    rows = np.concatenate([frame[key][touched] for key in ("vertices", "normals", "traction")], 1)
    names = ("x", "y", "z", "nx", "ny", "nz", "traction_x", "traction_y", "traction_z")
    properties = [f"property float {name}" for name in names]
    header = ["ply", "format ascii 1.0", f"element vertex {len(rows)}", *properties, "end_header"]
    lines = [" ".join(f"{value:.7g}" for value in row) for row in rows]
    write_text(path, "\n".join(header + lines) + "\n")
    return len(rows)
