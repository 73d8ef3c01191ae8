"""Rest surfaces given by formulas: spherical cap, ellipsoid cap, half cylinder, height field.

The elliptical map `x = u sqrt(1 - v^2/2)`, `y = v sqrt(1 - u^2/2)` maps the border of a square grid to a circular rim and is
smooth inside. The radius is then used as the polar angle, so that the mesh does not coarsen towards steep sides.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from ..errors import MembraneError, check_arguments
from .checks import FARTHEST
from .membrane import Membrane

LEAST_LENGTH = 1e-6


def disc_grid(m: int, n: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the coordinates of a grid over the unit disc whose border is the unit circle.

    Args:
        m: number of vertices along x.
        n: number of vertices along y.

    Returns:
        `x` and `y`, `[m, n]` each.

    Example:
        >>> x, y = disc_grid(3, 3)
        >>> np.hypot(x, y).round(6).tolist()
        [[1.0, 1.0, 1.0], [1.0, 0.0, 1.0], [1.0, 1.0, 1.0]]
    """
    u, v = np.meshgrid(np.linspace(-1, 1, m), np.linspace(-1, 1, n), indexing="ij")
    return u * np.sqrt(1 - v**2 / 2), v * np.sqrt(1 - u**2 / 2)


@check_arguments
def spherical_cap(rim_radius: float, height: float, base_z: float, grid: tuple[int, int] = (17, 17)) -> Membrane:
    """Return a spherical cap over a circular rim, bulging away from the camera.

    Args:
        rim_radius: radius of the rim, length unit.
        height: height of the pole above the rim, length unit.
        base_z: z coordinate of the rim, length unit.
        grid: number of vertices along x and y.

    Returns:
        The `Membrane`.

    Raises:
        MembraneError: a length is not finite and positive, or the camera does not see the whole inner side of the surface.

    Example:
        >>> spherical_cap(rim_radius=12.0, height=9.0, base_z=15.0).rest[:, 2].max().item()
        24.0
    """
    _positive("spherical_cap", rim_radius=rim_radius, height=height)
    radius = (rim_radius**2 + height**2) / (2 * height)
    opening = float(np.arctan2(rim_radius, radius - height))
    return _dome(grid, (radius, radius, radius), opening, base_z)


@check_arguments
def ellipsoid_cap(semi_axes: Sequence[float], base_z: float, grid: tuple[int, int] = (17, 17)) -> Membrane:
    """Return the upper half of an ellipsoid over an elliptic rim, bulging away from the camera.

    Args:
        semi_axes: semi-axes `a, b, c` along x, y, z, length unit.
        base_z: z coordinate of the rim, length unit.
        grid: number of vertices along x and y.

    Returns:
        The `Membrane`.

    Raises:
        MembraneError: an axis is not finite and positive, or the camera does not see the whole inner side of the surface.

    Example:
        >>> ellipsoid_cap([10.0, 8.0, 12.0], base_z=3.0).rest[:, 2].max().round(decimals=9).item()
        15.0
    """
    a, b, c = semi_axes
    _positive("ellipsoid_cap", a=a, b=b, c=c)
    return _dome(grid, (a, b, c), np.pi / 2, base_z)


@check_arguments
def half_cylinder(radius: float, length: float, half_angle: float, base_z: float, grid: tuple[int, int] = (17, 17)) -> Membrane:
    """Return a part of a cylinder along x, bulging away from the camera.

    Args:
        radius: radius of the cylinder, length unit.
        length: length along x, length unit.
        half_angle: angle from the top line to either long edge, degrees, at most 90.
        base_z: z coordinate of the long edges, length unit.
        grid: number of vertices along x and around the cylinder.

    Returns:
        The `Membrane`.

    Raises:
        MembraneError: a value is not finite and positive, the angle is too large, or the camera does not see the whole inner
            side of the surface.

    Example:
        >>> half_cylinder(radius=10.0, length=36.0, half_angle=90.0, base_z=24.0).rest[:, 2].max().item()
        34.0
    """
    _positive("half_cylinder", radius=radius, length=length, half_angle=half_angle)
    if half_angle > 90:
        raise MembraneError(f"half_cylinder: half_angle = {half_angle}; expected at most 90 degrees")
    x = np.linspace(-length / 2, length / 2, grid[0])
    angle = np.deg2rad(np.linspace(-half_angle, half_angle, grid[1]))
    x, angle = np.meshgrid(x, angle, indexing="ij")
    z = base_z + radius * (np.cos(angle) - np.cos(np.deg2rad(half_angle)))
    return Membrane(np.stack([x, radius * np.sin(angle), z], -1))


@check_arguments
def heightfield(x: ArrayLike, y: ArrayLike, z: ArrayLike) -> Membrane:
    """Return a surface given by its z coordinates over a rectangle, whose border is the rim.

    Args:
        x: increasing coordinates `[m]`, length unit.
        y: increasing coordinates `[n]`, length unit.
        z: z coordinates `[m, n]`, length unit.

    Returns:
        The `Membrane`.

    Raises:
        MembraneError: the shapes do not match, or the coordinates do not increase.

    Example:
        >>> heightfield([0, 1, 2], [0, 1, 2, 3], np.full((3, 4), 5.0)).grid
        (3, 4)
    """
    x, y, z = (np.asarray(a, dtype=float) for a in (x, y, z))
    if x.ndim != 1 or y.ndim != 1 or z.shape != (len(x), len(y)):
        raise MembraneError(
            f"heightfield: x {list(x.shape)}, y {list(y.shape)}, z {list(z.shape)}; expected x [m], y [n], z [m, n]"
        )
    if not ((np.diff(x) > 0).all() and (np.diff(y) > 0).all()):
        raise MembraneError("heightfield: x or y does not increase; expected strictly increasing coordinates")
    gx, gy = np.meshgrid(x, y, indexing="ij")
    return Membrane(np.stack([gx, gy, z], -1))


def _dome(grid: tuple[int, int], semi_axes: tuple[float, float, float], opening: float, base_z: float) -> Membrane:
    x, y = disc_grid(*grid)
    a, b, c = semi_axes
    angle = np.hypot(x, y) * opening
    scale = opening * np.sinc(angle / np.pi)
    return Membrane(np.stack([a * scale * x, b * scale * y, base_z + c * (np.cos(angle) - np.cos(opening))], -1))


def _positive(function: str, **values: float) -> None:
    for name, value in values.items():
        if not LEAST_LENGTH <= value <= FARTHEST:
            limits = f"from {LEAST_LENGTH:g} to {FARTHEST:g}"
            raise MembraneError(f"{function}: {name} = {value}; expected a finite positive number, {limits}")
