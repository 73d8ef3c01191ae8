"""The rest surface of shape "inflated": a sheet on a closed rim, inflated; computed from the values of the sensor's file."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ..errors import check_arguments, expect
from ..files.csv_table import Columns, Limit, read_table
from ..forming.formed import FormedSurface, SheetMaterial, formed_surface
from ..forming.outline import MOST_POINTS, ellipse, rectangle
from ..surface.checks import FARTHEST
from ..surface.membrane import Membrane
from .parts import Material, Surface
from .table import Table
from .units import hectopascal

SHAPE = "inflated"
FORMULAS = ("rectangle", "ellipse")
"""Outlines that numbers describe; any other outline is the name of a file."""
KEYS = ("outline", "size", "corner", "base_z", "height", "overpressure")
MOST_PRESSURE = 1e6  # hPa
MOST_RIM_BYTES = 2**20
RIM_TABLE = Columns([("x", "y"), ("x", "y", "z")], "point", unit="in order once around the rim", least=3, most=MOST_POINTS)
COORDINATE = Limit(FARTHEST, "a coordinate", "the length unit")


@check_arguments
@dataclass(frozen=True, eq=False)
class InflatedSurface(Surface):
    """A rest surface of shape "inflated": the equilibrium of a sheet that is stretched over a rim and inflated.

    Prestretch, shear modulus and thickness of the material describe the sheet stretched over its rim, before inflation.

    Args:
        shape: "inflated".
        values: the following values by key. `outline`: "rectangle", "ellipse", or points `[K, 2]` or `[K, 3]` once around the
            rim. `size` `[a, b]`, for rectangle and ellipse. `corner`: radius of the rectangle's corners. `base_z`: z of the
            rim, added to the z of points (default 0 for points). Either `height`, of the highest point above the rim's plane,
            or `overpressure`, hPa.
        material: material of the sheet.
        length_unit: unit of all lengths.

    Raises:
        MembraneError: a key is missing or unknown, or an overpressure is given without a modulus.

    Example:
        >>> rubber = Material("neo_hookean", prestretch=1.1, shear_modulus=0.4, thickness=0.3)
        >>> values = {"outline": "ellipse", "size": [50.0, 36.0], "base_z": 40.0, "height": 6.0}
        >>> window = InflatedSurface("inflated", values, rubber, "mm")
        >>> window.membrane((17, 17)).rest[:, 2].max().round(decimals=6).item()
        46.0
    """

    material: Material = None  # type: ignore[assignment]  # checked below
    length_unit: str = "mm"

    def __post_init__(self) -> None:
        v, by_formula = self.values, isinstance(self.values.get("outline"), str)
        expect(self.shape == SHAPE, "InflatedSurface: shape", self.shape, SHAPE)
        needed = {"outline", *(("size", "base_z") if by_formula else ())}
        has_corners = by_formula and v["outline"] == "rectangle"
        allowed = {*needed, "base_z", "height", "overpressure", *(("corner",) if has_corners else ())}
        right = needed <= set(v) <= allowed and ("height" in v) != ("overpressure" in v)
        expected = f"{', '.join(sorted(needed))} and either height or overpressure; allowed: {', '.join(sorted(allowed))}"
        expect(right, "values of an inflated surface", list(v), expected)
        if by_formula:
            expect(v["outline"] in FORMULAS, "outline", v["outline"], f"{' or '.join(FORMULAS)}, or points of the rim")
        if "overpressure" in v:
            expect(0 < v["overpressure"] <= MOST_PRESSURE, "overpressure", v["overpressure"], "a positive number, hPa")
            known = self.material.shear_modulus is not None and self.material.thickness is not None
            remedy = "shear_modulus and thickness in [material], or height in place of overpressure"
            expect(known, "an overpressure without a modulus; shear_modulus, thickness", None, remedy)

    @property
    def rim(self) -> np.ndarray:
        """Points once around the rim, `[K, 3]`, camera's frame."""
        v = self.values
        if not isinstance(v["outline"], str):
            points = np.asarray(v["outline"], float)
            of_points: np.ndarray = points if points.shape[1] == 3 else np.insert(points, 2, 0.0, axis=1)
            of_points = of_points + [0.0, 0.0, v.get("base_z", 0.0)]
            return of_points
        flat: np.ndarray = ellipse(v["size"]) if v["outline"] == "ellipse" else rectangle(v["size"], v.get("corner", 0.0))
        raised: np.ndarray = np.insert(flat, 2, v["base_z"], axis=1)
        return raised

    @property
    def formed(self) -> FormedSurface:
        """The equilibrium shape; `formed_surface` caches its solution."""
        m, v = self.material, self.values
        sheet = SheetMaterial(m.model, float(m.prestretch), float(m.c2_ratio or 0.0))
        if "height" in v:
            return formed_surface(self.rim, sheet, height=float(v["height"]))
        return formed_surface(self.rim, sheet, pressure=v["overpressure"] * hectopascal(self.length_unit) / m.modulus)

    def membrane(self, grid: tuple[int, int]) -> Membrane:
        """Return the rest surface on a solver grid; see `Surface.membrane`."""
        return Membrane(self.formed.resampled_to(grid)[0])

    def sheet(self, grid: tuple[int, int]) -> Tensor:
        """Return the positions of a solver grid's vertices on the sheet before inflation, `[V, 3]`."""
        return torch.from_numpy(self.formed.resampled_to(grid)[1].reshape(-1, 3).copy())

    def of_height(self, height: float) -> "InflatedSurface":
        """Return the same sheet and rim, inflated to another height."""
        values = {key: value for key, value in self.values.items() if key != "overpressure"} | {"height": height}
        return replace(self, values=values)

    def made_of(self, material: Material, length_unit: str) -> "InflatedSurface":
        """Return the surface of the same rim and height (or overpressure) with a sheet of another material."""
        if (material, length_unit) == (self.material, self.length_unit):
            return self
        return replace(self, material=material, length_unit=length_unit)


def read_inflated(table: Table, material: Material, length_unit: str) -> InflatedSurface:
    """Read an inflated surface from `[membrane]` of a sensor's file.

    Args:
        table: the table `[membrane]`.
        material: the material read from `[material]`.
        length_unit: unit of lengths in the file.

    Raises:
        MembraneError: a value is invalid; the message names file, key, value, what was expected and the remedy.
    """
    table.allow(("shape", "grid", *KEYS), f"for shape {SHAPE}")
    outline = table.text("outline")
    values: dict[str, Any] = {"outline": outline}
    if outline in FORMULAS:
        values["size"] = table.numbers("size", 2)
    else:
        values["outline"] = read_rim(table.file("outline"))
    values |= {key: table.number(key) for key in KEYS[2:] if key in table}
    with table.naming():
        surface = InflatedSurface(SHAPE, values, material, length_unit)
        surface.formed  # noqa: B018  # solved here, so that an error names the table
    return surface


def read_rim(path: Path) -> np.ndarray:
    """Read points once around a rim, `[K, 2]` or `[K, 3]`, from a CSV table with columns `x,y` or `x,y,z`.

    Raises:
        MembraneError: the table has other columns, or a value is not a number.
    """
    form, rows = read_table(path, RIM_TABLE, MOST_RIM_BYTES)
    return np.array([row.numbers(form, COORDINATE) for row in rows])


def rim_lines(outline: np.ndarray) -> str:
    """Format points of a rim as the CSV table that `read_rim` reads."""
    head = ",".join("xyz"[: outline.shape[1]])
    return "\n".join([head, *(",".join(map(repr, row)) for row in np.asarray(outline, float).tolist())]) + "\n"
