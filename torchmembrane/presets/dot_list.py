"""Dots as people list them, in any frame: on the membrane, in the camera's frame."""

import csv
import math
from pathlib import Path

import numpy as np
import torch

from ..camera.model import Camera
from ..errors import MembraneError
from ..files.safe_read import in_one_line, read_text, shortened
from ..markers.placement import FEWEST_MARKERS
from ..sensor.parts import OFF_SURFACE, Surface
from ..sensor.toml import MOST_DOTS, MOST_DOTS_BYTES

DIGITS = 6  # of positions, over their largest distance
FINE = (97, 97)  # vertices of the surface on which dots are put
RAYS = (["x", "y"], ["angle", "azimuth"], ["u", "v"])  # columns of dots that a ray puts on the surface
POINTS = (["x", "y", "z"], ["x", "y", "h"])


def read_drafted_dots(path: Path, surface: Surface, camera: Camera) -> tuple[np.ndarray, list[str]]:
    """Dots from a table whose header says in which frame they are.

    `x,y,z` camera frame; `x,y,h` h above the rim's plane; `x,y` from above, the height is the membrane's; `angle,azimuth`
    degrees from the pole and about the axis (from x to y), seen from the rim's centre; `u,v` px in the image at rest. A further
    column `size`: small or large (default: small).

    Args:
        path: of the CSV file.
        surface: the rest surface.
        camera: for `u,v`.

    Returns:
        Positions `[D, 3]` in the camera's frame, and sizes.

    Raises:
        MembraneError: the file cannot be read, has another header, or a dot whose ray misses the membrane: the line is named.
    """
    rows, form, values = _read_columns(path)
    sizes = [row[-1] for row in rows] if len(rows[0]) > len(form) else ["small"] * len(rows)
    for line, size in enumerate(sizes):
        if size not in ("small", "large"):
            raise MembraneError(f"{path}, line {line + 2}: size = {shortened(size)!r}; expected small or large")
    base_z = surface.values["base_z"]
    if form == ["x", "y", "z"]:
        _refuse_heights(path, surface, values)
        positions = values
    elif form == ["x", "y", "h"]:
        positions = values + [0.0, 0.0, base_z]
    else:
        origin, direction = _rays(form, values, base_z, camera)
        distance = surface.membrane(FINE).ray_points(origin, direction).distance
        for line in np.flatnonzero(~np.isfinite(distance)).tolist():
            raise MembraneError(
                f"{path}, line {line + 2}: {in_one_line(','.join(rows[line]))} misses the membrane; expected dots in its rim"
            )
        positions = origin + distance[:, None] * direction
    return positions.round(DIGITS - math.floor(math.log10(np.ptp(positions, 0).max()))), sizes


def _read_columns(path: Path) -> tuple[list[list[str]], list[str], np.ndarray]:
    """The table's rows below its header, the header without size, and its numbers `[D, columns]`."""
    forms = [",".join(form) for form in (*POINTS, *RAYS)]
    expected = f"CSV, its columns parted by commas, with the header {', '.join(forms)}, each with ,size or without"
    text = read_text(path, MOST_DOTS_BYTES, expected)
    try:
        header, *rows = [[cell.strip() for cell in row] for row in csv.reader(text.splitlines()) if row] or [[]]
    except csv.Error as error:
        raise MembraneError(f"{path}: not readable ({in_one_line(error)}); expected {expected}") from error
    form = header[: len(header) - (header[-1:] == ["size"])]
    if form not in (*POINTS, *RAYS):
        raise MembraneError(f"{path}: the header is {shortened(repr(','.join(header)))}; expected {expected}")
    if not FEWEST_MARKERS <= len(rows) <= MOST_DOTS:
        raise MembraneError(f"{path}: {len(rows)} dots; expected {FEWEST_MARKERS} to {MOST_DOTS}, one line for each")
    for line, row in enumerate(rows):
        if len(row) != len(header) or not all(_is_number(cell) for cell in row[: len(form)]):
            wanted = f"{len(form)} finite numbers, {','.join(form)}{', and the size' * (len(header) > len(form))}"
            raise MembraneError(f"{path}, line {line + 2}: {in_one_line(','.join(row))}; expected {wanted}")
    return rows, form, np.array([[float(cell) for cell in row[: len(form)]] for row in rows])


def _is_number(cell: str) -> bool:
    try:
        return math.isfinite(float(cell))
    except ValueError:
        return False


def _refuse_heights(path: Path, surface: Surface, values: np.ndarray) -> None:
    """Refuse positions `[D, 3]` that lie on the membrane if they are taken from the rim's plane."""
    membrane, base_z = surface.membrane(FINE), surface.values["base_z"]
    off, off_as_heights = (membrane.closest_points(points).distance.max() for points in (values, values + [0.0, 0.0, base_z]))
    if off_as_heights < OFF_SURFACE * membrane.size < off:
        raise MembraneError(
            f"{path}: z up to {values[:, 2].max():.4g} lies off the membrane, its rim {base_z:g} from the camera, but on it "
            "where it is counted from the rim's plane; expected the header x,y,h for such heights"
        )


def _rays(form: list[str], values: np.ndarray, base_z: float, camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """Rays on which dots lie, origins and directions `[D, 3]`."""
    a, b = values.T
    if form == ["u", "v"]:
        rays = camera.pixel_to_ray(torch.from_numpy(values))
        return rays.origin.numpy(), rays.direction.numpy()
    nothing = np.zeros_like(a)
    if form == ["x", "y"]:
        return np.stack([a, b, nothing + base_z], -1), np.stack([nothing, nothing, nothing + 1], -1)
    angle, azimuth = np.radians(a), np.radians(b)
    direction = np.stack([np.sin(angle) * np.cos(azimuth), np.sin(angle) * np.sin(azimuth), np.cos(angle)], -1)
    return np.stack([nothing, nothing, nothing + base_z], -1), direction
