"""Read and write `sensor.toml` and the files of arrays that it names."""

import io
import math
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ..camera.model import Camera
from ..errors import MembraneError
from ..files.atomic import make_folder, write_bytes, write_text
from ..files.csv_table import Columns, Limit, Row, read_table
from ..files.images import image_size, mean_image, write_image
from ..files.safe_read import read_arrays
from ..pose import Pose
from ..surface.checks import FARTHEST
from ..surface.membrane import Membrane
from .camera_tables import camera_table, read_cameras, refuse_folded, view_tables, with_rest_images, write_cameras
from .inflated import SHAPE as INFLATED
from .inflated import read_inflated, rim_lines
from .marker_checks import refuse_coincident, refuse_off_surface, refuse_tall
from .parts import (
    FRICTION,
    SHAPES_BY_ARRAYS,
    SHAPES_BY_NUMBERS,
    Cavity,
    Markers,
    Material,
    Surface,
    refuse_other_size,
)
from .record import Record, read_record
from .table import Table, toml_lines
from .units import METRE
from .views import View
from .working_range import GENERAL, WorkingRange, range_file

FORMAT = 1
COARSEST, FINEST = 25, 33  # default solver grids, vertices per side
FEWEST_LINES, MOST_LINES = 5, 65  # of a solver grid, per side; with more lines a frame takes more than 2 GB
MOST_VERTICES = 2**18
"""Largest number of vertices of a rest surface that is stored in a file of arrays."""
MOST_DOTS, MOST_DOTS_BYTES = 2000, 2**20
SIZES = ("small", "large")
DOTS_HEADER = ("x", "y", "z", "size")
HEIGHT, UPWARDS = "height", "0 or more, along the inward normal"
COORDINATE = Limit(FARTHEST, "a coordinate", "the length unit")
DOTS = Columns([DOTS_HEADER], "dot", HEIGHT, most=MOST_DOTS)


class SensorParts(NamedTuple):
    """All parts of a sensor, as read from its file and written to it.

    Attributes:
        name: any text.
        length_unit: one of `METRE`.
        camera: the `Camera`.
        membrane: the rest surface on the solver grid.
        material: the `Material`.
        cavity: the `Cavity`.
        markers: the `Markers`.
        surface: the rest surface as the file describes it.
        tool: the camera's pose in the tool's frame, if it is known.
        record: serial number and calibration.
        range: the validated working range.
        views: all views if there are several, else empty.
    """

    name: str
    length_unit: str
    camera: Camera
    membrane: Membrane
    material: Material
    cavity: Cavity
    markers: Markers
    surface: Surface
    tool: Pose | None = None
    record: Record = Record()
    range: WorkingRange = GENERAL
    views: tuple[View, ...] = ()


def read_sensor(path: Path, undotted: bool = False) -> SensorParts:
    """Read the parts of the sensor that a `sensor.toml` describes; `Sensor.from_file` makes a sensor of them.

    Args:
        path: path of the `.toml` file; paths in it are relative to its folder.
        undotted: whether the file may be a design without dots; one dot in the middle of the surface is then a placeholder.

    Returns:
        The `SensorParts`.

    Raises:
        MembraneError: a file is missing or invalid; the message names the file, the key or line, the value found, the value
            expected and the remedy.

    Example:
        >>> parts = read_sensor(Path("examples/sensor.toml"))
        >>> parts.material.model, parts.membrane.grid
        ('neo_hookean', (33, 33))
    """
    file = Table.from_file(path)
    file.allow(("format", "name", "length_unit", "camera", "membrane", "material", "cavity", "markers", "tool", "record"))
    if file.number("format") != FORMAT:
        raise file.refuse("format", f"{FORMAT}, the one this version reads: update torchmembrane or the file")
    name, length_unit = file.text("name"), file.text("length_unit", METRE)
    camera, views = read_cameras(file)
    material = _read_material(file.table("material"))
    cavity = _read_cavity(file.table("cavity"))
    dotted = not undotted or "file" in file.table("markers") or "rest_image" in file.table("markers")
    markers, lines = _read_markers(file.table("markers"), camera) if dotted else (_dots_to_come(file.table("markers")), [])
    views, markers = with_rest_images(file, views, markers) if views else (views, markers)
    surface, membrane = _read_membrane(file.table("membrane"), markers, material, length_unit)
    if not dotted:
        middle = len(membrane.rest) // 2
        markers = replace(markers, positions=membrane.rest[middle : middle + 1].numpy())
    elif markers.positions is not None:
        names = [f"{line}: the dot" for line in lines]
        refuse_off_surface(membrane, markers.positions, names)
        refuse_coincident(membrane, markers.positions, names)
    with file.table("markers").naming(HEIGHT):
        refuse_tall(membrane, markers)
    refuse_folded(file, camera, views, membrane)
    tool = _read_tool(file.table("tool")) if "tool" in file else None
    record = read_record(file.table("record")) if "record" in file else Record()
    kept = range_file(path)
    range = WorkingRange.from_file(kept) if kept.exists() else GENERAL
    given = name, length_unit, camera, membrane, material, cavity, markers, surface, tool, record, range
    return SensorParts(*given, tuple(views))


def write_sensor(parts: SensorParts, path: Path) -> Path:
    """Write a sensor's file, and its arrays beside it; `Sensor.to_file` calls this function.

    Args:
        parts: the parts of the sensor.
        path: path of the `.toml` file; the other files are named after it.

    Returns:
        The path of the `.toml` file.
    """
    make_folder(path.parent)
    tables, surface, markers = tables_of(parts), parts.surface, parts.markers
    cameras, shared = write_cameras(path, parts.camera, parts.views)
    if surface.shape in SHAPES_BY_ARRAYS:
        tables["membrane"]["file"] = f"{path.stem}_{surface.shape}.npz"
        content = io.BytesIO()
        np.savez_compressed(content, **surface.values)
        write_bytes(path.with_name(tables["membrane"]["file"]), content.getbuffer())
    if surface.shape == INFLATED and "outline" in surface.arrays():
        tables["membrane"]["outline"] = f"{path.stem}_rim.csv"
        write_text(path.with_name(tables["membrane"]["outline"]), rim_lines(surface.values["outline"]))
    if markers.positions is not None:
        tables["markers"]["file"] = f"{path.stem}_dots.csv"
        _write_dots(path.with_name(tables["markers"]["file"]), markers)
    rest_image = shared if parts.views else markers.rest_image
    if rest_image is not None:
        tables["markers"]["rest_image"] = write_image(path.with_name(f"{path.stem}_rest"), rest_image, parts.camera.bits).name
    blocks = {name: cameras if name == "camera" else toml_lines(name, table) for name, table in tables.items()}
    blocks |= {"record": toml_lines("record", parts.record.known)} if parts.record.known else {}
    write_text(path, "\n\n".join("\n".join(lines) for lines in blocks.values()) + "\n")
    return path


def tables_of(parts: SensorParts) -> dict[str, Any]:
    """Return the tables of a sensor's file, without its arrays; a cropped or binned camera is given as in that mode."""
    camera, material, cavity, markers = parts.camera, parts.material, parts.cavity, parts.markers
    tables: dict[str, Any] = {
        "": {"format": FORMAT, "name": parts.name, "length_unit": parts.length_unit},
        "camera": view_tables(parts.views) if parts.views else camera_table(camera),
        "membrane": {"shape": parts.surface.shape, "grid": list(parts.membrane.grid), **parts.surface.numbers()},
        "material": {key: value for key, value in asdict(material).items() if (key, value) != ("friction", FRICTION)},
        "cavity": asdict(cavity),
        "markers": {"kind": markers.kind, "polarity": markers.polarity},
    }
    if isinstance(markers.height, float) and markers.stand_off:
        tables["markers"][HEIGHT] = markers.height
    tool = parts.tool
    return tables if tool is None else tables | {"tool": {key: value.tolist() for key, value in vars(tool).items()}}


def default_grid(markers: Markers) -> tuple[int, int]:
    """Return the default solver grid, 25 or 33 lines per side: about 2.8 times as fine as the listed dots; 25 for texture.

    29 lines are not offered: their coarsest multigrid level has 8 lines and converges less reliably for deep presses than the
    7 of 25 lines or the 9 of 33.

    Args:
        markers: listed dots, dots that are still to be found in the rest image (33 lines), or texture.

    Returns:
        Number of vertices in each direction.

    Example:
        >>> default_grid(Markers("dots", positions=np.zeros((100, 3))))
        (33, 33)
    """
    if markers.kind == "texture":
        return COARSEST, COARSEST
    if markers.positions is None:
        return FINEST, FINEST
    n = COARSEST if 2.8 * math.sqrt(len(markers.positions)) < COARSEST + 2 else FINEST
    return n, n


def _read_tool(table: Table) -> Pose:
    table.allow(("rotation", "translation"))
    rotation, translation = table.rotation("rotation"), table.numbers("translation", 3)
    with table.naming():
        return Pose(np.array(rotation, float), np.array(translation))


def _read_material(table: Table) -> Material:
    table.allow(("model", "prestretch", *(optional := ("c2_ratio", "shear_modulus", "thickness", "friction"))))
    numbers = {key: table.number(key) for key in optional if key in table}
    model, prestretch = table.text("model"), table.number("prestretch")
    with table.naming():
        return Material(model, prestretch, **numbers)


def _read_cavity(table: Table) -> Cavity:
    table.allow(("filling", "pressure", "volume"))
    filling = table.text("filling")
    numbers = {key: table.number(key) for key in ("pressure", "volume") if key in table}
    with table.naming():
        return Cavity(filling, **numbers)


def _read_markers(table: Table, camera: Camera) -> tuple[Markers, list[str]]:
    """Return the markers, and for each listed dot the file and line that defines it."""
    table.allow(("kind", "file", "rest_image", "polarity", HEIGHT))
    kind = table.text("kind", ("dots", "texture"))
    polarity = table.text("polarity", ("dark", "light")) if kind == "dots" or "polarity" in table else "dark"
    dots, images = table.file("file") if "file" in table else None, table.files("rest_image") if "rest_image" in table else []
    if dots and kind == "texture":
        raise table.refuse("file", "none for texture, whose patches are chosen in the rest image: remove it")
    height = table.number(HEIGHT) if HEIGHT in table else 0.0
    if height < 0:
        raise table.refuse(HEIGHT, UPWARDS)
    if height and kind == "texture":
        raise table.refuse(HEIGHT, "no height for texture, which lies on the surface: remove it")
    positions, sizes, lines, heights = _read_dots(dots) if dots else (None, None, [], None)
    if heights is not None and HEIGHT in table:
        raise table.refuse(HEIGHT, f"none, as {dots} has a column of that name: remove one of them")
    with table.naming("rest_image"):
        for path in images[:1]:  # `mean_image` refuses images of another size
            refuse_other_size(image_size(path), camera)
        image = mean_image(images, camera.bits) if images else None
        return Markers(kind, polarity, positions, sizes, image, height if heights is None else heights), lines


def _dots_to_come(table: Table) -> Markers:
    table.allow(("kind", "polarity"))
    return Markers(table.text("kind", ("dots",)), table.text("polarity", ("dark", "light")), np.zeros((1, 3)))


def _read_dots(path: Path) -> tuple[np.ndarray, list[str], list[str], np.ndarray | None]:
    """Return positions `[D, 3]`, sizes, the file and line of each dot, and heights `[D]` if the table has that column."""
    rows = read_table(path, DOTS, MOST_DOTS_BYTES).rows
    positions = np.array([row.numbers("xyz", COORDINATE) for row in rows])
    heights = np.array([_read_height(row) for row in rows]) if HEIGHT in rows[0].places else None
    return positions, [row.choice("size", SIZES) for row in rows], [row.where for row in rows], heights


def _read_height(row: Row) -> float:
    height = row.number(HEIGHT, COORDINATE)
    if height < 0:
        raise row.refusal(HEIGHT, UPWARDS)
    return height


def _write_dots(path: Path, markers: Markers) -> None:
    assert markers.positions is not None and markers.sizes is not None  # `write_sensor` calls this only for listed dots
    rows = [[*map(repr, position), size] for position, size in zip(markers.positions.tolist(), markers.sizes, strict=True)]
    header: tuple[str, ...] = DOTS_HEADER
    if not isinstance(markers.height, float):
        header = (*DOTS_HEADER, HEIGHT)
        rows = [[*row, repr(height)] for row, height in zip(rows, markers.height.tolist(), strict=True)]
    write_text(path, "\n".join(map(",".join, [header, *rows])) + "\n")


def _read_membrane(table: Table, markers: Markers, material: Material, length_unit: str) -> tuple[Surface, Membrane]:
    shape = table.text("shape", [*SHAPES_BY_ARRAYS, *SHAPES_BY_NUMBERS, INFLATED])
    arrays, numbers = SHAPES_BY_ARRAYS.get(shape), SHAPES_BY_NUMBERS.get(shape, ())
    if shape != INFLATED:
        table.allow(("shape", "grid", *(("file",) if arrays else numbers)), f"for shape {shape}")
    named = table.whole_numbers("grid", 2) if "grid" in table else None
    grid = (named[0], named[1]) if named else default_grid(markers)
    if min(grid) < FEWEST_LINES or max(grid) > MOST_LINES:
        expected = f"5 x 5 vertices or more, at most {MOST_LINES} x {MOST_LINES}; 17 x 17 serves about 150 dots"
        raise table.refuse("grid", expected)
    if arrays:
        path = table.file("file")
        surface = Surface(shape, _read_surface(path, arrays))
        with table.naming("file"):
            membrane = surface.membrane(grid)
            lines = surface.values["vertices" if shape == "grid" else "z"].shape[:2]
            return surface, membrane.resampled(grid) if lines == grid and not named else membrane  # evenly, unless asked for
    if shape == INFLATED:
        blown_up = read_inflated(table, material, length_unit)
        with table.naming():
            return blown_up, blown_up.membrane(grid)
    surface = Surface(shape, {key: table.numbers(key, 3) if key == "semi_axes" else table.number(key) for key in numbers})
    with table.naming():
        return surface, surface.membrane(grid)


def _read_surface(path: Path, names: tuple[str, ...]) -> dict[str, np.ndarray]:
    arrays = read_arrays(path, names)
    for name in set(names) - {"fixed"}:
        if not np.isfinite(arrays[name]).all():
            at = np.argwhere(~np.isfinite(arrays[name]))[0].tolist()
            raise MembraneError(f"{path}: {name}{at} is not finite; expected finite numbers everywhere")
        arrays[name] = arrays[name].astype(np.float64)
    lines = arrays["vertices" if "vertices" in arrays else "z"].shape[:2]
    if math.prod(lines) > MOST_VERTICES:
        raise MembraneError(
            f"{path}: {' x '.join(map(str, lines))} vertices; expected at most {MOST_VERTICES}: give a coarser grid"
        )
    return arrays
