"""Contact force and pressure as functions of depth at the top of a sensor, fitted to balls pressed in the simulator."""

from collections.abc import Sequence
from math import log, pi
from typing import NamedTuple

import numpy as np
import torch

from ..errors import MembraneError
from ..progress import Progress, silent
from ..sensor.sensor import Sensor
from ..simulate.dataset import stroke_to
from ..simulate.indenters import Sphere
from ..simulate.simulator import Simulator
from ..surface.membrane import Membrane
from .presses import followed

RADII, HELD_RADII = (0.1, 0.16, 0.26), (0.13, 0.21)
"""Radii of the balls over the surface's size, for fitting and for validation."""
DEPTHS, HELD_DEPTHS = (0.02, 0.035, 0.05, 0.07, 0.1), (0.028, 0.042, 0.06, 0.085)
"""Depths of the presses over the size, for fitting and for validation."""
RADIUS, DEPTH = 0.16, 0.05
"""Reference radius and depth of the law, over the size."""
FINER = 1.5
"""Grid lines over the simulator's default, so that the lightest press touches about ten vertices."""
LEAST = 8
"""Smallest number of presses to which the law's four parameters are fitted."""
TIE = 0.01
"""Relative difference up to which distances from the rim are considered equal."""
AROUND = 0.1
"""Radius of the part of the rest surface whose curvatures are computed, over the size."""


class BallPress(NamedTuple):
    """A frictionless press of a ball into the top of a sensor.

    Attributes:
        radius: radius of the ball, length unit.
        depth: travel along the inward normal since first contact, length unit.
        force: magnitude of the contact force, force unit.
        held_out: whether the press is for validation, not for fitting.
    """

    radius: float
    depth: float
    force: float
    held_out: bool


class ContactLaw(NamedTuple):
    """Force and pressure of a ball of radius r pressed to a depth d into the top of a sensor.

    With s the surface's size, `a = ln(r / (RADIUS s))` and `b = ln(d / (DEPTH s))`:

        F(r, d) = F0 exp(m a + (n + c a) b),    p(r, d) = dF/dd sqrt(k1 k2) / (2 pi),

    where k1 and k2 are `1 / r` plus the principal curvatures of the rest surface. The area of the surface that overlaps with
    the ball grows by `2 pi / sqrt(k1 k2)` per unit of depth, so that the integral of p, as a function of the local depth below
    the undeformed surface, over that area is F. Compliant contact models (elastic foundation, hydroelastic) take such a
    pressure. The true pressure acts on a smaller area and is more uniform.

    Attributes:
        size: size of the surface s, length unit.
        place: the top, which is the vertex farthest from the rim, `[3]`, camera's frame.
        inward: unit inward normal at the top, `[3]`.
        curvatures: principal curvatures of the rest surface there, positive for convex outward, 1 / length unit.
        reference: reference force F0, force unit.
        radius_exponent: exponent of the radius m.
        depth_exponent: exponent of the depth n, at the reference radius.
        change: change of the depth's exponent with the logarithm of the radius, c.
        length_unit: the sensor's length unit.
        force_unit: "N" | "relative".
        presses: the presses for fitting and validation.
    """

    size: float
    place: Sequence[float]
    inward: Sequence[float]
    curvatures: Sequence[float]
    reference: float
    radius_exponent: float
    depth_exponent: float
    change: float
    length_unit: str
    force_unit: str
    presses: Sequence[BallPress]

    def exponent(self, radius: float) -> float:
        """Return `d ln F / d ln d` for a ball of this radius."""
        return self.depth_exponent + self.change * log(radius / (RADIUS * self.size))

    def force(self, radius: float, depth: np.ndarray | float) -> np.ndarray:
        """Return the force F, force unit, with the shape of `depth`."""
        deep = np.log(np.asarray(depth) / (DEPTH * self.size))
        a = log(radius / (RADIUS * self.size))
        force: np.ndarray = self.reference * np.exp(self.radius_exponent * a + self.exponent(radius) * deep)
        return force

    def pressure(self, radius: float, depth: np.ndarray | float) -> np.ndarray:
        """Return the pressure p, force unit / length unit squared, with the shape of `depth`."""
        bent = np.prod([1 / radius + each for each in self.curvatures])
        if bent <= 0:
            raise MembraneError(
                f"ContactLaw: a ball of radius {radius:.3g} does not fit into the surface, whose curvatures are "
                f"{', '.join(f'{each:.3g}' for each in self.curvatures)} 1/{self.length_unit}; expected a smaller one"
            )
        pressure: np.ndarray = self.force(radius, depth) * self.exponent(radius) / depth * np.sqrt(bent) / (2 * pi)
        return pressure

    def errors(self, held_out: bool = True) -> np.ndarray:
        """Return the relative errors of the law's force for the presses held out, or for those used for fitting."""
        chosen = [press for press in self.presses if press.held_out is held_out]
        return np.array([float(self.force(press.radius, press.depth)) / press.force - 1 for press in chosen])


def contact_law(sensor: Sensor, progress: Progress = silent) -> ContactLaw:
    """Find the contact law of a sensor from five balls pressed in the simulator, three for fitting and two for validation.

    Args:
        sensor: the sensor.
        progress: called with the completed share.

    Raises:
        MembraneError: the sensor cannot be simulated, or the simulator finds an equilibrium for too few presses.

    Limitations:
        Valid at the top for frictionless balls of radius 0.1 to 0.26 and depths up to 0.1 of the size. Away from the top,
        forces are smaller, and other bodies have other laws (the force of a plate grows faster).

    Example:
        >>> from torchmembrane.presets import preset
        >>> law = contact_law(preset("bubble"))  # doctest: +SKIP
        >>> round(law.depth_exponent, 2), bool(abs(law.errors()).max() < 0.03)  # doctest: +SKIP
        (1.32, True)
    """
    coarse = Simulator(sensor)
    simulator = Simulator(sensor, grid=[round(FINER * lines) for lines in coarse.grid])
    size = simulator.membrane.size
    place, inward = top_of(sensor.membrane)
    presses: list[BallPress] = []
    for k, radius in enumerate((*RADII, *HELD_RADII)):
        progress(k / len((*RADII, *HELD_RADII)), f"a ball of {radius * size:.3g} {sensor.length_unit} pressed in the simulator")
        held_out = radius in HELD_RADII
        depths = HELD_DEPTHS if held_out else DEPTHS
        stroke = stroke_to(simulator, Sphere(radius * size), place, inward, max(depths) * size)
        path = [stroke.indenter.moved(depth * size * stroke.travel) for depth in (0.0, *depths)]
        states, _ = followed(simulator, [path], 0.0)
        forces = [float(state.force.norm()) for state in states]
        presses += [
            BallPress(radius * size, depth * size, force, held_out)
            for depth, force in zip(depths, forces, strict=False)
            if force > 0
        ]
    curvatures = curvatures_at(simulator.membrane, place, inward)
    where = place.tolist(), inward.tolist(), curvatures
    blank = ContactLaw(size, *where, 1.0, 0.0, 1.0, 0.0, sensor.length_unit, sensor.force_unit, [])
    return fitted(blank, presses, sensor.name)


def fitted(law: ContactLaw, presses: Sequence[BallPress], name: str) -> ContactLaw:
    """Return the law fitted to the presses that are not held out, by least squares of ln F."""
    chosen = [press for press in presses if not press.held_out]
    if len(chosen) < LEAST or len({press.radius for press in chosen}) < len(RADII):
        raise MembraneError(
            f"sensor {name!r}: {len(chosen)} of {len(RADII) * len(DEPTHS)} presses on its top can be followed; "
            f"expected {LEAST} of three balls: check the rest surface and the prestretch"
        )
    a = np.log([press.radius / (RADIUS * law.size) for press in chosen])
    b = np.log([press.depth / (DEPTH * law.size) for press in chosen])
    columns = np.stack([np.ones_like(a), a, b, a * b], 1)
    numbers, *_ = np.linalg.lstsq(columns, np.log([press.force for press in chosen]), rcond=None)
    reference, m, n, c = (float(each) for each in (np.exp(numbers[0]), *numbers[1:]))
    return law._replace(reference=reference, radius_exponent=m, depth_exponent=n, change=c, presses=list(presses))


def top_of(membrane: Membrane) -> tuple[np.ndarray, np.ndarray]:
    """Return the vertex farthest from the rim, `[3]` (the central one if several are tied), and the inward normal there."""
    clear = torch.cdist(membrane.rest, membrane.rest[membrane.fixed]).amin(1)
    farthest = clear > (1 - TIE) * clear.max()
    middle = membrane.rest[farthest].mean(0)
    top = int((membrane.rest - middle).norm(dim=-1).where(farthest, torch.inf).argmin())
    return membrane.rest[top].double().numpy(), -membrane.rest_normals[top].double().numpy()


def curvatures_at(membrane: Membrane, place: np.ndarray, inward: np.ndarray) -> list[float]:
    """Return the principal curvatures of the rest surface, the larger first, positive for convex outward.

    They are the curvatures of the paraboloid fitted to the vertices within `AROUND` of the size.

    Args:
        membrane: the membrane at rest.
        place: point on the surface, `[3]`.
        inward: unit inward normal there, `[3]`.

    Example:
        >>> from torchmembrane.surface.shapes import spherical_cap
        >>> dome = spherical_cap(8, 4, 0, (33, 33))  # of a sphere of radius 10
        >>> place, inward = top_of(dome)
        >>> [round(each, 3) for each in curvatures_at(dome, place, inward)]
        [0.1, 0.1]
    """
    away = membrane.rest.double().numpy() - place
    away = away[np.linalg.norm(away, axis=1) < AROUND * membrane.size]
    across = np.linalg.svd(inward[None])[2][1:]
    (x, y), z = across @ away.T, away @ inward
    columns = np.stack([x * x / 2, x * y, y * y / 2, x, y, np.ones_like(x)], 1)
    (xx, xy, yy, *_), *_ = np.linalg.lstsq(columns, z, rcond=None)
    return [float(each) for each in np.linalg.eigvalsh([[xx, xy], [xy, yy]])[::-1]]
