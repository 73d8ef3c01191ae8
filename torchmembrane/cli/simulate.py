"""`torchmembrane simulate`: presses on a sensor's membrane as images with their truth."""

import argparse
import os
from contextlib import nullcontext
from itertools import chain
from pathlib import Path

import numpy as np
import torch
from tqdm import tqdm

from ..errors import MembraneError
from ..presets import NAMES, sensor_file
from ..sensor.model import Sensor
from ..simulate.appearance import Appearance
from ..simulate.dataset import KINDS, Plan, make_frames, stroke_to
from ..simulate.frames import FORMATS, Video, open_frames
from ..simulate.indenters import Box, Cylinder, Indenter, Plane, Sphere, Wedge
from ..simulate.mesh_indenter import MeshIndenter
from ..simulate.simulator import LEGS, Simulator, Stroke

EXAMPLES = f"""\
examples:
  torchmembrane simulate preset:fingertip --indenter sphere --radius 4 --depth 2 --direction 0.5,0,0.87 --out press
  torchmembrane simulate preset:bubble --indenter box --sides 20,20,8 --radius 2 --depth 4 --turn 30 --noise 40 --out press
  torchmembrane simulate preset:fingertip --indenter part.stl --depth 2 --out press
  torchmembrane simulate preset:fingertip --indenter sphere --radius 4 --depth 2 --friction 0.5 --slide 0,1,0 \\
      --path push,slide,release --frames 10 --video --out press
  torchmembrane simulate sensor.toml --random 1000 --seed 1 --jobs 8 --format parquet --out data

SENSOR.toml may be preset:NAME, one of {", ".join(NAMES)}. Lengths are in the sensor's unit, in the camera's frame: +z
points from the camera to the membrane. A value that begins with a minus needs =, as in --direction=-0.5,0,0.87.

DIR then holds
  sensor.toml       the sensor as simulated, its rest image in the same light: torchmembrane reconstruct DIR/sensor.toml ...
  NAME.png          the image (with --path NAME_000000.png ..., with --video NAME.mp4)
  NAME_truth.npz    surface, dots, forces, pressure (torchmembrane.simulate.simulator.Simulator.frame lists them)
  sSEED_000000.png ...  and their truths with --random; the same command again goes on after an interruption
                    (parquet: frames/part-*.parquet, rest_truth.npz)

exit code: 0 all well, 1 some presses of a data set failed, 2 wrong usage, or a press that cannot be"""


def add_simulate(commands, command) -> None:
    """Add the command's parser; `command` is `cli._command`."""
    add = command(commands, "simulate", simulate, "press a sensor's membrane and render its image, with the truth", EXAMPLES)
    add("sensor", metavar="SENSOR.toml", help="the sensor file, or preset:NAME")
    add(
        "--out", metavar="DIR", type=Path, required=True, help="folder of the frames: new, or of the same sensor and appearance"
    )
    add("--name", default="press", help="of a single press' files (default: %(default)s)")
    kinds = f"{', '.join(KINDS)}, or a closed mesh that presses along its +z (STL, OBJ, PLY); with --random several, a,b,c"
    add("--indenter", metavar="KIND", help=kinds)
    add("--radius", metavar="R", type=_length, help="of a sphere or cylinder; of the edges' rounding of a wedge or box")
    add("--sides", metavar="X,Y,Z", type=_vector, help="of a box; it presses along Z")
    add("--opening", metavar="DEGREES", type=_length, help="of a wedge")
    add("--depth", metavar="D", type=_length, help="how far it moves from its first touch")
    direction = "the side that it comes from, seen from the point it aims at (default: %(default)s, straight at the camera)"
    add("--direction", metavar="X,Y,Z", type=_vector, default="0,0,1", help=direction)
    add("--aim", metavar="X,Y,Z", type=_vector, help="the point it moves to (default: the middle of the rim)")
    add("--turn", metavar="DEGREES", type=float, default=0.0, help="about its direction (default: %(default)s)")
    add("--friction", metavar="MU", type=_positive_or_0, default=0.0, help="Coulomb's coefficient (default: %(default)s)")
    add("--slide", metavar="X,Y,Z", type=_vector, help="how it moves after the push")
    add("--path", metavar="LEGS", type=_legs, help=f"all frames along a path, of {', '.join(LEGS)}, as in push,slide,release")
    add("--frames", metavar="N", type=_count, default=10, help="frames on each leg of --path (default: %(default)s)")
    add("--video", action="store_true", help="--path as NAME.mp4 instead of images")
    add("--random", metavar="N", type=_count, help="a data set of N random presses")
    add("--seed", type=_seed, default=0, help="of presses and noise (default: %(default)s)")
    add("--jobs", metavar="J", type=_count, default=os.cpu_count(), help="processes of --random (default: all cores)")
    add("--format", choices=FORMATS, default=FORMATS[0], help="of --random: png and npz files, or a Parquet data set")
    add("--noise", metavar="DB", type=float, help="white over the noise's standard deviation (default: no noise)")
    highlight, blur = (
        "specular over diffuse light (default: %(default)s)",
        "defocus, standard deviation (default: %(default)s)",
    )
    add("--highlight", metavar="SHARE", type=_positive_or_0, default=Appearance.highlight, help=highlight)
    add("--blur", metavar="PX", type=_positive_or_0, default=Appearance.blur, help=blur)
    add("--dots", metavar="SMALL,LARGE", type=_pair, help="their radii (default: 0.16 and 0.27 of their spacing)")
    add("--missing", metavar="I,J", type=_numbers, default=(), help="dots that are not painted, from 0")
    add("--grid", metavar="M,N", type=_grid, help="of the equilibrium (default: 38 a side, or finer than the sensor's)")
    add("--increment", metavar="D", type=_length, help="longest motion in one step (default: from the size)")


def simulate(arguments) -> int:
    """`torchmembrane simulate`"""
    torch.set_num_threads(1)
    _check_options(arguments)
    sensor = Sensor.from_file(sensor_file(arguments.sensor))
    appearance = Appearance(noise=arguments.noise, highlight=arguments.highlight, blur=arguments.blur)
    simulator = Simulator(sensor, arguments.grid, appearance, arguments.dots, arguments.missing)
    return (_random if arguments.random else _single)(arguments, simulator)


def _random(arguments, simulator: Simulator) -> int:
    kinds = arguments.indenter.split(",") if arguments.indenter else KINDS
    if unknown := [kind for kind in kinds if kind not in KINDS]:
        raise MembraneError(f"--indenter {unknown[0]}: no random indenter; expected some of {', '.join(KINDS)}")
    plan = Plan(kinds, arguments.friction, arguments.seed, arguments.increment)
    shared = {"kinds": list(kinds), "friction": plan.friction, "increment": plan.increment}
    frames = open_frames(arguments.out, simulator, shared, arguments.format)
    outcome = make_frames(simulator, plan, arguments.random, frames, arguments.jobs)
    print(f"presses: {outcome.made} made, {outcome.failed} failed, {outcome.skipped} there before; in {arguments.out}")
    return 1 if outcome.failed else 0


def _single(arguments, simulator: Simulator) -> int:
    stroke = _stroke(arguments, simulator)
    if arguments.path:
        return _film(arguments, simulator, stroke)
    legs = ("push",) if arguments.slide is None else ("push", "slide")
    *_, state = simulator.presses(stroke, legs, increment=arguments.increment)
    frame = simulator.frame(state, stroke, np.random.default_rng(arguments.seed))
    open_frames(arguments.out, simulator, {}).write(arguments.name, frame)
    force, touching = float(state.force.norm()), int(state.contact.sum())
    print(
        f"{arguments.out / arguments.name}.png: force {force:.4g} {simulator.sensor.force_unit}, pressure change "
        f"{state.pressure - state.rest_pressure:.4g}, {touching} of {len(state.contact)} vertices in contact"
    )
    return 0


def _film(arguments, simulator: Simulator, stroke: Stroke) -> int:
    rng, total = np.random.default_rng(arguments.seed), len(arguments.path) * arguments.frames
    states = simulator.presses(stroke, arguments.path, arguments.frames, arguments.increment)
    states = chain([next(states)], states)  # a press that cannot begin leaves no folder
    frames = open_frames(arguments.out, simulator, {})
    video = Video(arguments.out / f"{arguments.name}.mp4") if arguments.video else nullcontext()
    with video:
        for number, state in enumerate(tqdm(states, total=total, desc="simulate", unit="frame")):
            name, frame = f"{arguments.name}_{number:06d}", simulator.frame(state, stroke, rng)
            if arguments.video:
                video.add(frame.image)
                frames.write_truth(name, frame)
            else:
                frames.write(name, frame)
    print(f"{total} frames in {arguments.out}")
    return 0


def _stroke(arguments, simulator: Simulator) -> Stroke:
    membrane = simulator.membrane
    aim = membrane.rest[membrane.fixed].mean(0).numpy() if arguments.aim is None else arguments.aim
    if not np.linalg.norm(arguments.direction) > 0:
        raise MembraneError("--direction: has no length; expected X,Y,Z, the side from which the indenter comes")
    slide = np.zeros(3) if arguments.slide is None else arguments.slide
    turn, friction = np.deg2rad(arguments.turn), arguments.friction
    return stroke_to(simulator, _body(arguments), aim, -arguments.direction, arguments.depth, turn, slide, friction)


def _body(arguments) -> Indenter:
    kind, needs = arguments.indenter, lambda *names: [_needed(arguments, name) for name in names]
    if kind == "sphere":
        return Sphere(*needs("radius"))
    if kind == "plane":
        return Plane()
    if kind == "cylinder":
        return Cylinder(*needs("radius"))
    if kind == "wedge":
        return Wedge(*needs("opening", "radius"))
    if kind == "box":
        return Box(*needs("sides", "radius"))
    if not Path(kind).is_file():
        raise MembraneError(f"--indenter {kind!r}: neither a file nor one of {', '.join(KINDS)}")
    return MeshIndenter.read(kind)


def _needed(arguments, name: str):
    value = getattr(arguments, name)
    if value is None:
        raise MembraneError(f"--indenter {arguments.indenter} needs --{name}")
    return value


def _check_options(arguments) -> None:
    """Refuse what would be passed over in silence."""
    given = lambda *names: [name for name in names if getattr(arguments, name) is not None]  # noqa: E731
    if arguments.random:
        if extra := given("depth", "slide", "path", "aim", "radius", "sides", "opening"):
            raise MembraneError(f"--{extra[0]} does not go with --random, whose presses are drawn")
        return
    if missing := {"indenter", "depth"} - set(given("indenter", "depth")):
        raise MembraneError(f"--{sorted(missing)[0]} is missing; expected a press, as --indenter sphere --radius 4 --depth 2")
    if arguments.format != FORMATS[0]:
        raise MembraneError(f"--format {arguments.format} goes with --random only")
    if arguments.video and not arguments.path:
        raise MembraneError("--video needs a --path, as push,slide,release")
    if arguments.path and "slide" in arguments.path and arguments.slide is None:
        raise MembraneError(f"--path {','.join(arguments.path)} needs --slide X,Y,Z")


def _vector(text: str) -> np.ndarray:
    return np.array(_values(text, float, 3, "three numbers X,Y,Z"))


def _pair(text: str) -> list[float]:
    return _values(text, _length, 2, "two radii, SMALL,LARGE")


def _grid(text: str) -> list[int]:
    return _values(text, _count, 2, "two counts of vertices, M,N")


def _numbers(text: str) -> list[int]:
    return _values(text, int, None, "numbers of dots, as 0,17,18")


def _legs(text: str) -> list[str]:
    legs = text.split(",")
    if not set(legs) <= set(LEGS):
        raise argparse.ArgumentTypeError(f"{text!r}; expected legs of {', '.join(LEGS)}, as push,slide,release")
    return legs


def _length(text: str) -> float:
    (value,) = _values(text, float, 1, "a positive number")
    if not value > 0:
        raise argparse.ArgumentTypeError(f"{text!r}; expected a positive number")
    return value


def _positive_or_0(text: str) -> float:
    (value,) = _values(text, float, 1, "a number, 0 or more")
    if value < 0:
        raise argparse.ArgumentTypeError(f"{text!r}; expected a number, 0 or more")
    return value


def _seed(text: str) -> int:
    return 0 if text == "0" else _count(text)


def _count(text: str) -> int:
    if not text.isdigit() or int(text) < 1:
        raise argparse.ArgumentTypeError(f"{text!r}; expected a whole number, 1 or more")
    return int(text)


def _values(text: str, kind, count: int | None, expected: str) -> list:
    try:
        values = [kind(part) for part in text.split(",")]
    except (ValueError, argparse.ArgumentTypeError):
        values = []
    if not values or not np.isfinite(values).all() or (count and len(values) != count):
        raise argparse.ArgumentTypeError(f"{text!r}; expected {expected}")
    return values
