"""Rigid indenters as signed distance functions: negative inside; the gradient is the outward normal.

Every indenter is defined in its own frame, in which it presses along +z with its tip or centre at the origin. It is placed by a
rotation and a translation: `x = R y + t`. Distances are exact outside, and inside up to the medial axis.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import torch
from scipy.spatial.transform import Rotation, Slerp
from torch import Tensor

from ..errors import MembraneError, check_arguments
from ..files.tensors import tensor_of
from ..surface.membrane import Membrane
from ..torch_modes import on_cpu

APPROACH_STEPS = 10_000

Vector = Tensor | np.ndarray | Sequence[float]


@check_arguments
@on_cpu
def facing(direction: Vector) -> Tensor:
    """Return a rotation that turns a body's +z axis to a direction.

    Args:
        direction: the direction, `[3]`, of any length.

    Returns:
        The rotation `[3, 3]`: its third column is the direction, its first is as close to x as possible (to y if the direction
        is x).

    Example:
        >>> facing((0, 0, -2.0))[:, 2].tolist()
        [0.0, 0.0, -1.0]
    """
    z = torch.nn.functional.normalize(_vector("facing: direction", direction), dim=-1)
    x = torch.tensor([1.0, 0, 0] if abs(float(z[0])) < 0.9 else [0, 1.0, 0], dtype=torch.float64)
    x = torch.nn.functional.normalize(x - (x @ z) * z, dim=-1)
    return torch.stack([x, torch.linalg.cross(z, x), z], -1)


@check_arguments
@on_cpu
@dataclass(frozen=True, eq=False)
class Indenter:
    """A rigid body; subclasses define `local_distance(points [..., 3]) -> [...]` in the body's own frame.

    Args:
        translation: position in the camera's frame, `[3]`, length unit.
        rotation: rotation to the camera's frame, `[3, 3]`.

    Raises:
        MembraneError: `rotation` is not a rotation, or a size is not positive.

    Example:
        >>> class Slab(Indenter):
        ...     def local_distance(self, points):
        ...         return points[..., 2].abs() - 1
        >>> Slab(translation=(0, 0, 5)).distance(torch.tensor([0.0, 0.0, 8.0])).item()
        2.0
    """

    translation: Tensor = field(default_factory=lambda: torch.zeros(3, dtype=torch.float64), kw_only=True)
    rotation: Tensor = field(default_factory=lambda: torch.eye(3, dtype=torch.float64), kw_only=True)

    def __post_init__(self) -> None:
        for name in ("translation", "rotation"):
            object.__setattr__(self, name, torch.as_tensor(getattr(self, name), dtype=torch.float64))
        R = self.rotation.detach()
        proper = R.shape == (3, 3) and torch.allclose(R @ R.T, torch.eye(3, dtype=R.dtype), atol=1e-6) and R.det() > 0
        if not proper or self.translation.shape != (3,) or not self.translation.isfinite().all():
            raise MembraneError(
                f"{type(self).__name__}: translation {self.translation.tolist()}, rotation {R.tolist()}; expected [3] and a "
                "right-handed orthonormal [3, 3]; `facing(direction)` makes one"
            )

    @property
    def kind(self) -> str:
        """Return the body's name in a frame's truth: sphere, plane, mesh ..."""
        return type(self).__name__.removesuffix("Indenter").lower()

    def local_distance(self, points: Tensor) -> Tensor:
        """Return the signed distance of points in the body's own frame, `[..., 3]` to `[...]`."""
        raise NotImplementedError

    def distance(self, points: Tensor) -> Tensor:
        """Return the signed distance of `points [..., 3]` from the surface, `[...]`, negative inside."""
        return self.local_distance((points - self.translation) @ self.rotation)

    def normal(self, points: Tensor) -> Tensor:
        """Return the outward unit normal `[..., 3]`, the gradient of `distance`; differentiable where that is smooth."""
        return self.distance_and_normal(points)[1]

    def distance_and_normal(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """Return `distance` and `normal` together."""
        with torch.enable_grad():
            points = points if points.requires_grad else points.detach().requires_grad_()
            distance = self.distance(points)
            (normal,) = torch.autograd.grad(distance.sum(), points, create_graph=True)
        return distance, normal

    @check_arguments
    def at(self, translation: Vector, rotation: Tensor | None = None) -> "Indenter":
        """Return the same body at `translation [3]`, turned by `rotation [3, 3]` (default: unchanged)."""
        place = _vector(f"{type(self).__name__}.at: translation", translation)
        return replace(self, translation=place, rotation=self.rotation if rotation is None else rotation)

    @check_arguments
    def moved(self, offset: Vector) -> "Indenter":
        """Return the same body, translated by `offset [3]`."""
        return self.at(self.translation + _vector(f"{type(self).__name__}.moved: offset", offset))

    @check_arguments
    def between(self, other: "Indenter", share: float) -> "Indenter":
        """Return the body at a `share` of the way to `other`: along a straight line, with uniform rotation about one axis."""
        turns = Rotation.from_matrix(np.stack([self.rotation.detach(), other.rotation.detach()]))
        rotation = torch.from_numpy(Slerp([0, 1], turns)(share).as_matrix().copy())
        return self.at(torch.lerp(self.translation, other.translation, share), rotation)

    @check_arguments
    def touching(self, membrane: Membrane, direction: Vector) -> "Indenter":
        """Return the body moved from far outside until it just touches the vertices of the rest surface.

        The method is conservative advancement: a step by the smallest distance never goes too far.

        Args:
            membrane: the membrane at rest.
            direction: direction of the motion, `[3]`.

        Raises:
            MembraneError: the body misses the surface, or faces away from it.
        """
        direction = _vector(f"{type(self).__name__}.touching: direction", direction)
        d = torch.nn.functional.normalize(direction, dim=-1)
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

    def _positive(self, **values: Tensor | float) -> None:
        for name, value in values.items():
            if not (torch.as_tensor(value) > 0).all():
                raise MembraneError(f"{type(self).__name__}: {name} = {value}; expected a positive length")


@check_arguments
@on_cpu
@dataclass(frozen=True, eq=False)
class Sphere(Indenter):
    """A ball centred at the origin.

    Args:
        radius: length unit.

    Example:
        >>> Sphere(2.0, translation=(0, 0, 5)).distance(torch.tensor([0.0, 0, 10])).item()
        3.0
    """

    radius: float

    def __post_init__(self) -> None:
        super().__post_init__()
        self._positive(radius=self.radius)

    def local_distance(self, points: Tensor) -> Tensor:
        return norm(points) - self.radius


@check_arguments
@on_cpu
@dataclass(frozen=True, eq=False)
class Plane(Indenter):
    """The half space `z <= 0`: a plate that presses along its outward normal, the third axis of its rotation.

    Example:
        >>> Plane(rotation=facing((0, 0, -1))).distance(torch.tensor([0.0, 0, 10])).item()
        -10.0
    """

    def local_distance(self, points: Tensor) -> Tensor:
        return points[..., 2]


@check_arguments
@on_cpu
@dataclass(frozen=True, eq=False)
class Cylinder(Indenter):
    """A cylinder about an axis through the origin.

    Args:
        radius: radius, length unit.
        axis: direction of the axis, `[3]`; default: x.
        length: distance between the flat ends, length unit; default: infinite.

    Example:
        >>> Cylinder(2.0, length=6.0).distance(torch.tensor([[0.0, 0, 4], [6.0, 0, 0]])).tolist()
        [2.0, 3.0]
    """

    radius: float
    axis: Tensor = field(default_factory=lambda: torch.tensor([1.0, 0.0, 0.0], dtype=torch.float64))
    length: float | None = None

    def __post_init__(self) -> None:
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
        return box_distance(torch.stack([across, along.squeeze(-1).abs() - self.length / 2], -1))


@check_arguments
@on_cpu
@dataclass(frozen=True, eq=False)
class Wedge(Indenter):
    """A straight edge along x, with its tip at the origin pointing to +z.

    Args:
        opening: angle between the flanks, degrees.
        radius: radius of the rounded edge, length unit.

    Example:
        >>> round(Wedge(90.0, 0.5).distance(torch.tensor([0.0, 0, 2])).item(), 6)
        2.0
    """

    opening: float
    radius: float

    def __post_init__(self) -> None:
        super().__post_init__()
        self._positive(radius=self.radius)
        if not 0 < self.opening < 180:
            raise MembraneError(f"Wedge: opening = {self.opening}; expected degrees between 0 and 180")

    def local_distance(self, points: Tensor) -> Tensor:
        half = torch.deg2rad(torch.as_tensor(self.opening / 2, dtype=points.dtype, device=points.device))
        y, z = points[..., 1].abs(), points[..., 2] + self.radius
        on_flank = y * half.sin() - z * half.cos() > 0
        return torch.where(on_flank, y * half.cos() + z * half.sin(), norm(torch.stack([y, z], -1))) - self.radius


@check_arguments
@on_cpu
@dataclass(frozen=True, eq=False)
class Box(Indenter):
    """A box centred at the origin, with rounded edges and corners.

    Args:
        sides: lengths of the sides, `[3]`, length unit.
        radius: radius of edges and corners, length unit.

    Example:
        >>> Box((4.0, 4.0, 2.0), 0.5).distance(torch.tensor([[0.0, 0, 3], [0.0, 0, 0]])).tolist()
        [2.0, -1.0]
    """

    sides: Tensor
    radius: float

    def __post_init__(self) -> None:
        super().__post_init__()
        self._positive(radius=self.radius)
        object.__setattr__(self, "sides", torch.as_tensor(self.sides, dtype=torch.float64))
        if self.sides.shape != (3,) or not (self.sides >= 2 * self.radius).all():
            raise MembraneError(f"Box: sides {self.sides.tolist()}, radius {self.radius}; expected three sides >= 2 radius")

    def local_distance(self, points: Tensor) -> Tensor:
        return box_distance(points.abs() - (self.sides / 2 - self.radius)) - self.radius


@check_arguments
@on_cpu
@dataclass(frozen=True, eq=False)
class Union(Indenter):
    """Several bodies joined to one rigid body.

    Args:
        parts: the bodies, each in its pose relative to the union.

    Example:
        >>> pair = Union([Sphere(1.0, translation=(-2, 0, 0)), Sphere(1.0, translation=(2, 0, 0))])
        >>> pair.distance(torch.tensor([5.0, 0, 0])).item()
        2.0
    """

    parts: Sequence[Indenter]

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.parts:
            raise MembraneError("Union: no parts; expected at least one indenter")

    def local_distance(self, points: Tensor) -> Tensor:
        return torch.stack([part.distance(points) for part in self.parts], -1).amin(-1)


def _vector(name: str, values: Vector) -> Tensor:
    vector = tensor_of(name, values).double()
    if vector.shape != (3,):
        raise MembraneError(f"{name} {list(vector.shape)}; expected [3], x, y and z")
    return vector


def norm(vectors: Tensor) -> Tensor:
    """Return the length of vectors, `[...]`; zero, with zero gradient, for the zero vector."""
    square = (vectors * vectors).sum(-1)
    return torch.where(square > 0, square, 1).sqrt() * (square > 0)


def box_distance(excess: Tensor) -> Tensor:
    """Return the signed distance to a box from the distances by which a point exceeds each side, `[..., C]` to `[...]`."""
    return norm(excess.clamp_min(0)) + excess.amax(-1).clamp_max(0)
