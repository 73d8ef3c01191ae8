"""Read lists of dots in various frames, and place the dots on the membrane in the camera's frame."""

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

FINE = (97, 97)  # grid of the surface on which dots are placed
RAYS = (("x", "y"), ("angle", "azimuth"), ("u", "v"))  # columns of dots that are placed along a ray
POINTS = (("x", "y", "z"), ("x", "y", "h"))
LIMITS = {"x": COORDINATE, "angle": ANGLE, "u": ANY}
"""Limits of the numbers, by the first column of the table."""
SIZE = "size"
DOTS = Columns((*POINTS, *RAYS), "dot", SIZE, least=FEWEST_MARKERS, most=MOST_DOTS)


def read_drafted_dots(path: Path, surface: Surface, camera: Camera) -> tuple[np.ndarray, list[str]]:
    """Read dots from a table whose header names the frame.

    `x,y,z`: positions in the camera's frame. `x,y,h`: h is the height above the rim's plane. `x,y`: seen from above; the dots
    are placed on the membrane. `angle,azimuth`: degrees from the pole and about the axis (from x to y), seen from the rim's
    centre. `u,v`: pixels in the rest image. An optional column `size` is "small" (default) or "large".

    Args:
        path: path of the CSV file.
        surface: the rest surface.
        camera: the camera, for `u,v`.

    Returns:
        Positions of the dots in the camera's frame, `[D, 3]`, and their sizes.

    Raises:
        MembraneError: the file cannot be read, its header is unknown, or a dot's ray misses the membrane; the message names the
            line.
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
            raise MembraneError(f"{row.where}: {','.join(row.cells)} misses the membrane; expected dots within its rim")
        positions = origin + distance[:, None] * direction
    return rounded(positions), sizes


def rim_z(surface: Surface) -> float:
    """Return the z of the rim's plane, or the mean z of a tilted or curved rim."""
    if isinstance(surface, InflatedSurface):
        return float(surface.rim[:, 2].mean())
    base_z: float = surface.values["base_z"]
    return base_z


def _refuse_heights(path: Path, surface: Surface, values: np.ndarray) -> None:
    """Raise an error if positions `[D, 3]` fit the membrane only when z is measured from the rim's plane."""
    membrane, base_z = surface.membrane(FINE), rim_z(surface)
    off, off_as_heights = (membrane.closest_points(points).distance.max() for points in (values, values + [0.0, 0.0, base_z]))
    if off_as_heights < OFF_SURFACE * membrane.size < off:
        raise MembraneError(
            f"{path}: z up to {values[:, 2].max():.4g} lies off the membrane, whose rim is {base_z:g} from the camera, but on "
            "it if counted from the rim's plane; expected the header x,y,h for such heights"
        )


def _rays(form: tuple[str, ...], values: np.ndarray, base_z: float, camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """Return origins and directions of the rays on which dots lie, `[D, 3]` each."""
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
