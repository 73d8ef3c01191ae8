"""Simulated presses for the accuracy trials: strokes of increasing depth, and pairs of balls at decreasing distance."""

from collections.abc import Sequence
from itertools import islice
from typing import NamedTuple

import numpy as np
import torch

from ..errors import MembraneError
from ..simulate.dataset import OFF_RIM, Plan, random_stroke, stroke_to
from ..simulate.indenters import Sphere
from ..simulate.quasi_static import Press, presses
from ..simulate.simulator import BEHIND, Simulator

BODIES = ("sphere", "sphere", "box")
FRICTIONS = (0.0, 0.4)
DEEPEST = 0.3  # travel of a stroke, over the surface's size
INCREMENT = 0.03  # longest step, over the size
BALL, PUSHED = 0.06, 0.05  # radius of the balls of a pair, and their depth, over the size
WIDEST, NEARER = 0.55, 0.8  # distance of the first pair, over the size; ratio of successive distances
LINES = 8  # random lines per direction, of which the one with room for most pairs is used
MIDDLE = 0.6  # smallest distance of a pair's midpoint from the rim, over the largest possible one
IN_VIEW = 0.02  # smallest distance of a contact from the image's border, over the image's sides
STEPS = 100  # Newton steps at one pose after which a stroke is abandoned
FAR_FROM_A_RIM = "expected a membrane of which the camera sees a part off the rim: check the camera and the rest surface"


class PairPress(NamedTuple):
    """An equilibrium with two balls; `distance` is the distance between the centres of the true contacts, length unit."""

    state: Press
    distance: float


def in_view(simulator: Simulator) -> np.ndarray:
    """Return which vertices of the simulator's grid are well inside the image at rest, `[V]` bool."""
    camera = simulator.sensor.camera
    pixels, size = camera.point_to_pixel(simulator.membrane.rest).numpy(), np.array(camera.image_size)
    with np.errstate(invalid="ignore"):
        inside = (pixels > IN_VIEW * size) & (pixels < (1 - IN_VIEW) * size)
    return np.asarray(inside.all(1))


def shares(frames: int, offset: float) -> list[float]:
    """Return the depths of a stroke's frames over the last one's: `((k + offset) / (frames + offset))^2`, k = 1, 2, ...

    Different offsets in 0..1 give different light touches.

    Example:
        >>> shares(2, 0.0), [round(share, 2) for share in shares(2, 0.5)]
        ([0.25, 1.0], [0.36, 1.0])
    """
    return [((k + offset) / (frames + offset)) ** 2 for k in range(1, frames + 1)]


def stroke_states(simulator: Simulator, number: int, frames: int, offset: float, seed: int) -> list[Press]:
    """Simulate one stroke from first contact, with quadratically increasing depths.

    Args:
        simulator: the sensor's simulator.
        number: number of the stroke, which determines indenter, place and friction.
        frames: number of frames, at the `shares` of the depth `DEEPEST`.
        offset: offset of the shares, 0..1.
        seed: seed of all strokes.

    Returns:
        The equilibria that can be simulated, without those before any vertex is touched.

    Raises:
        MembraneError: no press is possible, or no equilibrium with contact was found.
    """
    rng = np.random.default_rng([seed, 1, number])
    plan = Plan((BODIES[number % len(BODIES)],), FRICTIONS[number % len(FRICTIONS)], seed)
    stroke = random_stroke(simulator, plan, rng, in_view(simulator))
    depth = DEEPEST * simulator.membrane.size
    path = [stroke.indenter.moved(share * depth * stroke.travel) for share in (0.0, *shares(frames, offset))]
    states, reason = followed(simulator, [path], stroke.friction)
    touching = [state for state in states if state.contact.any()]
    if not touching:
        raise MembraneError(f"stroke {number + 1}: {reason or 'it never touches the membrane'}")
    return touching


def pair_states(simulator: Simulator, number: int, count: int, seed: int) -> list[PairPress]:
    """Simulate presses of two balls at decreasing distance.

    Args:
        simulator: the sensor's simulator.
        number: number of the direction of the line on which the balls lie.
        count: number of distances, starting at `WIDEST` x size, each `NEARER` times the one before.
        seed: seed of all directions.

    Returns:
        The pairs that are away from the rim, in view, and can be simulated.

    Raises:
        MembraneError: there is no place for two balls, or no pair can be simulated.
    """
    membrane, rng = simulator.membrane, np.random.default_rng([seed, 2, number])
    size, clear, seen = membrane.size, _clear_of_rim(simulator), in_view(simulator)
    free = np.where(seen, clear, 0.0)
    if free.max() < OFF_RIM * size:
        raise MembraneError(f"pairs: no place for two balls; {FAR_FROM_A_RIM}")
    middles = np.flatnonzero(free >= max(MIDDLE * free.max(), OFF_RIM * size))
    X, normals = membrane.rest.numpy(), membrane.rest_normals.numpy()
    away = WIDEST * size * NEARER ** np.arange(count)[:, None, None] / 2 * np.array([[-1.0], [1.0]])  # [count, 2, 1]
    lines = []
    for _ in range(LINES):
        middle = int(rng.choice(middles))
        along = np.cross(normals[middle], rng.normal(size=3))
        points = membrane.closest_points((X[middle] + away * along / np.linalg.norm(along)).reshape(-1, 3))
        places, ways = ((points.weights[..., None] * a[points.vertices]).sum(1) for a in (X, -normals))
        room = (seen & (clear > OFF_RIM * size))[points.vertices].reshape(-1, 6).all(1)
        lines.append((places.reshape(-1, 2, 3)[room], ways.reshape(-1, 2, 3)[room]))
    places, ways = max(lines, key=lambda line: len(line[0]))
    found = [pair for place, way in zip(places, ways, strict=True) for pair in _pair(simulator, place, way)]
    if not found:
        raise MembraneError(f"pairs, direction {number + 1}: no pair of balls fits, or none can be simulated; {FAR_FROM_A_RIM}")
    return found


def _pair(simulator: Simulator, places: np.ndarray, ways: np.ndarray) -> list[PairPress]:
    """Press two balls at `places [2, 3]` along `ways [2, 3]`; return an empty list if that is not possible."""
    size = simulator.membrane.size
    try:
        strokes = [
            stroke_to(simulator, Sphere(BALL * size), place, way, PUSHED * size)
            for place, way in zip(places, ways, strict=True)
        ]
    except MembraneError:
        return []
    paths = [[stroke.indenter, stroke.indenter.moved(stroke.depth * stroke.travel)] for stroke in strokes]
    states, _ = followed(simulator, paths, 0.0)
    apart = [float((state.contact_points[0] - state.contact_points[1]).norm()) for state in states]
    return [PairPress(state, distance) for state, distance in zip(states, apart, strict=True) if np.isfinite(distance)]


def followed(simulator: Simulator, paths: Sequence[Sequence], friction: float) -> tuple[list[Press], str]:
    """Return the equilibria at the poses after the first one, up to a failure, and the failure's reason (empty if none)."""
    states: list[Press] = []
    options = dict(friction=friction, increment=INCREMENT * simulator.membrane.size, **simulator.cavity)
    try:
        for state in islice(presses(simulator.membrane, simulator.elasticity, paths, **options), 1, None):
            if simulator.leaves_camera(state.vertices):
                return states, BEHIND
            states.append(state)
            if state.iterations > STEPS:
                return states, "no equilibrium in reasonable time"
    except MembraneError as error:
        return states, str(error)
    return states, ""


def _clear_of_rim(simulator: Simulator) -> np.ndarray:
    """Return the distance of each vertex from the rim, `[V]`."""
    X = simulator.membrane.rest
    return torch.cdist(X, X[simulator.membrane.fixed]).amin(1).numpy()
