"""A rigid indenter given as a closed triangle mesh; it requires trimesh (extra `mesh`)."""

import io
from dataclasses import dataclass, field
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ..errors import MembraneError, check_arguments, expect
from ..files.safe_read import DAMAGE, in_one_line, read_bytes
from ..torch_modes import on_cpu
from .indenters import Indenter, box_distance

KINDS = ("stl", "obj", "ply")
MOST_TRIANGLES, MOST_BYTES = 200_000, 2**25
"""Largest number of triangles, and of bytes, of a file."""


@check_arguments
@on_cpu
@dataclass(frozen=True, eq=False)
class MeshIndenter(Indenter):
    """A body bounded by a closed triangle mesh.

    Distances are exact within the mesh's bounding box, enlarged by a quarter of its longest side. Farther away they are the
    distance to the contents of that box, a lower bound. The normal is not differentiable at edges.

    Args:
        vertices: `[N, 3]`, length unit.
        triangles: `[M, 3]`, counterclockwise as seen from outside.

    Raises:
        MembraneError: the mesh is not closed, or trimesh is not installed.

    Reference:
        J. A. Baerentzen, H. Aanaes: Signed distance computation using the angle weighted pseudonormal, 2005.

    Example:
        >>> corners = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])
        >>> body = MeshIndenter(corners, np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]]))
        >>> round(body.distance(torch.tensor([0.2, 0.2, -0.1])).item(), 6)
        0.1
    """

    vertices: np.ndarray
    triangles: np.ndarray

    _body: Any = field(init=False, repr=False)
    _normals: np.ndarray = field(init=False, repr=False)

    def __post_init__(self) -> None:
        super().__post_init__()
        vertices, triangles = np.asarray(self.vertices, float), np.asarray(self.triangles)
        for name, array, corners in (("vertices", vertices, "finite"), ("triangles", triangles, "numbers of vertices")):
            right = array.ndim == 2 and array.shape[1] == 3 and len(array) > 0
            right = right and bool(
                np.isfinite(array).all() if name == "vertices" else np.isin(array, range(len(vertices))).all()
            )
            expect(right, f"MeshIndenter: {name}", f"an array {list(array.shape)}", f"[N, 3], {corners}")
        body = _trimesh().Trimesh(vertices, triangles, process=True)
        if not body.is_volume:
            raise MembraneError(
                f"MeshIndenter: {len(body.vertices)} vertices, {len(body.faces)} triangles, watertight: {body.is_watertight}; "
                "expected a closed mesh whose triangles face outwards: repair it"
            )
        object.__setattr__(self, "_body", body)
        object.__setattr__(self, "_normals", _feature_normals(body))

    @classmethod
    def read(cls, path: str | Path, **pose: Any) -> "MeshIndenter":
        """Read a closed mesh from a file.

        Args:
            path: an STL, OBJ or PLY file, in the sensor's length unit.
            pose: `translation` and `rotation` of the body.

        Raises:
            MembraneError: the file is not such a mesh, too large or damaged, the mesh is not closed, or trimesh is not
                installed.
        """
        path, expected = Path(path), f"a closed mesh as STL, OBJ or PLY, of at most {MOST_TRIANGLES} triangles"
        kind, trimesh = path.suffix.lower().removeprefix("."), _trimesh()
        if kind not in KINDS:
            raise MembraneError(f"{path}: its name is not that of a mesh; expected {expected}")
        content = read_bytes(path, MOST_BYTES, expected)
        try:
            if kind != "ply":
                content = _whole_stl(content) if kind == "stl" else _in_utf8(content)
            body = trimesh.load_mesh(io.BytesIO(content), file_type=kind)
            vertices, faces = np.asarray(body.vertices, float), np.asarray(body.faces)
        except DAMAGE as error:
            raise MembraneError(f"{path}: not readable ({in_one_line(error)}); expected {expected}") from error
        if not 0 < len(faces) <= MOST_TRIANGLES or not np.isfinite(vertices).all():
            raise MembraneError(f"{path}: {len(faces)} triangles, or corners that are not finite; expected {expected}")
        return cls(vertices, faces, **pose)

    def local_distance(self, points: Tensor) -> Tensor:
        low, high = torch.from_numpy(self._body.bounds.copy()).to(points)
        box = box_distance((points - (low + high) / 2).abs() - (high - low) / 2)
        near = box.detach() < (high - low).max() / 4
        closest, normal = self._closest(points[near].detach().double().numpy())
        exact = ((points[near] - torch.from_numpy(closest).to(points)) * torch.from_numpy(normal).to(points)).sum(-1)
        return box.masked_scatter(near, exact)

    def _closest(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the closest surface points and the distance's gradient, signed by the feature's normal; `[P, 3]` each."""
        if not len(points):
            return points, points
        closest, distance, triangle = self._body.nearest.on_surface(points)
        weights = _trimesh().triangles.points_to_barycentric(self._body.triangles[triangle], closest)
        least, most = weights.min(1), weights.max(1)
        feature = np.where(most > 1 - 1e-6, 4 + weights.argmax(1), np.where(least < 1e-6, 1 + weights.argmin(1), 0))
        outward = self._normals[triangle, feature]
        away = points - closest
        side = np.where((away * outward).sum(1) < 0, -1.0, 1.0)
        on_surface = distance < 1e-9 * self._body.scale
        return closest, np.where(on_surface[:, None], outward, (side / np.maximum(distance, 1e-300))[:, None] * away)


def _feature_normals(body: Any) -> np.ndarray:
    """Return unit normals `[M, 7, 3]` of each triangle, its edges opposite the corners, and its corners (weighted by angle)."""
    faces = body.face_normals
    edges = np.zeros((len(body.edges_unique), 3))
    np.add.at(edges, body.faces_unique_edges, faces[:, None])
    normals = np.concatenate(
        [faces[:, None], edges[np.roll(body.faces_unique_edges, -1, 1)], body.vertex_normals[body.faces]], axis=1
    )
    return normals / np.linalg.norm(normals, axis=-1, keepdims=True)


def _whole_stl(content: bytes) -> bytes:
    """Check the content of an STL file and return it, text as UTF-8.

    Raises:
        ValueError: the content is neither binary nor text STL; trimesh would read a binary file of the wrong length as text.
    """
    triangles = int.from_bytes(content[80:84], "little")
    if len(content) == 84 + 50 * triangles:
        return content
    if b"facet" in content.lower():
        return _in_utf8(content)
    if len(content) < 84:
        raise ValueError(f"it holds {len(content)} bytes and no facet")
    stated = f"as a binary STL it states {triangles} triangles, which take {84 + 50 * triangles} bytes"
    raise ValueError(f"{stated}, and holds {len(content)}; as text it has no facet")


def _in_utf8(content: bytes) -> bytes:
    """Return text in UTF-8; only names and comments can have had another encoding."""
    try:
        content.decode()
    except UnicodeDecodeError:
        return content.decode("latin-1").encode()
    return content


def _trimesh() -> ModuleType:
    try:
        import rtree  # noqa: F401
        import trimesh
    except ImportError as error:
        raise MembraneError(
            f"MeshIndenter: {error.name} is missing; install the extra: pip install torchmembrane[mesh]"
        ) from error
    return trimesh
