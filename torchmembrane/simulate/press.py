"""A membrane pressed by rigid indenters along given paths: static equilibrium at every pose."""

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from ..errors import MembraneError
from ..mechanics.cavity import rest_balance
from ..mechanics.hyperelastic import ElasticEnergy
from ..surface.membrane import Membrane
from ..surface.projection import SurfacePoints
from .contact import Contact
from .equilibrium import Equilibrium, Gas, Liquid, Open
from .indenters import Indenter

FINEST = 1 / 64  # of an increment, before a press is given up


class Press(NamedTuple):
    """A membrane in equilibrium with its indenters, converged; float64, the camera's frame, lengths in the membrane's unit.

    vertices        `[V, 3]` deformed
    contact         `[V]` bool
    traction        `[V, 3]` contact force per deformed area on the membrane
    force           `[3]` total contact force on the membrane
    forces          `[I, 3]` of each indenter
    contact_points  `[I, 3]` centroid of each indenter's normal forces, NaN where it does not touch
    pressure        pressure difference across the membrane, and `rest_pressure` without contact
    volume_error    (V - V_rest) / V_rest
    penetration     largest depth of a free vertex inside an indenter
    rim_reaction    `[3]` force of the rim on the membrane
    imbalance       sum of all forces over the sum of the magnitudes of the contact and pressure forces
    iterations      Newton steps since the previous pose
    """

    vertices: Tensor
    contact: Tensor
    traction: Tensor
    force: Tensor
    forces: Tensor
    contact_points: Tensor
    pressure: float
    rest_pressure: float
    volume_error: float
    penetration: float
    rim_reaction: Tensor
    imbalance: float
    iterations: int


def press(membrane: Membrane, elasticity: ElasticEnergy, paths, **options) -> Press:
    """The last state of `presses`, which takes the same arguments: a membrane pressed by indenters.

    >>> from torchmembrane.surface.shapes import spherical_cap
    >>> from torchmembrane.simulate.indenters import Sphere
    >>> dome = spherical_cap(12, 9, 3, (9, 9))
    >>> ball = Sphere(4.0).touching(dome, (0, 0, -1))
    >>> state = press(dome, ElasticEnergy(dome, prestretch=1.3), [[ball, ball.moved((0, 0, -1.0))]])
    >>> round(float(state.vertices[40, 2]), 6), state.pressure > state.rest_pressure
    (11.0, True)
    """
    *_, last = presses(membrane, elasticity, paths, **options)
    return last


def presses(
    membrane: Membrane,
    elasticity: ElasticEnergy,
    paths: Sequence[Sequence[Indenter]],
    filling="liquid",
    gas: tuple[float, float] | None = None,
    friction=0.0,
    increment: float | None = None,
) -> Iterator[Press]:
    """Static equilibrium at every pose of the paths, one after the other.

    Arguments
        paths       for each indenter its poses, all equally many: `[[ball.at(a), ball.at(b)]]` pushes one ball from a to b;
                    straight between two poses. Start outside (`ball.touching(membrane, direction)`) or lightly touching
        filling     "liquid" (volume kept), "gas" (absolute pressure x volume kept), "open" (pressure stays at rest)
        gas         for a gas: absolute pressure at rest (force / length^2) and volume (length^3)
        friction    Coulomb's coefficient mu
        increment   longest travel in one step (default: size / 100 with friction, whose answer depends on it; else size / 10)

    The rest load is taken up as a dead load, so that without contact the rest surface stays. Raises `MembraneError` where no
    equilibrium is found, also in small steps; never gives an unconverged state.
    Wrong where an indenter's features are finer than the grid: vertices are kept out of indenters, edges between them are not.
    Friction on an edge or corner of a `Mesh` that meets a vertex exactly has no normal to settle on: move it a little.
    """
    paths = [list(path) for path in paths]
    if not paths or not paths[0] or len({len(path) for path in paths}) != 1:
        raise MembraneError(f"press: paths of {[len(path) for path in paths]} poses; expected equally many, at least one each")
    if friction < 0 or (increment is not None and increment <= 0):
        raise MembraneError(f"press: friction = {friction}, increment = {increment}; expected friction >= 0 and increment > 0")
    increment = increment or membrane.size / (100 if friction else 10)
    balance, load = rest_balance(membrane, elasticity)
    rest_pressure = float(balance)
    equilibrium = Equilibrium(membrane, elasticity, _cavity(membrane, rest_pressure, filling, gas), load)
    x, pressure = membrane.rest, rest_pressure
    contacts = [Contact.begun(path[0], x[membrane.free_vertices], equilibrium.vertex_stiffness, friction) for path in paths]
    for poses in zip(*paths, strict=True):
        x, pressure, contacts, iterations = _moved(equilibrium, x, pressure, contacts, poses, increment)
        yield _result(equilibrium, rest_pressure, x, pressure, contacts, iterations)


def carried(x: Tensor, membrane: Membrane, positions) -> Tensor:
    """Where material points at rest at `positions [D, 3]` are on the deformed surface `x [..., V, 3]`: `[..., D, 3]`.

    They move with the closest points of the rest surface, by barycentric weights: `X_d + W (x - X)`.
    """
    positions = torch.as_tensor(np.asarray(positions), dtype=x.dtype)
    points: SurfacePoints = membrane.closest_points(positions)
    displacement = (x - membrane.rest)[..., torch.from_numpy(points.vertices), :]
    return positions + (torch.from_numpy(points.weights).to(x)[..., None] * displacement).sum(-2)


def _cavity(membrane: Membrane, rest_pressure: float, filling: str, gas):
    rest_volume = float(membrane.rest_volume)
    if filling == "liquid":
        return Liquid(rest_volume)
    if filling == "gas" and gas is not None:
        return Gas(rest_pressure, rest_volume, *gas)
    if filling == "open":
        return Open()
    raise MembraneError(
        f"press: filling = {filling!r}, gas = {gas}; expected 'liquid', 'open', or 'gas' with gas = (pressure, volume)"
    )


def _moved(equilibrium, x, pressure, contacts, poses, increment):
    """Equilibrium at the next poses, reached by increments that are halved where Newton's method fails."""
    starts, size = [contact.indenter for contact in contacts], equilibrium.membrane.size
    travel = max(_travel(start, pose, size) for start, pose in zip(starts, poses, strict=True))
    longest = 1 / max(1, int(np.ceil(travel / increment)))
    done, share, iterations = 0.0, longest, 0
    while done < 1:
        target = 1.0 if done + share > 1 - 1e-9 else done + share
        between = [start.between(pose, target) for start, pose in zip(starts, poses, strict=True)]
        try:
            tried = [c.carried_to(pose, x[equilibrium.free]) for c, pose in zip(contacts, between, strict=True)]
            x, pressure, contacts, steps = equilibrium.solve(x, pressure, tried)
        except MembraneError as error:
            share /= 2
            if share < FINEST * longest:
                raise MembraneError(
                    f"press: no equilibrium {target * travel:.3g} along a motion of {travel:.3g}, in steps down to "
                    f"{share * travel:.2g}; expected a press that the membrane can follow: press less deep, start outside, or "
                    f"give a finer grid ({error})"
                ) from error
        else:
            done, share, iterations = target, min(2 * share, longest), iterations + steps
    return x, pressure, contacts, iterations


def _travel(start: Indenter, end: Indenter, lever: float) -> float:
    cosine = (torch.einsum("ij,ij->", start.rotation, end.rotation) - 1) / 2
    return float((end.translation - start.translation).norm() + lever * cosine.clamp(-1, 1).acos())


def _result(equilibrium: Equilibrium, rest_pressure, x, pressure, contacts, iterations) -> Press:
    membrane, free = equilibrium.membrane, x[equilibrium.free]
    normal = torch.stack([contact.normal for contact in contacts])
    each = torch.stack([contact.force(free) for contact in contacts])
    nodal = torch.zeros_like(x).index_copy(0, equilibrium.free, each.sum(0))
    push = pressure * membrane._thirds_to_vertices(membrane.area_vectors(x))
    rim = (equilibrium.elasticity.gradient(x) - push)[membrane.fixed].sum(0)
    left_over = nodal.sum(0) + push.sum(0) + equilibrium.load.sum(0) + rim
    return Press(
        vertices=x,
        contact=torch.zeros_like(membrane.fixed).index_copy(0, equilibrium.free, (normal > 0).any(0)),
        traction=nodal / membrane.vertex_area(x)[:, None],
        force=nodal.sum(0),
        forces=each.sum(1),
        contact_points=normal @ free / normal.sum(1, keepdim=True),
        pressure=pressure,
        rest_pressure=rest_pressure,
        volume_error=float(membrane.volume(x) / membrane.rest_volume) - 1,
        penetration=max(0.0, *(float(-contact.indenter.distance(free).min()) for contact in contacts)),
        rim_reaction=rim,
        imbalance=float(left_over.norm() / (nodal.norm(dim=-1).sum() + push.norm(dim=-1).sum())),
        iterations=iterations,
    )
