"""A membrane pressed by rigid indenters along given paths: static equilibrium at each pose."""

from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from ..errors import MembraneError, check_arguments
from ..mechanics.cavity import rest_balance
from ..mechanics.hyperelastic import ElasticEnergy
from ..surface.membrane import Membrane
from ..surface.projection import SurfacePoints
from .equilibrium import EquilibriumProblem, Filling, Gas, Liquid, Open
from .frictional_contact import FrictionalContact
from .indenters import Indenter

FINEST = 1 / 64  # smallest share of an increment before a press is given up


class Press(NamedTuple):
    """A converged equilibrium of a membrane with its indenters; float64, camera frame, lengths in the membrane's unit.

    Attributes:
        vertices: deformed vertices, `[V, 3]`.
        contact: `[V]` bool, whether each vertex is in contact.
        traction: contact force on the membrane per deformed area, `[V, 3]`.
        force: total contact force on the membrane, `[3]`.
        forces: contact force of each indenter, `[I, 3]`.
        contact_points: centroid of each indenter's normal forces, `[I, 3]`, NaN without contact.
        pressure: pressure difference across the membrane.
        rest_pressure: pressure difference without contact.
        volume_error: `(V - V_rest) / V_rest`.
        penetration: largest depth of a free vertex inside an indenter.
        rim_reaction: force of the rim on the membrane, `[3]`.
        imbalance: sum of all forces over the sum of the magnitudes of the contact and pressure forces.
        iterations: number of Newton steps since the previous pose.
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


@check_arguments
def press(membrane: Membrane, elasticity: ElasticEnergy, paths: Sequence[Sequence[Indenter]], **options: Any) -> Press:
    """Return the last state of `presses`, which takes the same arguments.

    Args:
        membrane: the membrane at rest.
        elasticity: its elastic energy.
        paths: the poses of each indenter.
        options: further arguments of `presses`.

    Returns:
        The equilibrium at the last poses.

    Raises:
        MembraneError: no equilibrium is found.

    Example:
        >>> from torchmembrane.simulate import Sphere
        >>> from torchmembrane.surface.shapes import spherical_cap
        >>> dome = spherical_cap(12, 9, 3, (9, 9))
        >>> ball = Sphere(4.0).touching(dome, (0, 0, -1))
        >>> state = press(dome, ElasticEnergy(dome, prestretch=1.3), [[ball, ball.moved((0, 0, -1.0))]])
        >>> round(float(state.vertices[40, 2]), 6), state.pressure > state.rest_pressure
        (11.0, True)
    """
    *_, last = presses(membrane, elasticity, paths, **options)
    return last


@check_arguments
def presses(
    membrane: Membrane,
    elasticity: ElasticEnergy,
    paths: Sequence[Sequence[Indenter]],
    filling: str = "liquid",
    gas: tuple[float, float] | None = None,
    friction: float = 0.0,
    increment: float | None = None,
) -> Iterator[Press]:
    """Compute the static equilibrium at each pose of the paths, one after another.

    The rest load is applied as a dead load, so that the rest surface is in equilibrium without contact.

    Args:
        membrane: the membrane at rest.
        elasticity: its elastic energy.
        paths: the poses of each indenter, the same number for all: `[[ball.at(a), ball.at(b)]]` moves one ball from a to b, in
            a straight line between two poses. Start outside (`ball.touching(membrane, direction)`) or in light contact.
        filling: "liquid" (constant volume), "gas" (constant product of absolute pressure and volume) or "open" (constant
            pressure).
        gas: for a gas, its absolute pressure at rest (force / length^2) and its volume (length^3).
        friction: Coulomb's coefficient mu.
        increment: longest travel in one step; default: size / 100 with friction, whose result depends on it, otherwise size /
            10.

    Yields:
        The equilibrium at each pose.

    Raises:
        MembraneError: no equilibrium is found, even in small steps; unconverged states are never returned.

    Limitations:
        Vertices are kept outside indenters, edges between them are not: an indenter's features should be coarser than the grid.
        With friction, the solver cannot settle on a normal where an edge or corner of a `MeshIndenter` meets a vertex exactly;
        move the indenter slightly.

    Example:
        >>> from torchmembrane.simulate import Sphere
        >>> from torchmembrane.surface.shapes import spherical_cap
        >>> dome = spherical_cap(12, 9, 3, (9, 9))
        >>> ball = Sphere(4.0).touching(dome, (0, 0, -1))
        >>> path = [ball.moved((0, 0, -depth)) for depth in (0.5, 1.0)]
        >>> first, second = presses(dome, ElasticEnergy(dome, prestretch=1.3), [path])
        >>> bool(second.force[2] < first.force[2] < 0)
        True
    """
    paths = [list(path) for path in paths]
    if not paths or not paths[0] or len({len(path) for path in paths}) != 1:
        raise MembraneError(f"press: paths of {[len(path) for path in paths]} poses; expected equally many, at least one each")
    if friction < 0 or (increment is not None and increment <= 0):
        raise MembraneError(f"press: friction = {friction}, increment = {increment}; expected friction >= 0 and increment > 0")
    increment = increment or membrane.size / (100 if friction else 10)
    balance, load = rest_balance(membrane, elasticity)
    rest_pressure = float(balance)
    problem = EquilibriumProblem(membrane, elasticity, _cavity(membrane, rest_pressure, filling, gas), load)
    x, pressure = membrane.rest, rest_pressure
    contacts: Sequence[FrictionalContact] = [
        FrictionalContact.at_first_pose(path[0], x[membrane.free_vertices], problem.vertex_stiffness, friction)
        for path in paths
    ]
    for poses in zip(*paths, strict=True):
        x, pressure, contacts, iterations = _moved(problem, x, pressure, contacts, poses, increment)
        yield _result(problem, rest_pressure, x, pressure, contacts, iterations)


def carried(x: Tensor, membrane: Membrane, positions: Tensor | np.ndarray) -> Tensor:
    """Return the positions of material points on a deformed surface: `X_d + W (x - X)`.

    The points move with the closest points of the rest surface, by barycentric weights W.

    Args:
        x: vertices of the deformed surface, `[..., V, 3]`.
        membrane: the membrane at rest.
        positions: positions of the points at rest, `[D, 3]`.

    Returns:
        Positions on the deformed surface, `[..., D, 3]`.

    Example:
        >>> from torchmembrane.surface.shapes import spherical_cap
        >>> dome = spherical_cap(12, 9, 3, (9, 9))
        >>> carried(dome.rest + torch.tensor([0.0, 0.0, 1.0]), dome, dome.rest[40:41]).tolist()
        [[0.0, 0.0, 13.0]]
    """
    positions = torch.as_tensor(np.asarray(positions), dtype=x.dtype, device=x.device)
    points: SurfacePoints = membrane.closest_points(positions)
    displacement = (x - membrane.rest)[..., torch.from_numpy(points.vertices), :]
    return positions + (torch.from_numpy(points.weights).to(x)[..., None] * displacement).sum(-2)


def _cavity(membrane: Membrane, rest_pressure: float, filling: str, gas: tuple[float, float] | None) -> Filling:
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


def _moved(
    problem: EquilibriumProblem,
    x: Tensor,
    pressure: float,
    contacts: Sequence[FrictionalContact],
    poses: Sequence[Indenter],
    increment: float,
) -> tuple[Tensor, float, Sequence[FrictionalContact], int]:
    """Find the equilibrium at the next poses, by increments that are halved where Newton's method fails."""
    starts, size = [contact.indenter for contact in contacts], problem.membrane.size
    travel = max(_travel(start, pose, size) for start, pose in zip(starts, poses, strict=True))
    longest = 1 / max(1, int(np.ceil(travel / increment)))
    done, share, iterations = 0.0, longest, 0
    while done < 1:
        target = 1.0 if done + share > 1 - 1e-9 else done + share
        between = [start.between(pose, target) for start, pose in zip(starts, poses, strict=True)]
        try:
            tried = [c.carried_to(pose, x[problem.free]) for c, pose in zip(contacts, between, strict=True)]
            x, pressure, contacts, steps = problem.solve(x, pressure, tried)
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
    """Return the length of the translation plus that of the rotation on a `lever` (length) between two poses."""
    cosine = (torch.einsum("ij,ij->", start.rotation, end.rotation) - 1) / 2
    return float((end.translation - start.translation).norm() + lever * cosine.clamp(-1, 1).acos())


def _result(
    problem: EquilibriumProblem,
    rest_pressure: float,
    x: Tensor,
    pressure: float,
    contacts: Sequence[FrictionalContact],
    iterations: int,
) -> Press:
    membrane, free = problem.membrane, x[problem.free]
    normal = torch.stack([contact.normal for contact in contacts])
    each = torch.stack([contact.force(free) for contact in contacts])
    nodal = torch.zeros_like(x).index_copy(0, problem.free, each.sum(0))
    fluid = pressure * membrane.thirds_to_vertices(membrane.area_vectors(x))
    rim = (problem.elasticity.gradient(x) - fluid)[membrane.fixed].sum(0)
    left_over = nodal.sum(0) + fluid.sum(0) + problem.load.sum(0) + rim
    return Press(
        vertices=x,
        contact=torch.zeros_like(membrane.fixed).index_copy(0, problem.free, (normal > 0).any(0)),
        traction=nodal / membrane.vertex_area(x)[:, None],
        force=nodal.sum(0),
        forces=each.sum(1),
        contact_points=normal @ free / normal.sum(1, keepdim=True),
        pressure=pressure,
        rest_pressure=rest_pressure,
        volume_error=float(membrane.volume(x) / membrane.rest_volume) - 1,
        penetration=max(0.0, *(float(-contact.indenter.distance(free).min()) for contact in contacts)),
        rim_reaction=rim,
        imbalance=float(left_over.norm() / (nodal.norm(dim=-1).sum() + fluid.norm(dim=-1).sum())),
        iterations=iterations,
    )
