"""Dots as users list them in various frames, placed on the membrane in the camera's frame."""

from pathlib import Path

import numpy as np
import torch

from ..camera.model import Camera
from ..errors import MembraneError
from ..files.csv_table import ANGLE, ANY, Columns, read_table
from ..files.digits import rounded
from ..markers.placement import FEWEST_MARKERS
from ..sensor.inflated import InflatedSurface
from ..sensor.marker_checks import OFF_SURFACE
from ..sensor.parts import Surface
from ..sensor.toml import COORDINATE, MOST_DOTS, MOST_DOTS_BYTES, SIZES

FINE = (97, 97)  # vertices of the surface on which dots are put
RAYS = (("x", "y"), ("angle", "azimuth"), ("u", "v"))  # columns of dots that a ray puts on the surface
POINTS = (("x", "y", "z"), ("x", "y", "h"))
LIMITS = {"x": COORDINATE, "angle": ANGLE, "u": ANY}
"""Limits of the numbers of a form, by its first column."""
SIZE = "size"
DOTS = Columns((*POINTS, *RAYS), "dot", SIZE, least=FEWEST_MARKERS, most=MOST_DOTS)


def read_drafted_dots(path: Path, surface: Surface, camera: Camera) -> tuple[np.ndarray, list[str]]:
    """Dots from a table whose header says in which frame they are.

    `x,y,z` camera frame; `x,y,h` h above the rim's plane; `x,y` from above, the height is the membrane's; `angle,azimuth`
    degrees from the pole and about the axis (from x to y), seen from the rim's centre; `u,v` px in the image at rest. A further
    column `size`: small or large (default: small).

    Args:
        path: path of the CSV file.
        surface: the rest surface.
        camera: for `u,v`.

    Returns:
        Positions `[D, 3]` in the camera's frame, and sizes.

    Raises:
        MembraneError: the file cannot be read, has another header, or a dot whose ray misses the membrane: the line is named.
    """
    form, rows = read_table(path, DOTS, MOST_DOTS_BYTES)
    values = np.array([row.numbers(form, LIMITS[form[0]]) for row in rows])
    sizes = [row.choice(SIZE, SIZES) if SIZE in row.places else SIZES[0] for row in rows]
    base_z = rim_z(surface)
    if form == ("x", "y", "z"):
        _refuse_heights(path, surface, values)
        positions = values
    elif form == ("x", "y", "h"):
        positions = values + [0.0, 0.0, base_z]
    else:
        origin, direction = _rays(form, values, base_z, camera)
        distance = surface.membrane(FINE).ray_points(origin, direction).distance
        for missed in np.flatnonzero(~np.isfinite(distance)).tolist():
            row = rows[missed]
            raise MembraneError(f"{row.where}: {','.join(row.cells)} misses the membrane; expected dots in its rim")
        positions = origin + distance[:, None] * direction
    return rounded(positions), sizes


def rim_z(surface: Surface) -> float:
    """The z of the rim's plane; of a tilted or bent rim that of its middle."""
    if isinstance(surface, InflatedSurface):
        return float(surface.rim[:, 2].mean())
    base_z: float = surface.values["base_z"]
    return base_z


def _refuse_heights(path: Path, surface: Surface, values: np.ndarray) -> None:
    """Refuse positions `[D, 3]` that lie on the membrane if they are taken from the rim's plane."""
    membrane, base_z = surface.membrane(FINE), rim_z(surface)
    off, off_as_heights = (membrane.closest_points(points).distance.max() for points in (values, values + [0.0, 0.0, base_z]))
    if off_as_heights < OFF_SURFACE * membrane.size < off:
        raise MembraneError(
            f"{path}: z up to {values[:, 2].max():.4g} lies off the membrane, whose rim is {base_z:g} from the camera, but on "
            "it if counted from the rim's plane; expected the header x,y,h for such heights"
        )


def _rays(form: tuple[str, ...], values: np.ndarray, base_z: float, camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """Rays on which dots lie, origins and directions `[D, 3]`."""
    a, b = values.T
    if form == ("u", "v"):
        rays = camera.pixel_to_ray(torch.from_numpy(values))
        return rays.origin.numpy(), rays.direction.numpy()
    nothing = np.zeros_like(a)
    if form == ("x", "y"):
        return np.stack([a, b, nothing + base_z], -1), np.stack([nothing, nothing, nothing + 1], -1)
    angle, azimuth = np.radians(a), np.radians(b)
    direction = np.stack([np.sin(angle) * np.cos(azimuth), np.sin(angle) * np.sin(azimuth), np.cos(angle)], -1)
    return np.stack([nothing, nothing, nothing + base_z], -1), direction
