"""Data sets of random presses of one sensor: reproducible by seed and number, computed on all cores, and resumed after an
interruption."""

import sys
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch

from ..errors import MembraneError
from ..processes import begin_worker, spawned_pool
from ..progress import Progress, silent
from ..torch_modes import on_cpu
from .frames import SimulatedFrames
from .indenters import Box, Cylinder, Indenter, Plane, Sphere, Wedge, facing
from .simulator import SimulatedFrame, Simulator, Stroke

ATTEMPTS = 10
RADIUS = (0.06, 0.25)  # of spheres and cylinders, over the square root of the rest area; log-uniform
EDGE = (0.02, 0.05)  # of edges' rounding
SIDE = (0.15, 0.4)  # of a box
DEPTH = (0.01, 0.1)
OFF_RIM = 0.15  # smallest distance of the target point from the rim
TILT = 20.0  # degrees, largest angle between the motion and the normal at the target point
KINDS = ("sphere", "cylinder", "wedge", "box", "plane")
NO_SLIDE = np.zeros(3)


class Plan(NamedTuple):
    """The settings that all presses of a data set share.

    Attributes:
        kinds: kinds of indenters, some of `KINDS`.
        friction: Coulomb's coefficient.
        seed: seed of presses and noise.
        increment: longest travel in a step, length unit; None: the default of `presses`.

    Example:
        >>> Plan(kinds=("sphere",), seed=1).friction
        0.0
    """

    kinds: Sequence[str] = KINDS
    friction: float = 0.0
    seed: int = 0
    increment: float | None = None


class DatasetOutcome(NamedTuple):
    """Numbers of frames of a data set that were made, failed, or existed before.

    Attributes:
        made: number of frames made by this call.
        failed: number of frames that failed in this call.
        skipped: number of frames that existed before.
    """

    made: int
    failed: int
    skipped: int


def random_frame(simulator: Simulator, plan: Plan, number: int) -> SimulatedFrame:
    """Simulate frame `number` of a data set; a stroke that the membrane cannot follow is replaced by another random one.

    Raises:
        MembraneError: none of `ATTEMPTS` strokes could be drawn and followed by the membrane.
    """
    rng = np.random.default_rng([plan.seed, number])
    for _ in range(ATTEMPTS):
        try:
            stroke = random_stroke(simulator, plan, rng)
            (state,) = simulator.presses(stroke, ("push",), increment=plan.increment)
        except MembraneError as error:
            reason = str(error)
        else:
            return simulator.frame(state, stroke, rng)
    raise MembraneError(f"none of {ATTEMPTS} random strokes could be followed; the last one: {reason}")


def random_stroke(simulator: Simulator, plan: Plan, rng: np.random.Generator, seen: np.ndarray | None = None) -> Stroke:
    """Draw a random stroke towards a point of the surface away from its rim, uniform in area, and tilted against the normal.

    Args:
        simulator: simulator of the sensor whose membrane is pressed.
        plan: settings, of which the kinds of bodies and the friction are used.
        rng: random generator.
        seen: `[V]` bool, the vertices that may be target points; default: all.

    Raises:
        MembraneError: no such point is far enough from the rim, or the body does not meet the surface.
    """
    membrane, size = simulator.membrane, simulator.membrane.size
    X, normals, fixed = (a.numpy() for a in (membrane.rest, membrane.rest_normals, membrane.fixed))
    off_rim = np.linalg.norm(X[:, None] - X[fixed], axis=-1).min(1) > OFF_RIM * size
    weight = np.where(off_rim if seen is None else off_rim & seen, membrane.rest_area.numpy(), 0.0)
    if not weight.any():
        raise MembraneError(
            f"sensor {simulator.sensor.name!r}: no part of the membrane that may be pressed is more than {OFF_RIM * size:.3g} "
            "away from its rim; expected one in view of the camera: check the camera and the rest surface"
        )
    target = rng.choice(len(X), p=weight / weight.sum())
    kind = plan.kinds[int(rng.integers(len(plan.kinds)))]
    body, turn, depth = _random_body(kind, size, rng), rng.uniform(0, 2 * np.pi), size * rng.uniform(*DEPTH)
    axis, tilt = rng.normal(size=3), 0.0 if kind == "plane" else np.tan(np.deg2rad(TILT * rng.random() ** 0.5))
    across = np.cross(normals[target], axis)
    travel = -normals[target] + tilt * across / np.linalg.norm(across)
    return stroke_to(simulator, body, X[target], travel, depth, turn=turn, friction=plan.friction)


@on_cpu
def stroke_to(
    simulator: Simulator,
    body: Indenter,
    aim: np.ndarray,
    travel: np.ndarray,
    depth: float,
    turn: float = 0.0,
    slide: np.ndarray = NO_SLIDE,
    friction: float = 0.0,
) -> Stroke:
    """Return the stroke of a body that moves towards a point, from its first contact.

    Args:
        simulator: simulator of the sensor whose membrane is pressed.
        body: the body, in any pose.
        aim: the target point, `[3]`.
        travel: direction of the motion, `[3]`.
        depth: distance travelled from the first contact, length unit.
        turn: rotation about `travel` from the pose that `facing` returns, rad.
        slide: displacement after the press, `[3]`.
        friction: Coulomb's coefficient.

    Raises:
        MembraneError: the body does not meet the surface.
    """
    travel = np.asarray(travel, float) / np.linalg.norm(travel)
    c, s = np.cos(turn), np.sin(turn)
    rotation = facing(travel) @ torch.tensor([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]], dtype=torch.float64)
    touching = body.at(torch.as_tensor(np.asarray(aim, float)), rotation).touching(simulator.membrane, travel)
    return Stroke(touching, travel, float(depth), np.asarray(slide, float), friction)


def _random_body(kind: str, size: float, rng: np.random.Generator) -> Indenter:
    """Return a body of this kind and of random size."""
    radius = size * np.exp(rng.uniform(*np.log(RADIUS)))
    edge = size * rng.uniform(*EDGE)
    if kind == "sphere":
        return Sphere(radius)
    if kind == "cylinder":
        return Cylinder(radius)
    if kind == "wedge":
        return Wedge(rng.uniform(40, 100), edge)
    if kind == "box":
        return Box(torch.from_numpy(size * rng.uniform(*SIDE, 3)), edge)
    return Plane()


def _report(line: str) -> None:
    print(line, file=sys.stderr)


def make_frames(
    simulator: Simulator,
    plan: Plan,
    count: int,
    frames: SimulatedFrames,
    jobs: int = 1,
    report: Callable[[str], None] = _report,
    progress: Progress = silent,
) -> DatasetOutcome:
    """Make those of the frames 0 to `count - 1` of a data set that `frames` does not contain yet.

    A press that fails is reported and left out; the same call tries it again. After an interruption, the frames made so far are
    kept.

    Args:
        simulator: simulator of the sensor.
        plan: settings that the presses share.
        count: number of frames in the data set.
        frames: storage of the frames.
        jobs: number of processes.
        report: called with a line for each press that fails; default: writes it to stderr.
        progress: called with the completed share.
    """
    names = {number: f"s{plan.seed}_{number:06d}" for number in range(count)}
    held = frames.names()
    wanted = [number for number, name in names.items() if name not in held]
    failed, skipped = 0, count - len(wanted)

    def tell(done: int) -> None:
        progress((skipped + done) / count, f"press {skipped + done} of {count}")

    try:
        progress(skipped / count, f"{len(wanted)} presses")
        for number, made in _in_processes(simulator, plan, wanted, jobs, tell):
            if isinstance(made, str):
                failed += 1
                report(f"{names[number]}: {made}")
            else:
                frames.write(names[number], made)
    finally:
        frames.flush()
    return DatasetOutcome(len(wanted) - failed, failed, skipped)


def _in_processes(
    simulator: Simulator, plan: Plan, numbers: Sequence[int], jobs: int, tell: Callable[[int], None] = lambda done: None
) -> Iterator[tuple[int, SimulatedFrame | str]]:
    """Yield frame numbers and their frames or failures in order; `tell` is called with the number done, in any order."""
    jobs = min(jobs, len(numbers))
    if jobs <= 1:
        for done, number in enumerate(numbers, 1):
            made = number, _frame_or_reason(simulator, plan, number)
            tell(done)
            yield made
        return
    with spawned_pool(jobs, _begin, (simulator, plan)) as pool:
        early: dict[int, SimulatedFrame | str] = {}
        waiting = iter(numbers)
        due = next(waiting)
        for done, (number, frame) in enumerate(pool.imap_unordered(_work, numbers), 1):
            tell(done)
            early[number] = frame
            while due in early:
                yield due, early.pop(due)
                due = next(waiting, -1)


_simulator: Simulator
_plan: Plan


def _begin(path: Path) -> None:
    """Start a worker process by loading what `_work` needs."""
    global _simulator, _plan
    _simulator, _plan = begin_worker(path)


def _work(number: int) -> tuple[int, SimulatedFrame | str]:
    return number, _frame_or_reason(_simulator, _plan, number)


def _frame_or_reason(simulator: Simulator, plan: Plan, number: int) -> SimulatedFrame | str:
    try:
        return random_frame(simulator, plan, number)
    except MembraneError as error:
        return str(error)
