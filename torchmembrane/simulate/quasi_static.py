"""A membrane pressed by rigid indenters along given paths: static equilibrium at every pose."""

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

FINEST = 1 / 64  # of an increment, before a press is given up


class Press(NamedTuple):
    """A membrane in equilibrium with its indenters, converged; float64, the camera's frame, lengths in the membrane's unit.

    Attributes:
        vertices: `[V, 3]`, deformed.
        contact: `[V]` bool, which vertices touch.
        traction: `[V, 3]`, contact force per deformed area on the membrane.
        force: `[3]`, total contact force on the membrane.
        forces: `[I, 3]`, of each indenter.
        contact_points: `[I, 3]`, centroid of each indenter's normal forces, NaN where it does not touch.
        pressure: pressure difference across the membrane.
        rest_pressure: the same without contact.
        volume_error: `(V - V_rest) / V_rest`.
        penetration: largest depth of a free vertex inside an indenter.
        rim_reaction: `[3]`, force of the rim on the membrane.
        imbalance: sum of all forces over the sum of the magnitudes of the contact and pressure forces.
        iterations: Newton steps since the previous pose.
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
    """The last state of `presses`, which takes the same arguments.

    Args:
        membrane: at rest.
        elasticity: its elastic energy.
        paths: for each indenter its poses.
        options: as of `presses`.

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
    """Static equilibrium at every pose of the paths, one after the other.

    The rest load is taken up as a dead load, so that without contact the rest surface stays.

    Args:
        membrane: at rest.
        elasticity: its elastic energy.
        paths: for each indenter its poses, all equally many: `[[ball.at(a), ball.at(b)]]` moves one ball from a to b, straight
            between two poses. Start outside (`ball.touching(membrane, direction)`) or lightly touching.
        filling: "liquid" (volume kept), "gas" (absolute pressure x volume kept) or "open" (pressure stays at rest).
        gas: for a gas its absolute pressure at rest (force / length^2) and volume (length^3).
        friction: Coulomb's coefficient mu.
        increment: longest travel in one step; default: size / 100 with friction, whose answer depends on it, else size / 10.

    Yields:
        The equilibrium at each pose.

    Raises:
        MembraneError: no equilibrium is found, also in small steps; an unconverged state is never given.

    Limitations:
        Vertices are kept out of indenters, edges between them are not: an indenter's features should be coarser than the grid.
        Friction on an edge or corner of a `MeshIndenter` that meets a vertex exactly has no normal to settle on: move it a
        little.

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
    """Where material points are on a deformed surface: `X_d + W (x - X)`.

    They move with the closest points of the rest surface, by barycentric weights W.

    Args:
        x: the deformed surface, `[..., V, 3]`.
        membrane: at rest.
        positions: the points at rest, `[D, 3]`.

    Returns:
        Their positions, `[..., D, 3]`.

    Example:
        >>> from torchmembrane.surface.shapes import spherical_cap
        >>> dome = spherical_cap(12, 9, 3, (9, 9))
        >>> carried(dome.rest + torch.tensor([0.0, 0.0, 1.0]), dome, dome.rest[40:41]).tolist()
        [[0.0, 0.0, 13.0]]
    """
    positions = torch.as_tensor(np.asarray(positions), dtype=x.dtype)
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
    """Equilibrium at the next poses, reached by increments that are halved where Newton's method fails."""
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
    """Translation plus the turn on a `lever` (length) between two poses."""
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
