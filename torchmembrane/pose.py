"""Poses: transformation of points, vectors and wrenches from the camera's frame to a tool's."""

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np

from .errors import MembraneError, check_arguments, expect, is_array

if TYPE_CHECKING:
    from torch import Tensor

Values = TypeVar("Values", "Tensor", np.ndarray)

ORTHOGONAL = 1e-3  # largest entry of R^T R - 1: rotations are written with three decimals or more


@check_arguments
@dataclass(frozen=True, eq=False)
class Pose:
    """The pose of a frame in another one, from the first to the other: `p_other = rotation p + translation`.

    A sensor's `tool` is the pose of the camera's frame in the tool's: the columns of its rotation are the directions of the
    camera's x (right in the image), y (down) and z (out of the lens) in the tool's frame, its translation is where the centre
    of projection is there.

    Args:
        rotation: `[3, 3]` rows of an orthogonal matrix of determinant 1; or a rotation vector `[3]`, degrees, which is kept as
            the matrix.
        translation: `[3]`, length unit.

    Raises:
        MembraneError: a rotation that is none, values that are not finite; says what came and what was expected.

    Example:
        The camera sits 30 above the tool's origin and looks down.

        >>> tool = Pose(np.array([180.0, 0.0, 0.0]), np.array([0.0, 0.0, 30.0]))
        >>> tool.points(np.array([1.0, 2.0, 10.0])).round(9)
        array([ 1., -2., 20.])
        >>> pressed = np.array([0.0, 0.0, -1.0, 0.0, 0.0, 0.0])  # against the camera, through its centre
        >>> tool.wrench(pressed).round(9) + 0.0
        array([0., 0., 1., 0., 0., 0.])
    """

    rotation: np.ndarray
    translation: np.ndarray

    def __post_init__(self) -> None:
        rotation, translation = np.asarray(self.rotation, float), np.asarray(self.translation, float)
        known = rotation.shape in ((3,), (3, 3)) and bool(np.isfinite(rotation).all())
        expect(
            known, "rotation", rotation.tolist(), "three rows of three finite numbers, or a rotation vector of three, degrees"
        )
        if rotation.ndim == 1:
            rotation = _turned_by(np.radians(rotation))
        product, determinant = rotation.T @ rotation, np.linalg.det(rotation)
        orthogonal = np.abs(product - np.eye(3)).max() <= ORTHOGONAL
        expected = "orthogonal rows of length one: give a rotation alone, without scale, with more decimals"
        expect(bool(orthogonal), "rotation", rotation.tolist(), expected)
        expected = "determinant 1; this one's is -1, a reflection: make the axes right-handed"
        expect(bool(determinant > 0), "rotation", rotation.tolist(), expected)
        known = translation.shape == (3,) and bool(np.isfinite(translation).all())
        expect(known, "translation", translation.tolist(), "three finite numbers, in the sensor's length unit")
        object.__setattr__(self, "rotation", rotation)
        object.__setattr__(self, "translation", translation)

    def points(self, points: Values) -> Values:
        """Points in the other frame, `R p + t`.

        Args:
            points: `[..., 3]`, length unit, tensor or array.

        Returns:
            `[..., 3]`.
        """
        points = _checked("Pose.points", points, 3)
        moved: Values = self.vectors(points) + _like(points, self.translation)
        return moved

    def vectors(self, vectors: Values) -> Values:
        """Forces, normals and displacements in the other frame, `R f`.

        Args:
            vectors: `[..., 3]`, tensor or array.

        Returns:
            `[..., 3]`.
        """
        vectors = _checked("Pose.vectors", vectors, 3)
        turned: Values = vectors @ _like(vectors, self.rotation.T)
        return turned

    def wrench(self, wrench: Values) -> Values:
        """A wrench in the other frame, its moment about that frame's origin: `(R f, R m + t x R f)`.

        Args:
            wrench: `[..., 6]`, force and moment about this frame's origin, tensor or array.

        Returns:
            `[..., 6]`.
        """
        wrench = _checked("Pose.wrench", wrench, 6)
        x, y, z = self.translation
        lever = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]]) @ self.rotation
        adjoint = np.block([[self.rotation, np.zeros((3, 3))], [lever, self.rotation]])
        moved: Values = wrench @ _like(wrench, adjoint.T)
        return moved


def _checked(name: str, values: Any, count: int) -> Any:
    """Values `[..., count]` as a tensor or an array of floating point."""
    if not is_array(values):
        raise MembraneError(f"{name}: a {type(values).__name__}; expected a tensor or an array [..., {count}]")
    given = values if hasattr(values, "new_tensor") else np.asarray(values)
    if given.shape[-1:] != (count,):
        raise MembraneError(f"{name}: {list(given.shape)}; expected [..., {count}]")
    if isinstance(given, np.ndarray):
        return given if given.dtype.kind == "f" else given.astype(float)
    return given if given.is_floating_point() else given.double()


def _like(values: Values, constant: np.ndarray) -> Values:
    """A constant of the kind and precision of the values."""
    return constant.astype(values.dtype) if isinstance(values, np.ndarray) else values.new_tensor(constant)


def _turned_by(vector: np.ndarray) -> np.ndarray:
    """The rotation about a vector `[3]` by its length, rad (Rodrigues): `1 + sin a / a K + (1 - cos a) / a^2 K^2`."""
    (x, y, z), angle = vector, np.linalg.norm(vector)
    K = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    turned: np.ndarray = np.eye(3) + np.sinc(angle / np.pi) * K + 0.5 * np.sinc(0.5 * angle / np.pi) ** 2 * K @ K
    return turned
