"""Draft of a sensor from a few numbers: rest surface, camera on its axis, material in equilibrium, and a dot pattern."""

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from scipy.optimize import brentq

from ..errors import MembraneError
from ..markers.placement import FEWEST_MARKERS
from ..mechanics.cavity import rest_balance
from ..mechanics.hyperelastic import ElasticEnergy
from ..sensor.inflated import InflatedSurface
from ..sensor.parts import Material, Surface
from ..sensor.toml import MOST_DOTS
from ..sensor.units import hectopascal
from ..surface.membrane import Membrane
from .blown_up import DISAGREEMENT, sheet_dots
from .design import cylinder_dots, dome_dots

SHAPES: dict[str, tuple[str, ...]] = {
    "dome": ("radius",),
    "cap": ("radius", "height"),
    "bubble": ("radius", "height"),
    "fingertip": ("semi_axes",),
    "half_cylinder": ("radius", "length"),
    "rectangle": ("size", "height"),
    "ellipse": ("size", "height"),
    "outline": ("height",),
}
"""Shapes that can be drafted, and the lengths that each needs; the last three are inflated sheets (`blown_up`)."""
SHEETS = ("rectangle", "ellipse", "outline")
ASSUMED_PRESTRETCH = 1.2
LARGEST_STRETCH = 4.0
DECIMALS = 9  # of a distance
PITCHES = 11  # default number of pitches across the square root of the area
PRESSURE_UNITS = {"Pa": 0.01, "hPa": 1.0, "mbar": 1.0, "kPa": 10.0, "bar": 1000.0, "psi": 68.94757}  # in hPa


def drafted_surface(shape: str, numbers: Mapping[str, float | list[float]], base_z: float) -> Surface:
    """Return the rest surface of one of the `SHAPES` that are not inflated sheets.

    Args:
        shape: "dome" (half a sphere) | "cap" | "bubble" (a cap of gas) | "fingertip" (half an ellipsoid) | "half_cylinder".
        numbers: dimensions by name: `radius` of the sphere, of the cap's rim or of the cylinder; `height`; `semi_axes`;
            `length`; `half_angle` (degrees, default 90).
        base_z: distance of the rim from the camera, length unit.

    Returns:
        The `Surface`, as a sensor file describes it.

    Example:
        >>> drafted_surface("dome", {"radius": 12.0}, 15.0).values
        {'rim_radius': 12.0, 'height': 12.0, 'base_z': 15.0}
    """
    if shape == "fingertip":
        return Surface("ellipsoid_cap", {"semi_axes": numbers["semi_axes"], "base_z": base_z})
    if shape == "half_cylinder":
        keys = {key: numbers[key] for key in ("radius", "length")}
        return Surface("half_cylinder", keys | {"half_angle": numbers.get("half_angle", 90.0), "base_z": base_z})
    height = numbers["radius" if shape == "dome" else "height"]
    return Surface("spherical_cap", {"rim_radius": numbers["radius"], "height": height, "base_z": base_z})


@dataclass(frozen=True)
class RimCircle:
    """The relation between distance and focal length given the image of a round rim, by a camera on its axis.

    Args:
        radius: radius of the rim, length unit.
        pixels: radius of the rim in the image, px.
        model: "pinhole" | "fisheye".

    Example:
        >>> RimCircle(12.0, 240.0, "pinhole").distance(400.0)
        20.0
    """

    radius: float
    pixels: float
    model: str

    def distance(self, focal: float) -> float:
        """Return the rim's distance from the camera for a focal length (px; fisheye: px / rad); negative behind a fisheye.

        Raises:
            MembraneError: the rim is more than 180 degrees from the axis of a fisheye.
        """
        angle = self.pixels / focal
        if self.model == "pinhole":
            return self.radius / angle
        if not angle < math.pi:
            raise MembraneError(
                f"a rim of {self.pixels:g} px at {focal:.4g} px / rad lies {math.degrees(angle):.0f} degrees from the axis; "
                "expected less than 180: check --rim, and --focal or --view"
            )
        return round(self.radius * math.cos(angle) / math.sin(angle), DECIMALS)

    def focal(self, distance: float) -> float:
        """Return the focal length for a distance of the rim."""
        return self.pixels / (self.radius / distance if self.model == "pinhole" else math.atan2(self.radius, distance))


def focal_of_view(model: str, width: int, degrees: float) -> float:
    """Return the focal length, px, of a lens with the given field of view, degrees, across the image's width.

    Example:
        >>> focal_of_view("pinhole", 640, 90.0).__round__(6), focal_of_view("fisheye", 628, 180.0).__round__(2)
        (320.0, 199.9)
    """
    half = math.radians(degrees) / 2
    if model == "pinhole" and not degrees < 180:
        raise MembraneError(
            f"field of view {degrees:g} degrees; expected less than 180 for a pinhole lens (a fisheye sees more)"
        )
    if not degrees <= 360:
        raise MembraneError(f"field of view {degrees:g} degrees; expected at most 360")
    return width / 2 / (math.tan(half) if model == "pinhole" else half)


def overpressure(membrane: Membrane, material: Material, unit: str) -> float:
    """Return the overpressure that balances a membrane at rest, hPa; for a sphere of radius r and tension T it is `2 T / r`.

    Args:
        membrane: the rest surface.
        material: the material, with prestretch, shear modulus and thickness at rest.
        unit: unit of length.

    Example:
        >>> from torchmembrane.surface.shapes import spherical_cap
        >>> rubber = Material("neo_hookean", prestretch=1.3, shear_modulus=0.3, thickness=0.3)
        >>> round(overpressure(spherical_cap(30.0, 18.0, 60.0, (33, 33)), rubber, "mm"))
        71
    """
    energy = ElasticEnergy(membrane, material.model, material.prestretch, material.modulus, material.c2_ratio or 0.0)
    return float(rest_balance(membrane, energy)[0]) / hectopascal(unit)


def balanced(
    membrane: Membrane,
    unit: str,
    stated: float | None = None,
    prestretch: float | None = None,
    shear_modulus: float | None = None,
    thickness: float | None = None,
) -> tuple[Material, list[str]]:
    """Return a neo-Hookean material in equilibrium with the overpressure; a missing prestretch or modulus is derived from it.

    Args:
        membrane: the rest surface.
        unit: unit of length.
        stated: measured overpressure, hPa.
        prestretch: prestretch of the membrane at rest.
        shear_modulus: shear modulus, N per length unit squared.
        thickness: thickness at rest, after prestretching, length unit.

    Returns:
        The `Material`, and sentences on derived, assumed or contradictory values.

    Raises:
        MembraneError: nothing can be derived from the overpressure, or no prestretch up to `LARGEST_STRETCH` balances it.

    Example:
        >>> from torchmembrane.surface.shapes import spherical_cap
        >>> material, said = balanced(spherical_cap(30.0, 18.0, 60.0), "mm", 71.0, shear_modulus=0.3, thickness=0.3)
        >>> round(material.prestretch, 2), said
        (1.3, ['prestretch 1.3 from the overpressure, 71 hPa'])
    """
    known = shear_modulus is not None and thickness is not None
    if stated is not None and not known and (prestretch is None or thickness is None):
        raise MembraneError(
            f"init: an overpressure of {stated:g} hPa alone; expected --shear-modulus and --thickness, from which the "
            "prestretch follows, or --prestretch and --thickness, from which the shear modulus follows"
        )

    def held(stretch: float, modulus: float | None = shear_modulus) -> float:
        return overpressure(membrane, Material("neo_hookean", stretch, None, modulus, thickness), unit)

    if stated is None:
        said = [] if prestretch else [f"prestretch {ASSUMED_PRESTRETCH:g} is assumed: `calibrate material` finds it"]
        return Material("neo_hookean", prestretch or ASSUMED_PRESTRETCH, None, shear_modulus, thickness), said
    if prestretch is None:
        most = held(LARGEST_STRETCH)
        if not 0 < stated < most:
            raise MembraneError(
                f"init: overpressure {stated:g} hPa; expected more than 0 and less than {most:.4g} hPa, which this membrane "
                f"holds at a prestretch of {LARGEST_STRETCH:g}: check unit, shear modulus and thickness, and that the "
                "pressure is relative to the surroundings, not absolute"
            )
        prestretch = float(brentq(lambda stretch: held(stretch) - stated, 1.0, LARGEST_STRETCH))
        return Material("neo_hookean", round(prestretch, 6), None, shear_modulus, thickness), [
            f"prestretch {prestretch:.4g} from the overpressure, {stated:g} hPa"
        ]
    if shear_modulus is None:
        if prestretch == 1:
            raise MembraneError("init: a prestretch of 1 holds no overpressure; expected more than 1, or no --overpressure")
        shear_modulus = float(f"{stated / held(prestretch, 1.0):.6g}")
        said = [f"shear modulus {shear_modulus:.4g} N/{unit}^2 from the overpressure, {stated:g} hPa"]
    else:
        holds = held(prestretch)
        off = abs(holds - stated) > DISAGREEMENT * max(holds, stated)
        said = [
            f"the numbers disagree: prestretch, modulus and thickness hold {holds:.4g} hPa at rest, the overpressure stated is "
            f"{stated:.4g} hPa; leave out --prestretch or --shear-modulus, whichever is known worse: it then follows"
        ] * off
    return Material("neo_hookean", prestretch, None, shear_modulus, thickness), said


def pressure_in_hectopascal(text: str) -> float:
    """Parse a pressure with its unit, such as `20hPa`, `2 kPa` or `0.3psi`, and return it in hPa.

    Raises:
        ValueError: the text has no number or no known unit.

    Example:
        >>> pressure_in_hectopascal("2kPa")
        20.0
    """
    number = text.strip().rstrip("abcdefghijklmnopqrstuvwxyzPB").strip()
    unit = text.strip()[len(number) :].strip()
    if unit not in PRESSURE_UNITS:
        raise ValueError(text)
    return float(number) * PRESSURE_UNITS[unit]


def drafted_dots(surface: Surface, pitch: float | None = None) -> tuple[np.ndarray, list[str]]:
    """Return a square pattern of alternating large and small dots on a drafted membrane.

    Args:
        surface: a drafted rest surface.
        pitch: pitch along the membrane, length unit; None: the square root of its area over `PITCHES`.

    Returns:
        Positions of the dots in the camera's frame, `[D, 3]`, and their sizes.

    Raises:
        MembraneError: the pitch gives fewer than `FEWEST_MARKERS` dots, or more than `MOST_DOTS`.

    Example:
        >>> positions, sizes = drafted_dots(drafted_surface("dome", {"radius": 12.0}, 15.0), 2.4)
        >>> len(positions), sizes[:2]
        (177, ['small', 'large'])
    """
    side = float(surface.membrane((33, 33)).rest_area.sum()) ** 0.5
    pitch = pitch or float(f"{side / PITCHES:.4g}")
    wanted = f"one that gives {FEWEST_MARKERS} to {MOST_DOTS} dots, such as {side / PITCHES:.3g}"
    if pitch < side * MOST_DOTS**-0.5:
        raise MembraneError(f"init: a pitch of {pitch:g} gives {(side / pitch) ** 2:.0f} dots; expected {wanted}")
    positions, sizes = _pattern(surface, pitch)
    if len(sizes) < FEWEST_MARKERS:
        raise MembraneError(f"init: a pitch of {pitch:g} gives {len(sizes)} dots; expected {wanted}")
    return positions, sizes


def _pattern(surface: Surface, pitch: float) -> tuple[np.ndarray, list[str]]:
    v = surface.values
    if isinstance(surface, InflatedSurface):
        return sheet_dots(surface, pitch)
    if surface.shape == "half_cylinder":
        return cylinder_dots(v["radius"], v["length"], math.radians(v["half_angle"]), v["base_z"], pitch)
    if surface.shape == "ellipsoid_cap":
        return dome_dots(v["semi_axes"], math.pi / 2, v["base_z"], pitch)
    radius = (v["rim_radius"] ** 2 + v["height"] ** 2) / (2 * v["height"])
    return dome_dots((radius,) * 3, math.atan2(v["rim_radius"], radius - v["height"]), v["base_z"], pitch)
