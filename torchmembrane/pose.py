"""Poses that map points, vectors and wrenches from the camera's frame to a tool's, or from one view's frame to another's."""

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar, TypeVar

import numpy as np

from .errors import MembraneError, check_arguments, expect, is_array

if TYPE_CHECKING:
    from torch import Tensor

Values = TypeVar("Values", "Tensor", np.ndarray)

ORTHOGONAL = 1e-3  # largest entry of R^T R - 1: rotations are written with three decimals or more


@check_arguments
@dataclass(frozen=True, eq=False)
class Pose:
    """The pose of one frame in another, which maps from the first to the second: `p_other = rotation p + translation`.

    A sensor's `tool` is the pose of the camera's frame in the tool's frame. The columns of its rotation are the camera's axes x
    (right in the image), y (down) and z (out of the lens) in the tool's frame; its translation is the position of the centre of
    projection in that frame.

    Args:
        rotation: `[3, 3]` rows of an orthogonal matrix of determinant 1, or a rotation vector `[3]` in degrees, which is
            converted to the matrix.
        translation: `[3]`, length unit.

    Raises:
        MembraneError: `rotation` is not a rotation, or a value is not finite.

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
    may_reflect: ClassVar[bool] = False

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
        expect(bool(determinant > 0) or self.may_reflect, "rotation", rotation.tolist(), expected)
        known = translation.shape == (3,) and bool(np.isfinite(translation).all())
        expect(known, "translation", translation.tolist(), "three finite numbers, in the sensor's length unit")
        object.__setattr__(self, "rotation", rotation)
        object.__setattr__(self, "translation", translation)

    def points(self, points: Values) -> Values:
        """Map points to the other frame, `R p + t`.

        Args:
            points: `[..., 3]`, length unit, tensor or array.

        Returns:
            `[..., 3]`.
        """
        points = _checked("Pose.points", points, 3)
        moved: Values = self.vectors(points) + _like(points, self.translation)
        return moved

    def vectors(self, vectors: Values) -> Values:
        """Map forces, normals or displacements to the other frame, `R f`.

        Args:
            vectors: `[..., 3]`, tensor or array.

        Returns:
            `[..., 3]`.
        """
        vectors = _checked("Pose.vectors", vectors, 3)
        turned: Values = vectors @ _like(vectors, self.rotation.T)
        return turned

    def wrench(self, wrench: Values) -> Values:
        """Map a wrench to the other frame, with its moment about that frame's origin: `(R f, R m + t x R f)`.

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


@dataclass(frozen=True, eq=False)
class ViewPose(Pose):
    """The pose of a view's frame in the first view's frame; for a view through a mirror it is a reflection, of determinant -1.

    Args:
        rotation: `[3, 3]` rows of an orthogonal matrix, or a rotation vector `[3]`, degrees.
        translation: `[3]`, length unit.

    Example:
        >>> mirrored = ViewPose(np.diag([-1.0, 1.0, 1.0]), np.array([20.0, 0.0, 0.0]))  # by a mirror at x = 10
        >>> mirrored.points(np.array([2.0, 3.0, 30.0])).tolist()
        [18.0, 3.0, 30.0]
    """

    may_reflect: ClassVar[bool] = True

    @classmethod
    def of_matrix(cls, matrix: np.ndarray) -> "ViewPose":
        """Return the pose described by a matrix `[4, 4]` of homogeneous coordinates.

        Raises:
            MembraneError: the shape or the last row is wrong, or the rows are not orthogonal.
        """
        given = np.asarray(matrix, float)
        right = given.shape == (4, 4) and np.array_equal(given[3], [0, 0, 0, 1])
        expect(right, "pose", given.tolist(), "four rows of four numbers, the last one 0, 0, 0, 1")
        return cls(given[:3, :3], given[:3, 3])

    @property
    def matrix(self) -> np.ndarray:
        """Return the pose as a matrix `[4, 4]` of homogeneous coordinates."""
        rows: np.ndarray = np.vstack([np.column_stack([self.rotation, self.translation]), [0.0, 0.0, 0.0, 1.0]])
        return rows

    @property
    def determinant(self) -> int:
        """Return 1 for a rotation, -1 for a reflection."""
        return 1 if np.linalg.det(self.rotation) > 0 else -1

    @property
    def inverse(self) -> "ViewPose":
        """Return the pose of the first view's frame in this view's frame."""
        return ViewPose(self.rotation.T, -self.rotation.T @ self.translation)


def _checked(name: str, values: Any, count: int) -> Any:
    """Return `values [..., count]` as a floating-point tensor or array."""
    if not is_array(values):
        raise MembraneError(f"{name}: a {type(values).__name__}; expected a tensor or an array [..., {count}]")
    given = values if hasattr(values, "new_tensor") else np.asarray(values)
    if given.shape[-1:] != (count,):
        raise MembraneError(f"{name}: {list(given.shape)}; expected [..., {count}]")
    if isinstance(given, np.ndarray):
        return given if given.dtype.kind == "f" else given.astype(float)
    return given if given.is_floating_point() else given.double()


def _like(values: Values, constant: np.ndarray) -> Values:
    """Return a constant as a tensor or array, like `values` and of the same precision."""
    return constant.astype(values.dtype) if isinstance(values, np.ndarray) else values.new_tensor(constant)


def _turned_by(vector: np.ndarray) -> np.ndarray:
    """Return the rotation about a vector `[3]` by its length in rad (Rodrigues): `1 + sin a / a K + (1 - cos a) / a^2 K^2`."""
    (x, y, z), angle = vector, np.linalg.norm(vector)
    K = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    turned: np.ndarray = np.eye(3) + np.sinc(angle / np.pi) * K + 0.5 * np.sinc(0.5 * angle / np.pi) ** 2 * K @ K
    return turned
