"""Rest surfaces by formula: spherical cap, ellipsoid cap, half cylinder, height field.

Round rims are mapped to the border of a square grid by the elliptical map `x = u sqrt(1 - v^2/2)`, `y = v sqrt(1 - u^2/2)`,
smooth inside; then the radius is taken as an angle, so that the mesh does not coarsen towards steep sides.
"""

import numpy as np

from ..errors import MembraneError
from .membrane import Membrane


def disc_grid(m: int, n: int) -> tuple[np.ndarray, np.ndarray]:
    """Coordinates `x, y [m, n]` of a grid over the unit disc whose border is the unit circle."""
    u, v = np.meshgrid(np.linspace(-1, 1, m), np.linspace(-1, 1, n), indexing="ij")
    return u * np.sqrt(1 - v**2 / 2), v * np.sqrt(1 - u**2 / 2)


def spherical_cap(rim_radius: float, height: float, base_z: float, grid=(17, 17)) -> Membrane:
    """The cap of a sphere, `height` above its circular rim at `z = base_z`, bulging away from the camera."""
    _positive("spherical_cap", rim_radius=rim_radius, height=height)
    radius = (rim_radius**2 + height**2) / (2 * height)
    opening = np.arctan2(rim_radius, radius - height)
    return _dome(grid, (radius, radius, radius), opening, base_z)


def ellipsoid_cap(semi_axes, base_z: float, grid=(17, 17)) -> Membrane:
    """The upper half of an ellipsoid with semi-axes `(a, b, c)` along x, y, z and its elliptic rim at `z = base_z`."""
    a, b, c = semi_axes
    _positive("ellipsoid_cap", a=a, b=b, c=c)
    return _dome(grid, (a, b, c), np.pi / 2, base_z)


def half_cylinder(radius: float, length: float, half_angle: float, base_z: float, grid=(17, 17)) -> Membrane:
    """A cylinder along x bulging away from the camera, `half_angle` degrees to both sides, long edges at `base_z`."""
    _positive("half_cylinder", radius=radius, length=length, half_angle=half_angle)
    if half_angle > 90:
        raise MembraneError(f"half_cylinder: half_angle = {half_angle}; expected at most 90 degrees")
    x = np.linspace(-length / 2, length / 2, grid[0])
    angle = np.deg2rad(np.linspace(-half_angle, half_angle, grid[1]))
    x, angle = np.meshgrid(x, angle, indexing="ij")
    z = base_z + radius * (np.cos(angle) - np.cos(np.deg2rad(half_angle)))
    return Membrane(np.stack([x, radius * np.sin(angle), z], -1))


def heightfield(x, y, z) -> Membrane:
    """The surface `z [m, n]` over increasing `x [m]`, `y [n]`; its border is the rim."""
    x, y, z = (np.asarray(a, dtype=float) for a in (x, y, z))
    if x.ndim != 1 or y.ndim != 1 or z.shape != (len(x), len(y)):
        raise MembraneError(
            f"heightfield: x {list(x.shape)}, y {list(y.shape)}, z {list(z.shape)}; expected x [m], y [n], z [m, n]"
        )
    if not ((np.diff(x) > 0).all() and (np.diff(y) > 0).all()):
        raise MembraneError("heightfield: x or y does not increase; expected strictly increasing coordinates")
    gx, gy = np.meshgrid(x, y, indexing="ij")
    return Membrane(np.stack([gx, gy, z], -1))


def _dome(grid, semi_axes, opening, base_z) -> Membrane:
    x, y = disc_grid(*grid)
    a, b, c = semi_axes
    angle = np.hypot(x, y) * opening
    scale = opening * np.sinc(angle / np.pi)
    return Membrane(np.stack([a * scale * x, b * scale * y, base_z + c * (np.cos(angle) - np.cos(opening))], -1))


def _positive(function: str, **values) -> None:
    for name, value in values.items():
        if not (np.isfinite(value) and value > 0):
            raise MembraneError(f"{function}: {name} = {value}; expected a finite positive number")
