"""Export of a frame's surface as a mesh for other programs: PLY, or VTK's legacy format (ParaView)."""

from pathlib import Path

import numpy as np

from ..errors import MembraneError
from ..files.atomic import write_text
from .frame_shapes import FIELDS
from .reconstruction import Frame
from .store import Mesh

SUFFIXES = (".ply", ".vtk")
NAMES = {3: ("x", "y", "z"), 2: ("1", "2")}
"""Names of the components of vectors and of principal values."""


def save_surface(path: str | Path, frame: Frame, mesh: Mesh) -> list[str]:
    """Write a frame's surface with its normals, displacement and traction, and the principal values if the frame has them.

    Args:
        path: path of the file, `.ply` or `.vtk` (both ASCII), written atomically.
        frame: arrays as returned by `Reconstruction.frame`, optionally with `stretch` and `tension`.
        mesh: mesh of the results' folder, which contains the triangles.

    Returns:
        The names of the fields at the vertices.

    Raises:
        MembraneError: the suffix is unknown, or the frame has no surface.
    """
    suffix = Path(path).suffix.lower()
    if suffix not in SUFFIXES:
        raise MembraneError(f"{path}: expected a file {' or '.join(SUFFIXES)}")
    if not np.isfinite(frame["vertices"]).all():
        raise MembraneError(f"{path}: the frame has no surface; expected one whose status keeps its answer")
    names = ["normals", "displacement", "traction", *(key for key in FIELDS if key in frame)]
    fields = {name: np.asarray(frame[name], float) for name in names}
    write = _ply if suffix == ".ply" else _vtk
    write_text(Path(path), "\n".join(write(np.asarray(frame["vertices"], float), mesh.triangles, fields)) + "\n")
    return names


def _ply(vertices: np.ndarray, triangles: np.ndarray, fields: dict[str, np.ndarray]) -> list[str]:
    columns = list(NAMES[3]) + ["nx", "ny", "nz"]
    columns += [f"{key}_{part}" for key, field in fields.items() if key != "normals" for part in NAMES[field.shape[1]]]
    header = ["ply", "format ascii 1.0", f"element vertex {len(vertices)}", *(f"property float {name}" for name in columns)]
    header += [f"element face {len(triangles)}", "property list uchar int vertex_indices", "end_header"]
    return header + _rows(np.concatenate([vertices, *fields.values()], 1)) + [f"3 {a} {b} {c}" for a, b, c in triangles]


def _vtk(vertices: np.ndarray, triangles: np.ndarray, fields: dict[str, np.ndarray]) -> list[str]:
    lines = ["# vtk DataFile Version 3.0", "torchmembrane", "ASCII", "DATASET POLYDATA", f"POINTS {len(vertices)} float"]
    lines += _rows(vertices) + [f"POLYGONS {len(triangles)} {4 * len(triangles)}"]
    lines += [f"3 {a} {b} {c}" for a, b, c in triangles] + [f"POINT_DATA {len(vertices)}"]
    for name, field in fields.items():
        size = field.shape[1]
        lines += [f"VECTORS {name} float"] if size == 3 else [f"SCALARS {name} float {size}", "LOOKUP_TABLE default"]
        lines += _rows(field)
    return lines


def _rows(values: np.ndarray) -> list[str]:
    return [" ".join(f"{value:.7g}" for value in row) for row in values]
