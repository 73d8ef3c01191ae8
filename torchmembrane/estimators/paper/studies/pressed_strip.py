"""A strip pressed by discs without friction, in closed form (experiments of Appendix A).

Without friction the tension, and hence the stretch, is uniform. The free parts are arcs of one radius `T / p`, tangent to the
discs, and the fluid's area determines this radius. No grid is needed, and the shape does not depend on the material.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.optimize import brentq

from ....errors import MembraneError
from .strip import Strip

FLATTEST = 1e4  # largest radius of a free arc in the search, relative to the strip's


class Disc(NamedTuple):
    """A cylinder seen along its axis.

    Attributes:
        centre: centre `(x, y)`.
        radius: radius; 0 for a point.

    Example:
        >>> Disc.pressed(15.0, 0.0, 4.0, 5.0).centre
        (np.float64(16.0), np.float64(0.0))
    """

    centre: tuple[float, float]
    radius: float

    @classmethod
    def pressed(cls, strip_radius: float, angle: float, depth: float, radius: float) -> "Disc":
        """Return a disc that moved inwards by `depth` after touching the semicircle from outside at polar `angle`, degrees."""
        reach, phi = strip_radius + radius - depth, np.deg2rad(angle)
        return cls((reach * np.cos(phi), reach * np.sin(phi)), radius)


class Arc(NamedTuple):
    """Part of a circle.

    Attributes:
        centre: centre of the circle, `[2]`.
        radius: radius of the circle.
        start: angle at which the arc starts, radians.
        end: angle at which the arc ends, radians; on a disc it is smaller than `start`.
    """

    centre: np.ndarray
    radius: float
    start: float
    end: float

    @property
    def length(self) -> float:
        """Length of the arc."""
        return self.radius * abs(self.end - self.start)

    def points(self, share: np.ndarray) -> np.ndarray:
        """Return the points `[..., 2]` at fractions `share [...]` of the arc's length."""
        angle = self.start + share * (self.end - self.start)
        return self.centre + self.radius * np.stack([np.cos(angle), np.sin(angle)], -1)

    @property
    def area(self) -> float:
        """Area that the arc sweeps from the origin: `1/2 int x dy - y dx`."""
        a, b, r = self.start, self.end, self.radius
        swept = r * (b - a) + self.centre[0] * (np.sin(b) - np.sin(a)) - self.centre[1] * (np.cos(b) - np.cos(a))
        return float(r / 2 * swept)


class PressedStrip:
    """A strip that is a semicircle around the origin at rest, with ends on the x axis, pressed by discs at constant area.

    Args:
        radius: radius of the semicircle.
        discs: the discs that press the strip, none inside another's contact.

    Raises:
        MembraneError: a disc does not touch the strip, or no free arcs of less than half a circle enclose the area.

    Example:
        >>> lifted = PressedStrip(15.0, [Disc.pressed(15.0, 90, 4.0, 5.0)])
        >>> lifted.positions(np.array([0.0, 90.0, 180.0])).round(6).tolist()
        [[15.0, 0.0], [0.0, 11.0], [-15.0, 0.0]]
    """

    def __init__(self, radius: float, discs: Sequence[Disc]) -> None:
        self.radius = radius
        order = sorted(discs, key=lambda disc: np.arctan2(disc.centre[1], disc.centre[0]))
        self.bodies = [Disc((radius, 0.0), 0.0), *order, Disc((-radius, 0.0), 0.0)]
        target = np.pi * radius**2 / 2
        least = max(_gap(a, b) / 2 - (a.radius + b.radius) / 2 for a, b in zip(self.bodies, self.bodies[1:], strict=False))

        def excess(free: float) -> float:
            return sum(arc.area for arc in self._arcs(free)) - target

        tightest = max(least, 0.0) * (1 + 1e-9) + 1e-9 * radius
        if excess(tightest) < 0:
            raise MembraneError(f"PressedStrip: no arcs of less than half a circle enclose {target:.4g}; press less deep")
        self.free_radius = brentq(excess, tightest, FLATTEST * radius, xtol=1e-13)
        self.arcs = self._arcs(self.free_radius)
        for disc, arc in zip(order, self.arcs[1::2], strict=True):
            if arc.end > arc.start:
                raise MembraneError(f"PressedStrip: {disc} does not touch the strip; expected a disc that presses it in")
        self.stretch = sum(arc.length for arc in self.arcs) / (np.pi * radius)

    def _arcs(self, free: float) -> list[Arc]:
        """Return the free arcs of radius `free` alternating with the arcs on the discs."""
        centres = [_centre(a, b, free) for a, b in zip(self.bodies, self.bodies[1:], strict=False)]
        arcs = []
        for k, centre in enumerate(centres):
            first, last = (np.asarray(body.centre) - centre for body in self.bodies[k : k + 2])
            start = np.arctan2(first[1], first[0])
            arcs.append(Arc(centre, free, start, start + (np.arctan2(last[1], last[0]) - start) % (2 * np.pi)))
            if k + 1 < len(centres):
                disc, after = self.bodies[k + 1], centres[k + 1]
                start = np.arctan2(-last[1], -last[0])
                turn = np.arctan2(*(after - disc.centre)[::-1]) - start
                arcs.append(Arc(np.asarray(disc.centre), disc.radius, start, start + (turn + np.pi) % (2 * np.pi) - np.pi))
        return arcs

    def positions(self, angle: np.ndarray) -> np.ndarray:
        """Return the positions `[..., 2]` of the material points with polar `angle [...]` (degrees) at rest."""
        lengths = np.array([arc.length for arc in self.arcs])
        along = np.asarray(angle) / 180 * lengths.sum()
        ends = np.cumsum(lengths)
        part = np.minimum(np.searchsorted(ends, along), len(ends) - 1)
        place = np.empty((*np.shape(angle), 2))
        for k, arc in enumerate(self.arcs):
            here = part == k
            place[here] = arc.points((along[here] - (ends[k] - lengths[k])) / max(lengths[k], 1e-300))
        return place

    def pressure(self, strip: Strip) -> float:
        """Return the pressure of the fluid, `T / R` of the free arcs, force / length^2."""
        return strip.tension(self.stretch) / self.free_radius

    def forces(self, strip: Strip) -> np.ndarray:
        """Return the force of each disc on the strip per length along the axis, `[I, 2]`; it balances tension and pressure."""
        tension, pressure = strip.tension(self.stretch), self.pressure(strip)
        forces = []
        for before, arc, after in zip(self.arcs[::2], self.arcs[1::2], self.arcs[2::2], strict=False):
            chord = arc.points(np.array([1.0]))[0] - arc.points(np.array([0.0]))[0]
            forces.append(
                -tension * (_tangent(after.start) - _tangent(before.end)) - pressure * np.array([chord[1], -chord[0]])
            )
        return np.array(forces)


def _tangent(angle: float) -> np.ndarray:
    """Return the unit vector `[2]` tangent to a circle at this angle, counterclockwise."""
    return np.array([-np.sin(angle), np.cos(angle)])


def _gap(a: Disc, b: Disc) -> float:
    """Return the distance between two centres."""
    return float(np.hypot(b.centre[0] - a.centre[0], b.centre[1] - a.centre[1]))


def _centre(a: Disc, b: Disc, free: float) -> np.ndarray:
    """Return the centre of the circle of radius `free` that touches bodies a and b from inside, left of the line a b."""
    start, gap = np.asarray(a.centre), _gap(a, b)
    along = (np.asarray(b.centre) - start) / gap
    near, far = free + a.radius, free + b.radius
    ahead = (near**2 - far**2 + gap**2) / (2 * gap)
    centre: np.ndarray = start + ahead * along + np.sqrt(max(near**2 - ahead**2, 0.0)) * np.array([-along[1], along[0]])
    return centre
