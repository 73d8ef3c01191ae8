"""Draft of an inflated sheet from measurements: rim, height, overpressure, prestretch and stiffness are interdependent."""

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from scipy.interpolate import LinearNDInterpolator
from scipy.optimize import brentq

from ..errors import MembraneError
from ..files.digits import rounded
from ..forming.formed import FormedSurface, SheetMaterial, formed_surface
from ..forming.outline import encloses
from ..sensor.inflated import SHAPE, InflatedSurface
from ..sensor.parts import Material
from ..sensor.units import hectopascal

ASSUMED_PRESTRETCH = 1.1
ASSUMED = f"prestretch {ASSUMED_PRESTRETCH:g} of the sheet in its rim is assumed; --prestretch states it"
DISAGREEMENT = 0.1  # relative difference between stated and computed overpressure above which it is reported
LARGEST_STRETCH = 3.0
MARGIN = 0.4  # smallest distance between a dot and the rim, over the pitch


class BlownUp(NamedTuple):
    """A drafted sheet: its surface, its material, its overpressure at rest (hPa; None if unknown), and sentences on assumed,
    derived or contradictory values."""

    surface: InflatedSurface
    material: Material
    overpressure: float | None
    said: list[str]


class Stated(NamedTuple):
    """The known values of a sheet, None if unknown: height, overpressure (hPa), and for the sheet stretched in its rim
    prestretch, shear modulus (N per length unit squared) and thickness."""

    height: float | None = None
    overpressure: float | None = None
    prestretch: float | None = None
    shear_modulus: float | None = None
    thickness: float | None = None


def blown_up(rim: Mapping[str, Any], unit: str, stated: Stated) -> BlownUp:
    """Complete the known values of a neo-Hookean sheet.

    Any three of height, overpressure, prestretch and shear modulus x thickness determine the fourth. If both overpressure and
    modulus are unknown, forces are relative. If all four are given, they are compared.

    Args:
        rim: `outline`, `size`, `corner` and `base_z` as in `InflatedSurface`.
        unit: unit of length.
        stated: the known values.

    Returns:
        The sheet, and sentences on its values.

    Raises:
        MembraneError: neither height nor overpressure is given, an overpressure is given without height and modulus, or there
            is no equilibrium.

    Example:
        >>> rim = {"outline": "ellipse", "size": [50.0, 36.0], "base_z": 40.0}
        >>> found = blown_up(rim, "mm", Stated(height=6.0, overpressure=12.0, prestretch=1.1, thickness=0.2))
        >>> round(found.material.shear_modulus, 2), found.said[0]
        (0.16, 'shear modulus 0.1628 N/mm^2 from the overpressure, 12 hPa, and the height')
    """
    height, overpressure, prestretch, shear_modulus, thickness = stated
    if height is None and overpressure is None:
        raise MembraneError("init: neither --height nor --overpressure is given; an inflated sheet needs one of them, or both")
    if height is None:
        return _by_pressure(rim, unit, stated)
    one, said = hectopascal(unit), []
    points = _surface(rim, unit, {"height": height}, Material("neo_hookean", 1.0)).rim

    def held(stretch: float) -> float:
        """Return the equilibrium pressure over shear modulus x thickness."""
        return formed_surface(points, SheetMaterial("neo_hookean", stretch), height=height).pressure

    modulus = None if shear_modulus is None or thickness is None else shear_modulus * thickness
    if overpressure is not None and modulus is not None:
        if prestretch is None:
            prestretch, sentence = _stretch_by_pressure(held, overpressure * one / modulus, overpressure)
            said.append(sentence)
        else:
            said += _contradiction(held(prestretch) * modulus / one, stated)
    elif prestretch is None:
        prestretch = ASSUMED_PRESTRETCH
        said.append(ASSUMED)
    if overpressure is not None and modulus is None:
        product = overpressure * one / held(prestretch)
        thickness, shear_modulus, sentence = _split(product, thickness, shear_modulus, unit)
        said.append(f"{sentence} from the overpressure, {overpressure:g} hPa, and the height")
    material = Material("neo_hookean", round(prestretch, 6), None, shear_modulus, thickness)
    if overpressure is None and modulus is not None:
        overpressure = held(prestretch) * modulus / one
        said.append(f"overpressure {overpressure:.4g} hPa from the height and the material")
    surface = _surface(rim, unit, {"height": height}, material)
    return BlownUp(surface, material, overpressure, [*said, *_in_words(surface.formed, unit)])


def _by_pressure(rim: Mapping[str, Any], unit: str, stated: Stated) -> BlownUp:
    if stated.shear_modulus is None or stated.thickness is None:
        raise MembraneError(
            f"init: an overpressure of {stated.overpressure:g} hPa without --height; expected --shear-modulus and --thickness, "
            "from which the height follows, or --height, from which their product follows"
        )
    prestretch, said = stated.prestretch, []
    if prestretch is None:
        prestretch = ASSUMED_PRESTRETCH
        said.append(ASSUMED)
    material = Material("neo_hookean", prestretch, None, stated.shear_modulus, stated.thickness)
    surface = _surface(rim, unit, {"overpressure": stated.overpressure}, material)
    said.append(f"height {surface.formed.height:.4g} {unit} from the overpressure, {stated.overpressure:g} hPa")
    return BlownUp(surface, material, stated.overpressure, [*said, *_in_words(surface.formed, unit)])


def _surface(rim: Mapping[str, Any], unit: str, goal: Mapping[str, Any], material: Material) -> InflatedSurface:
    return InflatedSurface(SHAPE, {**rim, **goal}, material, unit)


def _stretch_by_pressure(held: Any, wanted: float, stated: float) -> tuple[float, str]:
    low, high = held(1.0), held(LARGEST_STRETCH)
    if not low < wanted < high:
        raise MembraneError(
            f"init: overpressure {stated:g} hPa; at this height a sheet of this modulus and thickness holds "
            f"{low / wanted * stated:.4g} hPa with prestretch 1 and {high / wanted * stated:.4g} hPa with {LARGEST_STRETCH:g}: "
            "the numbers contradict one another; leave out --shear-modulus or --thickness, whichever is known worse: it follows"
        )
    prestretch = float(brentq(lambda stretch: held(stretch) - wanted, 1.0, LARGEST_STRETCH, rtol=1e-6))
    return (
        prestretch,
        f"prestretch {prestretch:.4g} of the sheet in its rim from the overpressure, {stated:g} hPa, and the height",
    )


def _contradiction(holds: float, stated: Stated) -> list[str]:
    assert stated.overpressure is not None
    if abs(holds - stated.overpressure) <= DISAGREEMENT * max(holds, stated.overpressure):
        return []
    return [
        f"the numbers disagree: at a height of {stated.height:g} a sheet of this prestretch, modulus and thickness holds "
        f"{holds:.4g} hPa, the overpressure stated is {stated.overpressure:g} hPa; leave out --prestretch, --shear-modulus, "
        "--height or --overpressure, whichever is known worst: it then follows from the others"
    ]


def _split(product: float, thickness: float | None, modulus: float | None, unit: str) -> tuple[float, float, str]:
    """Split the product into thickness and shear modulus; return both, and a phrase that says which one was derived."""
    if modulus is not None:
        return float(f"{product / modulus:.6g}"), modulus, f"thickness {product / modulus:.4g} {unit}"
    if thickness is not None:
        return thickness, float(f"{product / thickness:.6g}"), f"shear modulus {product / thickness:.4g} N/{unit}^2"
    sentence = f"shear modulus x thickness {product:.4g} N/{unit} (of a thickness written as 1; only the product matters)"
    return 1.0, float(f"{product:.6g}"), sentence


def _in_words(formed: FormedSurface, unit: str) -> list[str]:
    return [
        f"rest shape: a sheet inflated to {formed.height:.4g} {unit} over its rim, on a grid whose smallest angle is "
        f"{formed.cells.angle:.0f} degrees"
    ]


def sheet_dots(surface: InflatedSurface, pitch: float) -> tuple[np.ndarray, list[str]]:
    """Return a square pattern of alternating large and small dots, drawn on the sheet in its rim before inflation.

    Args:
        surface: the rest surface.
        pitch: pitch of the pattern on the stretched sheet, length unit.

    Returns:
        Positions of the dots on the rest surface, `[D, 3]`, camera's frame, and their sizes.
    """
    formed, outline = surface.formed, surface.formed.outline
    reach = np.abs(outline.points).max(0) // pitch
    i, j = (a.ravel() for a in np.meshgrid(*(np.arange(-r, r + 1) for r in reach), indexing="ij"))
    flat = np.stack([i, j], -1) * pitch
    lines = 2 * len(formed.vertices) - 1
    vertices, sheet = formed.resampled_to((lines, lines))
    plane = ((sheet - outline.origin) @ outline.axes.T)[..., :2]
    inside = encloses(outline.points, flat) & (_distance(outline.points, flat) > MARGIN * pitch)
    found = LinearNDInterpolator(plane.reshape(-1, 2), vertices.reshape(-1, 3))(flat)
    kept = inside & np.isfinite(found).all(1)
    return rounded(found[kept]), np.where((i + j)[kept] % 2 == 0, "large", "small").tolist()


def _distance(rim: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Return the distances of `points [D, 2]` from the nearest side of a closed polygon, `[D]`."""
    a, along = rim[None], (np.roll(rim, -1, 0) - rim)[None]
    to = points[:, None] - a
    share = ((to * along).sum(-1) / (along**2).sum(-1)).clip(0, 1)
    distance: np.ndarray = np.linalg.norm(to - share[..., None] * along, axis=-1).min(1)
    return distance
