"""A row of summary.csv: its columns, their meanings, and the cells computed from a frame's arrays.

torchmembrane and torchmembrane-edge both contain identical copies of this file.
"""

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

CONTACTS = 4
"""Number of contact patches that have columns of their own."""
AXES = "xyz"
METRE = {"mm": 1000.0, "cm": 100.0, "m": 1.0, "um": 1e6, "inch": 1 / 0.0254}
"""Length of one metre in each length unit."""
FORMULA = ("=", "+", "-", "@", "\t", "\r", "\n", "＝", "＋", "－", "＠")
"""First characters, after spaces, of a cell that a spreadsheet reads as a formula: such a text is prefixed with '."""


class Column(NamedTuple):
    """A column: its name, the unit of its numbers, and its meaning.

    Units are words, or `length`, `force`, `moment`, `area` or `pressure`, which `in_units` replaces by the sensor's units;
    "text" if the column holds no numbers.
    """

    name: str
    unit: str
    meaning: str


def _vector(name: str, unit: str, meaning: str) -> list[Column]:
    return [Column(f"{name}_{axis}", unit, f"{meaning}, along {axis} of the camera's frame") for axis in AXES]


def _contact(number: int) -> list[Column]:
    patch, name = f"contact patch {number}, strongest first", f"contact_{number}"
    return [
        *_vector(name, "length", f"{patch}: its centroid"),
        Column(f"{name}_force", "force", f"{patch}: magnitude of its force"),
        *_vector(f"{name}_force", "force", f"{patch}: its force"),
        Column(f"{name}_area", "area", f"{patch}: its area"),
    ]


COLUMNS = (
    Column("name", "text", "of the frame, as results bear it"),
    Column("file", "text", "the image, video or bag that it came from"),
    Column("status", "code", "0: ok; -1: the file could not be read; others as status_text says"),
    Column("status_text", "text", "the status in words"),
    Column(
        "time",
        "s",
        "when the frame was taken: since 1970 as its name (a date taken for UTC), bag or camera says; of a video without a "
        "time in its name since its beginning; empty where it is not known",
    ),
    Column("markers_found", "count", "markers found in the image"),
    Column("markers_total", "count", "markers of the sensor"),
    Column("coverage", "share", "area around the markers found, over the area around those seen at rest"),
    Column("residual_px", "px", "rms distance of measured from modelled markers"),
    Column("pressure", "pressure", "difference across the membrane"),
    Column("pressure_change", "pressure", "the same minus its rest value"),
    Column("pressure_hpa", "hPa", "difference across the membrane; empty where forces are relative"),
    Column("pressure_change_hpa", "hPa", "the same minus its rest value"),
    Column("force", "force", "magnitude of the total contact force on the membrane"),
    *_vector("force", "force", "total contact force on the membrane"),
    *_vector("force_deviation", "force", "standard deviation of the total contact force, the model's error included"),
    *_vector("moment", "moment", "moment of the total contact force about the camera's origin"),
    Column("contacts", "count", "contact patches found"),
    *(column for number in range(1, CONTACTS + 1) for column in _contact(number)),
    Column("deepest", "length", "lowest displacement along the outward rest normal: negative is an indentation"),
    *_vector("deepest", "length", "where that vertex is now"),
    Column("depth_deviation", "length", "standard deviation of the deepest displacement"),
    Column("volume_error", "share", "(volume - target) / rest volume of the cavity"),
    Column("seconds", "s", "computing time of the frame: its share of the time of its batch"),
    Column("content_hash", "text", "BLAKE2b, 16 bytes, of the file"),
    Column("length_unit", "text", "of all lengths here"),
    Column("force_unit", "text", "of all forces here: N, or relative where the sensor file has no modulus"),
    Column("gauge_pressure_hpa", "hPa", "what a gauge read, as a difference across the membrane; empty without a reading"),
    *(
        Column(
            f"contact_{number}_at_rim", "code", f"contact patch {number}: 1 where it reaches the rim, its force a lower bound"
        )
        for number in range(1, CONTACTS + 1)
    ),
)
NAMES = tuple(column.name for column in COLUMNS)
TEXT = tuple(column.name for column in COLUMNS if column.unit == "text")
"""Columns of text, which file names, damaged images, results and `mesh.npz` provide."""


def in_units(length_unit: str, force_unit: str) -> list[Column]:
    """Return the columns with the sensor's units.

    Example:
        >>> [column.unit for column in in_units("mm", "N") if column.name in ("deepest", "moment_x", "pressure", "time")]
        ['s', 'N/mm^2', 'N mm', 'mm']
    """
    length, force = length_unit, force_unit
    said = {"length": length, "force": force, "moment": f"{force} {length}", "area": f"{length}^2"}
    said["pressure"] = f"{force}/{length}^2"
    return [column._replace(unit=said.get(column.unit, column.unit)) for column in COLUMNS]


def numbers(frame: Mapping[str, Any], rest_normals: np.ndarray, length_unit: str, force_unit: str) -> dict[str, Any]:
    """Return the numbers of a row that are computed from a frame's arrays; unknown numbers are NaN.

    Args:
        frame: arrays with the names of `Reconstruction`, and `gauge`, a reading; missing arrays are unknown.
        rest_normals: normals of the rest surface, `[V, 3]`.
        length_unit: length unit of the results.
        force_unit: force unit of the results.
    """
    found: dict[str, Any] = {}

    def vector(name: str, values: np.ndarray) -> None:
        found.update({f"{name}_{axis}": value for axis, value in zip(AXES, values, strict=True)})

    def of(key: str, *shape: int) -> np.ndarray:
        return np.asarray(frame[key]) if key in frame else np.full(shape, np.nan)

    is_found = np.atleast_2d(of("confidence", 0) > 0)  # by any view
    found |= {"markers_found": is_found.any(0).sum(), "markers_total": is_found.shape[1]}
    found["residual_px"] = of("residual").max()
    found |= {key: of(key) for key in ("coverage", "pressure", "pressure_change", "depth_deviation", "volume_error")}
    hectopascals = METRE[length_unit] ** 2 / 100 if force_unit == "N" and length_unit in METRE else np.nan
    found |= {f"{key}_hpa": found[key] * hectopascals for key in ("pressure", "pressure_change")}
    found["gauge_pressure_hpa"] = of("gauge") * hectopascals
    force, wrench = of("force", 3), of("wrench", 6)
    found["force"] = np.linalg.norm(force)
    vector("force", force)
    vector("force_deviation", of("force_deviation", 3))
    vector("moment", wrench[3:])
    points = of("contact_points", 0, 3)
    found["contacts"] = np.isfinite(points).all(-1).sum()
    places, forces, areas = _rows(points, 3), _rows(of("contact_force", 0, 3), 3), _rows(of("contact_area", 0), 1)
    for number, (place, push, area) in enumerate(zip(places, forces, areas, strict=True), 1):
        vector(f"contact_{number}", place)
        vector(f"contact_{number}_force", push)
        found |= {f"contact_{number}_force": np.linalg.norm(push), f"contact_{number}_area": area[0]}
    at_rim = _rows(of("contact_at_rim", 0), 1)[:, 0]
    found |= {f"contact_{number}_at_rim": reaches for number, reaches in enumerate(at_rim, 1)}
    along = (of("displacement", len(rest_normals), 3) * rest_normals).sum(-1)
    is_known = along.size > 0 and np.isfinite(along).all()
    found["deepest"] = along.min() if is_known else np.nan
    vector("deepest", of("vertices", len(rest_normals), 3)[along.argmin()] if is_known else np.full(3, np.nan))
    return found


def _rows(values: np.ndarray, width: int) -> np.ndarray:
    """Return the first `CONTACTS` rows, `[CONTACTS, width]`, with NaN for missing ones."""
    rows = np.full((CONTACTS, width), np.nan)
    given = values.reshape(len(values), width)[:CONTACTS]
    rows[: len(given)] = given
    return rows


def cell(name: str, value: Any) -> str:
    """Format a number as a cell: six digits, times to the microsecond; empty if it is unknown.

    Example:
        >>> cell("force", 1.23456789), cell("time", 1790509109.25), cell("contacts", 2), cell("force", float("nan"))
        ('1.23457', '1790509109.250000', '2', '')
    """
    if not np.isfinite(value):
        return ""
    return f"{value:.6f}" if name == "time" else f"{value:.6g}"


def escaped(name: str, text: str) -> str:
    """Return the text of a cell as written: text that a spreadsheet would read as a formula is prefixed with '."""
    return f"'{text}" if name in TEXT and is_formula(text) else text


def unescaped(name: str, text: str) -> str:
    """Return the cell that was written as this text."""
    return text[1:] if name in TEXT and text.startswith("'") and is_formula(text) else text


def completed(row: Mapping[str, str]) -> dict[str, str] | None:
    """Return a row of a table in the format of this version, with columns added that earlier versions lack; None for a row of
    another table.

    Example:
        >>> row = completed(dict.fromkeys(NAMES[:-1], "1"))
        >>> row[NAMES[-1]], completed({"name": "a"})
        ('', None)
    """
    names = tuple(row)
    is_known = "force_unit" in names and names == NAMES[: len(names)]
    return {**dict.fromkeys(NAMES, ""), **row} if is_known else None


def is_formula(text: str) -> bool:
    """Return whether a spreadsheet would read a text as a formula."""
    return text.lstrip("' ").startswith(FORMULA)
