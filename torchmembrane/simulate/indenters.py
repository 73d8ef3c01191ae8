"""Rigid indenters as signed distance functions: negative inside, gradient = outward normal.

Every indenter is given in its own frame, in which it presses along +z with its tip at the origin or its centre there, and is
placed by a rotation and a translation: `x = R y + t`. Distances are exact outside; inside, exact up to the medial axis.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import torch
from scipy.spatial.transform import Rotation, Slerp
from torch import Tensor

from ..errors import MembraneError
from ..surface.membrane import Membrane

APPROACH_STEPS = 10_000


def facing(direction) -> Tensor:
    """A rotation `[3, 3]` whose third axis is `direction [3]`, the first as near to x as can be (to y for x itself)."""
    z = torch.nn.functional.normalize(torch.as_tensor(direction, dtype=torch.float64), dim=-1)
    x = torch.tensor([1.0, 0, 0] if abs(float(z[0])) < 0.9 else [0, 1.0, 0], dtype=torch.float64)
    x = torch.nn.functional.normalize(x - (x @ z) * z, dim=-1)
    return torch.stack([x, torch.linalg.cross(z, x), z], -1)


@dataclass(frozen=True, eq=False)
class Indenter:
    """A rigid body; subclasses give `local_distance(points [..., 3]) -> [...]` in the body's own frame.

    Arguments of all: `translation [3]` (length unit), `rotation [3, 3]`, both in the camera's frame.
    Raises `MembraneError` for a rotation that is none, and for sizes that are not positive.
    """

    translation: Tensor = field(default=(0.0, 0.0, 0.0), kw_only=True)
    rotation: Tensor = field(default=((1.0, 0, 0), (0, 1.0, 0), (0, 0, 1.0)), kw_only=True)

    def __post_init__(self):
        for name in ("translation", "rotation"):
            object.__setattr__(self, name, torch.as_tensor(getattr(self, name), dtype=torch.float64))
        R = self.rotation.detach()
        proper = R.shape == (3, 3) and torch.allclose(R @ R.T, torch.eye(3, dtype=R.dtype), atol=1e-6) and R.det() > 0
        if not proper or self.translation.shape != (3,) or not self.translation.isfinite().all():
            raise MembraneError(
                f"{type(self).__name__}: translation {self.translation.tolist()}, rotation {R.tolist()}; expected [3] and a "
                "right-handed orthonormal [3, 3]; `facing(direction)` makes one"
            )

    def local_distance(self, points: Tensor) -> Tensor:
        raise NotImplementedError

    def distance(self, points: Tensor) -> Tensor:
        """Signed distance of `points [..., 3]` to the surface, `[...]`, negative inside."""
        return self.local_distance((points - self.translation) @ self.rotation)

    def normal(self, points: Tensor) -> Tensor:
        """Outward unit normal `[..., 3]`, the gradient of `distance`; differentiable where that is smooth."""
        return self.distance_and_normal(points)[1]

    def distance_and_normal(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """`distance` and `normal` at once."""
        with torch.enable_grad():
            points = points if points.requires_grad else points.detach().requires_grad_()
            distance = self.distance(points)
            (normal,) = torch.autograd.grad(distance.sum(), points, create_graph=True)
        return distance, normal

    def at(self, translation, rotation=None) -> "Indenter":
        """The same body at another place."""
        return replace(self, translation=translation, rotation=self.rotation if rotation is None else rotation)

    def moved(self, offset) -> "Indenter":
        """The same body, translated by `offset [3]`."""
        return self.at(self.translation + torch.as_tensor(offset, dtype=torch.float64))

    def between(self, other: "Indenter", share: float) -> "Indenter":
        """The pose after `share` of the way to `other`: straight, and turning evenly about one axis."""
        turns = Rotation.from_matrix(np.stack([self.rotation.detach(), other.rotation.detach()]))
        rotation = torch.from_numpy(Slerp([0, 1], turns)(share).as_matrix().copy())
        return self.at(torch.lerp(self.translation, other.translation, share), rotation)

    def touching(self, membrane: Membrane, direction) -> "Indenter":
        """The body moved along `direction [3]` from far outside until it just touches the rest surface's vertices.

        Conservative advancement: a step by the smallest distance never goes too far. Raises where it passes by
        or faces away.
        """
        d = torch.nn.functional.normalize(torch.as_tensor(direction, dtype=torch.float64), dim=-1)
        far = float((membrane.rest - self.translation).norm(dim=-1).max()) + membrane.size
        body = self.moved(-2 * far * d)
        for _ in range(APPROACH_STEPS):
            gap = float(body.distance(membrane.rest).min())
            if abs(gap) < 1e-7 * membrane.size:
                return body
            if gap < 0 or (body.translation - self.translation) @ d > 3 * far:
                break
            body = body.moved(gap * d)
        raise MembraneError(
            f"{type(self).__name__}.touching: moving along {d.tolist()} it does not meet the rest surface from "
            "outside; expected a body that faces it: change the direction, turn the body, or move it sideways"
        )

    def _positive(self, **values) -> None:
        for name, value in values.items():
            if not (torch.as_tensor(value) > 0).all():
                raise MembraneError(f"{type(self).__name__}: {name} = {value}; expected a positive length")


@dataclass(frozen=True, eq=False)
class Sphere(Indenter):
    """A ball of `radius` around the origin.

    >>> Sphere(2.0, translation=(0, 0, 5)).distance(torch.tensor([0.0, 0, 10])).item()
    3.0
    """

    radius: float

    def __post_init__(self):
        super().__post_init__()
        self._positive(radius=self.radius)

    def local_distance(self, points: Tensor) -> Tensor:
        return norm(points) - self.radius


@dataclass(frozen=True, eq=False)
class Plane(Indenter):
    """The half space `z <= 0`: a plate that presses along its outward normal, the third axis of its rotation.

    >>> Plane(rotation=facing((0, 0, -1))).distance(torch.tensor([0.0, 0, 10])).item()
    -10.0
    """

    def local_distance(self, points: Tensor) -> Tensor:
        return points[..., 2]


@dataclass(frozen=True, eq=False)
class Cylinder(Indenter):
    """A cylinder of `radius` about `axis [3]` through the origin, endless, or `length` long with flat ends."""

    radius: float
    axis: Tensor = (1.0, 0.0, 0.0)
    length: float | None = None

    def __post_init__(self):
        super().__post_init__()
        self._positive(radius=self.radius, **({} if self.length is None else {"length": self.length}))
        axis = torch.as_tensor(self.axis, dtype=torch.float64)
        if axis.shape != (3,) or not axis.norm() > 0:
            raise MembraneError(f"Cylinder: axis = {self.axis}; expected a vector [3] that is not zero")
        object.__setattr__(self, "axis", axis / axis.norm())

    def local_distance(self, points: Tensor) -> Tensor:
        along = (points * self.axis).sum(-1, keepdim=True)
        across = norm(points - along * self.axis) - self.radius
        if self.length is None:
            return across
        return _box(torch.stack([across, along.squeeze(-1).abs() - self.length / 2], -1))


@dataclass(frozen=True, eq=False)
class Wedge(Indenter):
    """A straight edge along x, its tip at the origin pointing to +z, `opening` degrees wide and rounded with `radius`."""

    opening: float
    radius: float

    def __post_init__(self):
        super().__post_init__()
        self._positive(radius=self.radius)
        if not 0 < self.opening < 180:
            raise MembraneError(f"Wedge: opening = {self.opening}; expected degrees between 0 and 180")

    def local_distance(self, points: Tensor) -> Tensor:
        half = torch.deg2rad(torch.as_tensor(self.opening / 2, dtype=points.dtype))
        y, z = points[..., 1].abs(), points[..., 2] + self.radius
        on_flank = y * half.sin() - z * half.cos() > 0
        return torch.where(on_flank, y * half.cos() + z * half.sin(), norm(torch.stack([y, z], -1))) - self.radius


@dataclass(frozen=True, eq=False)
class Box(Indenter):
    """A box of side lengths `sides [3]` around the origin, its edges and corners rounded with `radius`."""

    sides: Tensor
    radius: float

    def __post_init__(self):
        super().__post_init__()
        self._positive(radius=self.radius)
        object.__setattr__(self, "sides", torch.as_tensor(self.sides, dtype=torch.float64))
        if self.sides.shape != (3,) or not (self.sides >= 2 * self.radius).all():
            raise MembraneError(f"Box: sides {self.sides.tolist()}, radius {self.radius}; expected three sides >= 2 radius")

    def local_distance(self, points: Tensor) -> Tensor:
        return _box(points.abs() - (self.sides / 2 - self.radius)) - self.radius


@dataclass(frozen=True, eq=False)
class Union(Indenter):
    """Several bodies, `parts`, joined to one rigid body."""

    parts: Sequence[Indenter]

    def __post_init__(self):
        super().__post_init__()
        if not self.parts:
            raise MembraneError("Union: no parts; expected at least one indenter")

    def local_distance(self, points: Tensor) -> Tensor:
        return torch.stack([part.distance(points) for part in self.parts], -1).amin(-1)


@dataclass(frozen=True, eq=False)
class Mesh(Indenter):
    """A closed triangle mesh: `vertices [N, 3]`, `triangles [M, 3]` wound outwards; through trimesh (extra `mesh`).

    Exact within the mesh's bounding box, enlarged by a quarter of its longest side; farther away the distance to that box's
    content, a lower bound. The normal turns at edges without being differentiable there.
    """

    vertices: np.ndarray
    triangles: np.ndarray

    def __post_init__(self):
        super().__post_init__()
        body = _trimesh().Trimesh(np.asarray(self.vertices, float), np.asarray(self.triangles), process=True)
        if not body.is_volume:
            raise MembraneError(
                f"Mesh: {len(body.vertices)} vertices, {len(body.faces)} triangles, watertight: {body.is_watertight}; "
                "expected a closed mesh wound outwards: repair it"
            )
        object.__setattr__(self, "_body", body)
        object.__setattr__(self, "_normals", _feature_normals(body))

    @classmethod
    def read(cls, path, **pose) -> "Mesh":
        """The closed mesh in a file (STL, OBJ, PLY ...), in the file's own length unit."""
        body = _trimesh().load_mesh(path)
        return cls(body.vertices, body.faces, **pose)

    def local_distance(self, points: Tensor) -> Tensor:
        low, high = torch.from_numpy(self._body.bounds.copy()).to(points)
        box = _box((points - (low + high) / 2).abs() - (high - low) / 2)
        near = box.detach() < (high - low).max() / 4
        closest, normal = self._closest(points[near].detach().double().numpy())
        exact = ((points[near] - torch.from_numpy(closest).to(points)) * torch.from_numpy(normal).to(points)).sum(-1)
        return box.masked_scatter(near, exact)

    def _closest(self, points):
        """Closest surface points and the distance's gradient, its sign by the feature's normal (Baerentzen, Aanaes 2005)."""
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


def _feature_normals(body) -> np.ndarray:
    """Unit normals `[M, 7, 3]` of each triangle, the edges opposite its corners, and its corners (weighted by angle)."""
    faces = body.face_normals
    edges = np.zeros((len(body.edges_unique), 3))
    np.add.at(edges, body.faces_unique_edges, faces[:, None])
    normals = np.concatenate(
        [faces[:, None], edges[np.roll(body.faces_unique_edges, -1, 1)], body.vertex_normals[body.faces]], axis=1
    )
    return normals / np.linalg.norm(normals, axis=-1, keepdims=True)


def _trimesh():
    try:
        import rtree  # noqa: F401
        import trimesh
    except ImportError as error:
        raise MembraneError(f"Mesh: {error.name} is missing; install the extra: pip install torchmembrane[mesh]") from error
    return trimesh


def norm(vectors: Tensor) -> Tensor:
    """Length `[...]`; zero, with zero gradient, for the zero vector."""
    square = (vectors * vectors).sum(-1)
    return torch.where(square > 0, square, 1).sqrt() * (square > 0)


def _box(excess: Tensor) -> Tensor:
    """Distance to a box by how far a point exceeds each side, `[..., C]` to `[...]`."""
    return norm(excess.clamp_min(0)) + excess.amax(-1).clamp_max(0)
