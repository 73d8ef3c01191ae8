"""List the files of a sensor: its `.toml`, and the arrays, dots and images beside it."""

import glob
from pathlib import Path

from .parts import SHAPES_BY_ARRAYS
from .table import Table


def files_of(path: Path) -> list[Path]:
    """Return a sensor's file and the files that it names.

    Args:
        path: path of the `.toml` file.

    Raises:
        MembraneError: the file cannot be read as TOML.

    Example:
        >>> [file.name for file in files_of(Path("examples/sensor.toml"))]
        ['sensor.toml', 'rest_grid.npz', 'dots.csv', 'rest.png']
    """
    return [path, *Table.from_file(path).named_files()]


def companions_of(path: Path) -> list[Path]:
    """Return the sensor's file and all files that `write_sensor` may write beside it.

    Example:
        >>> [file.name for file in companions_of(Path("a.toml"))]
        ['a.toml', 'a_grid.npz', 'a_heightfield.npz', 'a_rim.csv', 'a_dots.csv', 'a_rest.png', 'a_rest.tiff']
    """
    endings = *(f"_{shape}.npz" for shape in SHAPES_BY_ARRAYS), "_rim.csv", "_dots.csv", "_rest.png", "_rest.tiff"
    of_views = sorted(path.parent.glob(f"{glob.escape(path.stem)}_rest_*"))
    return [path, *(path.with_name(path.stem + ending) for ending in endings), *of_views]
