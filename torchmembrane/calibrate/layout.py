"""The fabrication layout: from the dot pattern wanted in the image, through the ports, to positions on the rest surface.

The paper's sensor was made in this way (section 5.2).
"""

from html import escape
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch

from ..errors import MembraneError, check_arguments, expect
from ..files.atomic import write_text
from ..files.csv_table import Columns, read_table
from ..files.digits import STORED, decimals
from ..markers.placement import rim_mask
from ..sensor.sensor import Sensor
from ..sensor.toml import MOST_DOTS, SIZES
from ..sensor.units import millimetre
from ..surface.membrane import Membrane
from ..surface.topology import rim_loop
from ..torch_modes import on_cpu
from .fit import outline_centres
from .surface import dot_outlines, fine_surface, surface_projection

RADIUS = {"small": 0.16, "large": 0.27}  # of dots, over their spacing
MARGIN = 0.6  # distance of a lattice from the rim's outline, over its pitch
NEWTON_STEPS, AIMS = 3, 2
BORDER, STROKE = 0.08, 0.006  # of a drawing, over the rim's extent: margin around the rim, and width of the rim's line
DRAWN = 5  # significant digits of the rim's extent in a drawing
MOST_BYTES = 2**20  # of a file of wanted pixels
PIXELS = Columns([("u", "v", "size")], "dot", unit="px", most=MOST_DOTS)


class FabricationLayout(NamedTuple):
    """Dots to be made on the rest surface.

    Attributes:
        positions: centres of the dots, `[D, 3]`, camera's frame, length unit.
        normals: outward unit normals at the centres, `[D, 3]`.
        radii: radii of the dots, `[D]`, length unit.
        sizes: size of each dot, "small" or "large".
        pixels: wanted positions in the image, `[D, 2]`, px.
    """

    positions: np.ndarray
    normals: np.ndarray
    radii: np.ndarray
    sizes: list[str]
    pixels: np.ndarray


@check_arguments
@on_cpu
def pixel_lattice(sensor: Sensor, pitch: float) -> tuple[np.ndarray, list[str]]:
    """Return a square lattice of alternating large and small dots in the image, centred at the principal point, within the rim.

    Args:
        sensor: the sensor with camera and rest surface.
        pitch: pitch of the lattice, px, at least 4.

    Returns:
        Pixels `[D, 2]`, and the size of each dot, "small" or "large".

    Raises:
        MembraneError: the pitch is too small, or the sensor's markers stand off the surface.

    Example:
        >>> pixels, sizes = pixel_lattice(Sensor.from_file("examples/sensor.toml"), 60.0)
        >>> pixels.shape, sizes[:3]
        ((32, 2), ['large', 'small', 'large'])
    """
    sensor.refuse_heights("calibrate layout")
    width, height = sensor.camera.image_size
    if not 4 <= pitch <= width + height:
        expected = f"4 px or more, so that dots are distinguishable, at most {width + height}"
        raise MembraneError(f"calibrate layout: pitch = {pitch}; expected {expected}")
    centre = sensor.camera.centre.numpy()
    reach = int(max(width, height) / pitch)
    i, j = (a.ravel() for a in np.mgrid[-reach : reach + 1, -reach : reach + 1])
    pixels = centre + pitch * np.stack([i, j], -1)
    mask = rim_mask(sensor, sensor.camera.point_to_pixel(sensor.membrane.rest))
    margin = MARGIN * pitch * np.array([[0, 0], [1, 0], [-1, 0], [0, 1], [0, -1]])
    around = np.rint(pixels[:, None] + margin).astype(int)
    inside = np.all((around >= 0) & (around < [width, height]), axis=-1)
    u, v = np.where(inside[..., None], around, 0).transpose(2, 0, 1)
    kept = (inside & mask[v, u]).all(1)
    if not kept.any():
        raise MembraneError(f"calibrate layout: pitch = {pitch}; expected a smaller one, so that dots lie within the rim")
    return pixels[kept], np.where((i + j) % 2 == 0, "large", "small")[kept].tolist()


@check_arguments
@on_cpu
def layout_for_pixels(sensor: Sensor, pixels: np.ndarray, sizes: list[str]) -> FabricationLayout:
    """Place dots on the rest surface such that the centroids of their outlines, seen through the ports, are at `pixels`.

    The image of a dot's centre differs from the centroid of its outline's image, so the ray is adjusted until the centroid is
    at the wanted pixel.

    Args:
        sensor: the sensor with camera, ports and rest surface.
        pixels: wanted positions of the dots in the image, `[D, 2]`, px.
        sizes: size of each dot, "small" or "large".

    Returns:
        The dots to be made.

    Raises:
        MembraneError: the ray of a pixel misses the surface (the message names the first one), there are more dots than a
            sensor may list, or the sensor's markers stand off the surface.

    Example:
        >>> sensor = Sensor.from_file("examples/sensor.toml")
        >>> layout = layout_for_pixels(sensor, np.array([[320.0, 240.0], [360.0, 240.0]]), ["large", "small"])
        >>> sensor.camera.point_to_pixel(torch.from_numpy(layout.positions)).numpy().round(0)
        array([[320., 240.],
               [360., 240.]])
    """
    sensor.refuse_heights("calibrate layout")
    wanted = aimed = np.asarray(pixels, float)
    right = wanted.ndim == 2 and wanted.shape[1] == 2
    expect(right, "calibrate layout: pixels", f"an array {list(wanted.shape)}", "[D, 2], u and v of each dot")
    if not 1 <= len(wanted) <= MOST_DOTS:
        raise MembraneError(f"calibrate layout: {len(wanted)} dots; expected at most {MOST_DOTS}, as a sensor file lists")
    right = len(sizes) == len(wanted) and set(sizes) <= set(RADIUS)
    expect(right, "calibrate layout: sizes", sizes, f"{len(wanted)} times {' or '.join(map(repr, RADIUS))}")
    surface = fine_surface(sensor)
    spacing = (float(surface.rest_area.sum()) / len(wanted)) ** 0.5
    radii = spacing * np.array([RADIUS[size] for size in sizes])
    for _ in range(AIMS):
        X, normals = _ray_hits(sensor, surface, aimed)
        outlines = sensor.camera.point_to_pixel(torch.from_numpy(dot_outlines(surface, X, radii)))
        aimed = aimed + (wanted - outline_centres(outlines).numpy())
    X, normals = _ray_hits(sensor, surface, aimed)
    return FabricationLayout(X, normals, radii, list(sizes), wanted)


def _ray_hits(sensor: Sensor, surface: Membrane, pixels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Intersect rays with the surface; return points and normals, `[D, 3]` each, refined by Newton's method on a finer mesh."""
    origin, direction = (ray.numpy() for ray in sensor.camera.pixel_to_ray(torch.from_numpy(pixels)))
    distance = surface.ray_points(np.nan_to_num(origin), np.nan_to_num(direction)).distance
    missed = ~(np.isfinite(distance) & np.isfinite(direction).all(1))
    if missed.any():
        d = int(np.flatnonzero(missed)[0])
        raise MembraneError(
            f"calibrate layout: the ray of pixel {pixels[d].tolist()} (dot {d}) misses the rest surface; expected pixels "
            "within the rim's outline: leave it out"
        )
    finer = sensor.surface.membrane(tuple(2 * side - 1 for side in surface.grid))
    X = origin + distance[:, None] * direction
    for _ in range(NEWTON_STEPS):
        near = surface_projection(finer, X)
        X = X - (near.signed_distance / (direction * near.normals).sum(1))[:, None] * direction
    return X, surface_projection(finer, X).normals


def read_pixels(path: Path) -> tuple[np.ndarray, list[str]]:
    """Read a wanted dot pattern from a CSV file with the header `u,v,size`.

    Args:
        path: path of the file.

    Returns:
        Pixels `[D, 2]` and sizes ("small" or "large"), the arguments of `layout_for_pixels`.

    Raises:
        MembraneError: the file is missing, or is not such a table.

    Example:
        >>> from tempfile import TemporaryDirectory
        >>> with TemporaryDirectory() as folder:
        ...     path = Path(folder) / "wanted.csv"
        ...     _ = path.write_text("u,v,size\\n320,240,large\\n360,240,small\\n")
        ...     pixels, sizes = read_pixels(path)
        >>> pixels.tolist(), sizes
        ([[320.0, 240.0], [360.0, 240.0]], ['large', 'small'])
    """
    rows = read_table(path, PIXELS, MOST_BYTES).rows
    return np.array([row.numbers("uv") for row in rows]), [row.choice("size", SIZES) for row in rows]


def write_layout(path: Path, sensor: Sensor, dots: FabricationLayout) -> None:
    """Write a CSV file for the machine that makes the dots, with columns `dot,x,y,z,nx,ny,nz,radius,size`.

    The origin is at the rim's centre; the axes are parallel to the camera's.

    Args:
        path: path of the file.
        sensor: the sensor on whose rest surface the dots lie.
        dots: the dots to write.

    Example:
        >>> from tempfile import TemporaryDirectory
        >>> sensor = Sensor.from_file("examples/sensor.toml")
        >>> x, n = sensor.membrane.rest[:1].numpy(), np.array([[0.0, 0.0, 1.0]])
        >>> dots = FabricationLayout(x, n, np.array([0.3]), ["large"], np.array([[320.0, 240.0]]))
        >>> with TemporaryDirectory() as folder:
        ...     path = Path(folder) / "layout.csv"
        ...     write_layout(path, sensor, dots)
        ...     path.read_text().splitlines()[0]
        'dot,x,y,z,nx,ny,nz,radius,size'
    """
    rim = sensor.membrane.rest[sensor.membrane.fixed].mean(0).numpy()
    lines, places = ["dot,x,y,z,nx,ny,nz,radius,size"], decimals(sensor.membrane.size, STORED)
    rows = zip(dots.positions - rim, dots.normals, dots.radii, dots.sizes, strict=True)
    for d, (x, n, radius, size) in enumerate(rows):
        lengths, normal = ([f"{value:.{count}f}" for value in values] for values, count in (((*x, radius), places), (n, 5)))
        lines.append(",".join([str(d), *lengths[:3], *normal, lengths[3], size]))
    write_text(path, "\n".join(lines) + "\n")


def write_svg(path: Path, sensor: Sensor, dots: FabricationLayout) -> None:
    """Write an SVG drawing of dots and rim, seen along the camera's axis, true to scale, in mm for any length unit."""
    one = millimetre(sensor.length_unit)
    rim = sensor.membrane.rest.numpy()[rim_loop(sensor.membrane.grid), :2] / one
    extent = float(np.ptp(rim, 0).max())
    low, size = rim.min(0) - BORDER * extent, np.ptp(rim, 0) + 2 * BORDER * extent
    places = decimals(extent, DRAWN)

    def shown(*lengths: float) -> str:
        return " ".join(f"{length:.{places}f}" for length in lengths)

    lines = [
        f'<svg xmlns="http://www.w3.org/2000/svg" width="{shown(size[0])}mm" height="{shown(size[1])}mm" '
        f'viewBox="{shown(*low, *size)}">',
        f"<title>{escape(sensor.name)}: {len(dots.radii)} dots on the rest surface, seen along the camera's axis</title>",
        f'<polygon points="{shown(*rim.ravel())}" fill="none" stroke="#0072B2" stroke-width="{shown(STROKE * extent)}"/>',
    ]
    for (x, y, _), normal, radius in zip(dots.positions / one, dots.normals, dots.radii / one, strict=True):
        short, angle = radius * abs(normal[2]), np.degrees(np.arctan2(normal[1], normal[0]))
        rotation = f"rotate({angle:.2f} {shown(x, y)})"
        lines.append(
            f'<ellipse cx="{shown(x)}" cy="{shown(y)}" rx="{shown(short)}" ry="{shown(radius)}" transform="{rotation}"/>'
        )
    write_text(path, "\n".join([*lines, "</svg>"]) + "\n")
