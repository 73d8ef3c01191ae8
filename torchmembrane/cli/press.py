"""The work of `torchmembrane simulate`: one press, the frames along a path, or a data set of random presses."""

import math
from argparse import Namespace
from collections.abc import Iterable, Sequence
from contextlib import nullcontext
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
import torch

from ..errors import MembraneError
from ..files.targets import refuse_overwriting
from ..presets import sensor_file
from ..sensor.companions import companions_of, files_of
from ..sensor.sensor import Sensor
from ..simulate.appearance import Appearance
from ..simulate.dataset import KINDS, DatasetOutcome, Plan, make_frames, stroke_to
from ..simulate.frames import SENSOR, SETTINGS, image_files, open_frames, video_file
from ..simulate.indenters import Box, Cylinder, Indenter, Plane, Sphere, Wedge
from ..simulate.mesh_indenter import MeshIndenter
from ..simulate.simulator import Simulator, Stroke
from .describe import pressure_in_words
from .progress import ProgressDisplay

LENGTHS = {
    "radius": (1e-3, 100.0),
    "sides": (1e-3, 100.0),
    "depth": (1e-6, 2.0),
    "slide": (0.0, 2.0),
    "aim": (0.0, 100.0),
    "increment": (1e-4, 2.0),
}
"""Smallest and largest lengths relative to the size of the surface."""
OUTWARDS = 0.3
"""Cosine between the travel and the outward normal at the first touch above which the press comes from within."""


def simulate(arguments: Namespace) -> int:
    """Simulate what the arguments specify; return the exit code."""
    torch.set_num_threads(1)
    sensor = Sensor.from_file(sensor_file(arguments.sensor))
    if arguments.video and sensor.views_apart:
        raise MembraneError("--video: each view has its own image; leave --video out, or use a sensor with views in one image")
    _spare_files(arguments, sensor.views_apart)
    appearance = Appearance(noise=arguments.noise, highlight=arguments.highlight, blur=arguments.blur)
    options = arguments.grid, appearance, arguments.dots, arguments.missing
    if not arguments.random:
        return _single(arguments, Simulator(sensor, *options))
    with ProgressDisplay("simulate --random") as progress:
        progress.begin("the sensor in the simulator")
        outcome = _random(arguments, Simulator(sensor, *options), progress)
    print(f"presses: {outcome.made} made, {outcome.failed} failed, {outcome.skipped} finished earlier; folder: {arguments.out}")
    return 1 if outcome.failed else 0


def _spare_files(arguments: Namespace, views: Sequence[str]) -> None:
    """Refuse a folder in which files would be lost; frames of an earlier simulation in it are replaced."""
    out, read = arguments.out, files_of(sensor_file(arguments.sensor))
    is_known = (out / SETTINGS).exists()
    targets = [] if is_known or (out / SENSOR).exists() else [out / SETTINGS, *companions_of(out / SENSOR)]
    names = [] if arguments.random else [arguments.name]
    if arguments.path:
        names = [_numbered(arguments.name, number) for number in range(len(arguments.path) * arguments.frames)]
    truths = [out / f"{name}_truth.npz" for name in names]
    targets += truths + [out / file for name in names if not arguments.video for file in image_files(name, views)]
    if arguments.video:
        targets.append(out / f"{arguments.name}.mp4")
    if arguments.random and not is_known:
        targets += out.glob(f"s{arguments.seed}_*")
    if arguments.indenter and not arguments.random:
        read.append(Path(arguments.indenter))
    made = is_known and all(path.exists() for path in truths)
    refuse_overwriting(f"simulate --out {out}", targets, read, arguments.force, lambda path: made)


def _numbered(name: str, number: int) -> str:
    """Return the name of a frame of a path."""
    return f"{name}_{number:06d}"


def _random(arguments: Namespace, simulator: Simulator, progress: ProgressDisplay) -> DatasetOutcome:
    kinds = arguments.indenter.split(",") if arguments.indenter else KINDS
    if unknown := [kind for kind in kinds if kind not in KINDS]:
        raise MembraneError(f"--indenter {unknown[0]}: no random indenter; expected some of {', '.join(KINDS)}")
    plan = Plan(kinds, arguments.friction, arguments.seed, arguments.increment)
    shared = {"kinds": list(kinds), "friction": plan.friction, "increment": plan.increment}
    frames = open_frames(arguments.out, simulator, shared, arguments.format)
    return make_frames(simulator, plan, arguments.random, frames, arguments.jobs, progress.write, progress)


def _single(arguments: Namespace, simulator: Simulator) -> int:
    _refuse_lengths(arguments, simulator.membrane.size)
    stroke = _stroke(arguments, simulator)
    if arguments.path:
        return _film(arguments, simulator, stroke)
    legs = ("push",) if arguments.slide is None else ("push", "slide")
    *_, state = simulator.presses(stroke, legs, increment=arguments.increment)
    frame = simulator.frame(state, stroke, np.random.default_rng(arguments.seed))
    open_frames(arguments.out, simulator, {}).write(arguments.name, frame)
    force, touching = float(state.force.norm()), int(state.contact.sum())
    change = pressure_in_words(float(state.pressure - state.rest_pressure), simulator.sensor)
    shown = ", ".join(str(arguments.out / file) for file in image_files(arguments.name, simulator.sensor.views_apart))
    print(
        f"{shown}: force {force:.4g} {simulator.sensor.force_unit}, pressure change {change}, "
        f"{touching} of {len(state.contact)} vertices in contact"
    )
    return 0


def _film(arguments: Namespace, simulator: Simulator, stroke: Stroke) -> int:
    from tqdm import tqdm

    rng, total = np.random.default_rng(arguments.seed), len(arguments.path) * arguments.frames
    states = simulator.presses(stroke, arguments.path, arguments.frames, arguments.increment)
    states = chain([next(states)], states)  # a press that cannot begin leaves no folder
    frames = open_frames(arguments.out, simulator, {})
    with video_file(arguments.out / f"{arguments.name}.mp4") if arguments.video else nullcontext() as add_picture:
        for number, state in enumerate(tqdm(states, total=total, desc="simulate", unit="frame")):
            name, frame = _numbered(arguments.name, number), simulator.frame(state, stroke, rng)
            if add_picture is not None:
                add_picture(frame.image)
                frames.write_truth(name, frame)
            else:
                frames.write(name, frame)
    print(f"{total} frames in {arguments.out}")
    return 0


def _refuse_lengths(arguments: Namespace, size: float) -> None:
    """Refuse lengths that are impossible for a press of a surface of this size; the message names the option."""
    for name, (least, most) in LENGTHS.items():
        if (value := getattr(arguments, name)) is None:
            continue
        given = np.atleast_1d(np.asarray(value, float))
        lengths = np.array([math.hypot(*given)]) if name in ("slide", "aim") else given
        if not ((lengths >= least * size) & (lengths <= most * size)).all():
            expected = f"{least * size:.3g} to {most * size:.3g}, as the surface's size is {size:.3g}"
            raise MembraneError(f"--{name} {_listed(given)}: not possible for this membrane; expected lengths from {expected}")


def _stroke(arguments: Namespace, simulator: Simulator) -> Stroke:
    membrane = simulator.membrane
    aim = membrane.rest[membrane.fixed].mean(0).numpy() if arguments.aim is None else np.array(arguments.aim)
    direction = np.array(arguments.direction)
    if not 1e-6 < np.abs(direction).max() < 1e6:
        raise MembraneError(
            f"--direction {_listed(direction)}: expected X,Y,Z other than zero, the side from which the indenter comes"
        )
    slide = np.zeros(3) if arguments.slide is None else np.array(arguments.slide)
    turn, friction = np.deg2rad(arguments.turn), arguments.friction
    stroke = stroke_to(simulator, _body(arguments, simulator), aim, -direction, arguments.depth, turn, slide, friction)
    touched = int(stroke.indenter.distance(membrane.rest).argmin())
    if float(membrane.rest_normals[touched] @ torch.from_numpy(stroke.travel)) > OUTWARDS:
        raise MembraneError(
            f"--direction {_listed(arguments.direction)}: the indenter would push the membrane from within; expected X,Y,Z "
            "that points from the membrane to the indenter outside it, such as 0,0,1"
        )
    return stroke


def _body(arguments: Namespace, simulator: Simulator) -> Indenter:
    kind = arguments.indenter
    if kind == "sphere":
        return Sphere(_needed(arguments, "radius"))
    if kind == "plane":
        return Plane()
    if kind == "cylinder":
        return Cylinder(_needed(arguments, "radius"))
    if kind == "wedge":
        return Wedge(_needed(arguments, "opening"), _needed(arguments, "radius"))
    if kind == "box":
        return Box(torch.tensor(_needed(arguments, "sides"), dtype=torch.float64, device="cpu"), _needed(arguments, "radius"))
    if not Path(kind).is_file():
        raise MembraneError(f"--indenter {kind!r}: neither a file nor one of {', '.join(KINDS)}")
    mesh = MeshIndenter.read(kind)
    size, side = simulator.membrane.size, float(np.ptp(mesh.vertices, 0).max())
    least, most = (share * size for share in LENGTHS["sides"])
    if not least <= side <= most:
        unit = simulator.sensor.length_unit
        expected = f"{least:.3g} to {most:.3g} {unit}, as the surface's size is {size:.3g} {unit}: give the mesh in {unit}"
        raise MembraneError(f"--indenter {kind}: its longest side is {side:.4g}; expected {expected}")
    return mesh


def _listed(values: Iterable[float]) -> str:
    return ",".join(f"{value:g}" for value in values)


def _needed(arguments: Namespace, name: str) -> Any:
    value = getattr(arguments, name)
    if value is None:
        raise MembraneError(f"--indenter {arguments.indenter} needs --{name}")
    return value
