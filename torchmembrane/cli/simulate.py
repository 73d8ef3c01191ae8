"""`torchmembrane simulate`: simulate presses of a sensor's membrane, with images and ground truth."""

import os
from argparse import Namespace
from pathlib import Path
from typing import Any

from ..errors import MembraneError
from .arguments import (
    Add,
    add_command,
    add_force,
    add_sensor,
    count,
    count_pair,
    file_name,
    number_from,
    numbers,
    positive,
    positive_pair,
    seed,
    some_of,
    vector,
)
from .choices import (
    BLUR,
    HIGHLIGHT,
    INDENTERS,
    LEGS,
    MOST_BLUR,
    MOST_DECIBEL,
    MOST_FRICTION,
    MOST_LINES,
    PRESETS,
    SIMULATION_FORMATS,
)
from .progress import announce

PURPOSE = "simulate presses of a sensor's membrane and render the images, with the ground truth"
EXAMPLES = f"""\
examples:
  torchmembrane simulate preset:fingertip --indenter sphere --radius 4 --depth 2 --direction 0.5,0,0.87 --out press
  torchmembrane simulate preset:bubble --indenter box --sides 20,20,8 --radius 2 --depth 4 --turn 30 --noise 40 --out press
  torchmembrane simulate preset:fingertip --indenter part.stl --depth 2 --out press
  torchmembrane simulate preset:fingertip --indenter sphere --radius 4 --depth 2 --friction 0.5 --slide 0,1,0 \\
      --path push,slide,release --frames 10 --video --out press
  torchmembrane simulate sensor.toml --random 1000 --seed 1 --jobs 8 --format parquet --out data

SENSOR.toml may be preset:NAME, one of {", ".join(PRESETS)}. Lengths are in the sensor's unit, in the camera's frame: +z
points from the camera to the membrane.

A single press needs --indenter and --depth; a sphere or cylinder also needs --radius, a box --sides and --radius, a wedge
--opening and --radius. A path with slide needs --slide. With --random, sizes and motions are drawn at random, and options that
set them are refused.

DIR then holds
  sensor.toml       the simulated sensor and its rest image in the same light: torchmembrane reconstruct DIR/sensor.toml ...
  NAME.png          the image (with --path NAME_000000.png ..., with --video NAME.mp4)
  NAME_truth.npz    surface, dots, forces, pressure (torchmembrane.simulate.simulator.Simulator.frame lists them)
  sSEED_000000.png ...  with --random, and the truth of each (parquet: frames/part-*.parquet, rest_truth.npz)
After an interruption, the same command continues a data set.

exit code: 0 all well, 1 some presses of a data set failed, 2 wrong usage, or a press that cannot be simulated"""


DEFAULTS: dict[str, Any] = {"name": "press", "direction": [0.0, 0.0, 1.0], "turn": 0.0, "frames": 10}
"""Values of options of a single press that are not given."""


def add_parser(commands: Any) -> None:
    """Add the parser of the command."""
    add = add_command(commands, "simulate", run, PURPOSE, EXAMPLES)
    add_sensor(add)
    add(
        "--out",
        metavar="DIR",
        type=Path,
        required=True,
        help="folder of the frames: a new one, or one with the same sensor and appearance",
    )
    add_force(add)
    add("--name", type=file_name, help=f"name of the files of a single press (default: {DEFAULTS['name']})")
    _add_press(add)
    _add_sequence(add)
    _add_appearance(add)


def _add_press(add: Add) -> None:
    kinds = ", ".join(INDENTERS)
    mesh = "or a closed mesh that presses along its +z (STL, OBJ, PLY)"
    add("--indenter", metavar="KIND", help=f"{kinds}, {mesh}; with --random also several, as sphere,box")
    add(
        "--radius", metavar="R", type=positive, help="radius of a sphere or cylinder, or of the rounded edges of a wedge or box"
    )
    add("--sides", metavar="X,Y,Z", type=vector, help="sides of a box; it presses along Z")
    add("--opening", metavar="DEGREES", type=positive, help="opening angle of a wedge")
    add("--depth", metavar="D", type=positive, help="how far the indenter moves from its first touch")
    direction = "vector from --aim to where the indenter starts (default: 0,0,1: it moves towards the camera)"
    add("--direction", metavar="X,Y,Z", type=vector, help=direction)
    add("--aim", metavar="X,Y,Z", type=vector, help="the point to which it moves (default: the middle of the rim)")
    turn = f"rotation about its direction (default: {DEFAULTS['turn']:g})"
    add("--turn", metavar="DEGREES", type=number_from(-360, 360), help=turn)
    friction = number_from(0, MOST_FRICTION)
    add("--friction", metavar="MU", type=friction, default=0.0, help="Coulomb's coefficient of friction (default: %(default)s)")


def _add_sequence(add: Add) -> None:
    add("--slide", metavar="X,Y,Z", type=vector, help="motion of the indenter after the press")
    legs = some_of(LEGS, f"legs of {', '.join(LEGS)}, as push,slide,release")
    add(
        "--path",
        metavar="LEGS",
        type=legs,
        help=f"simulate all frames along a path whose legs are {', '.join(LEGS)}, as push,slide,release",
    )
    add("--frames", metavar="N", type=count, help=f"frames on each leg of --path (default: {DEFAULTS['frames']})")
    add("--video", action="store_true", help="write the frames of --path as NAME.mp4 instead of images (extra video)")
    add("--random", metavar="N", type=count, help="simulate a data set of N random presses")
    add("--seed", type=seed, default=0, help="seed of presses and noise (default: %(default)s)")
    add(
        "--jobs",
        metavar="J",
        type=count,
        default=os.cpu_count(),
        help="number of processes of --random (default: one per core)",
    )
    stored = "format of --random: png and npz files, or a Parquet data set (extra parquet)"
    add("--format", choices=SIMULATION_FORMATS, default=SIMULATION_FORMATS[0], help=stored)
    longest = "longest motion in one step (default: a tenth of the membrane's size, with friction a hundredth)"
    add("--increment", metavar="D", type=positive, help=longest)


def _add_appearance(add: Add) -> None:
    add(
        "--noise",
        metavar="DB",
        type=number_from(0, MOST_DECIBEL),
        help="image noise: white over the noise's standard deviation, dB (default: no noise)",
    )
    highlight = "ratio of specular to diffuse light (default: %(default)s)"
    add("--highlight", metavar="SHARE", type=number_from(0, 1), default=HIGHLIGHT, help=highlight)
    blur = "standard deviation of the blur by defocus (default: %(default)s)"
    add("--blur", metavar="PX", type=number_from(0, MOST_BLUR), default=BLUR, help=blur)
    radii, grid = positive_pair("two radii, SMALL,LARGE"), count_pair("two counts of vertices, M,N", MOST_LINES)
    add(
        "--dots",
        metavar="SMALL,LARGE",
        type=radii,
        help="radii of the dots (default: 0.16 and 0.27 of the spacing)",
    )
    missing = numbers("numbers of dots, as 0,17,18")
    add("--missing", metavar="I,J", type=missing, default=(), help="numbers of dots that are not painted, counted from 0")
    add(
        "--grid",
        metavar="M,N",
        type=grid,
        help="numbers of vertices of the grid on which the equilibrium is solved; it must be finer than the sensor's grid "
        "(default: about 38 per side, more if the sensor's grid is fine)",
    )


def run(arguments: Namespace) -> int:
    """Simulate; return the exit code."""
    _check_options(arguments)
    for name, value in DEFAULTS.items():
        if getattr(arguments, name) is None:
            setattr(arguments, name, value)
    if arguments.random is not None:
        announce("simulate --random")
    from .press import simulate

    return simulate(arguments)


def _check_options(arguments: Namespace) -> None:
    """Refuse options that would otherwise be ignored silently."""

    def given(*names: str) -> list[str]:
        return [name for name in names if getattr(arguments, name) is not None]

    if arguments.name == "sensor_rest":
        raise MembraneError("--name sensor_rest: the sensor's rest image has this name; expected another one")
    if arguments.random:
        of_press = "depth", "slide", "path", "aim", "radius", "sides", "opening", "direction", "turn", "name", "frames"
        if extra := [*given(*of_press), *(["video"] if arguments.video else [])]:
            raise MembraneError(f"--{extra[0]} with --random, which draws the presses itself; expected only one of the two")
        return
    if missing := {"indenter", "depth"} - set(given("indenter", "depth")):
        raise MembraneError(f"--{sorted(missing)[0]} is missing; expected a press, as --indenter sphere --radius 4 --depth 2")
    if arguments.format != SIMULATION_FORMATS[0]:
        raise MembraneError(f"--format {arguments.format} goes with --random only")
    if arguments.video and not arguments.path:
        raise MembraneError("--video without --path; add a path, as --path push,slide,release")
    if arguments.frames is not None and not arguments.path:
        raise MembraneError("--frames without --path; add a path, as --path push,slide,release")
    if arguments.path and "slide" not in arguments.path and arguments.slide is not None:
        raise MembraneError(f"--slide with --path {','.join(arguments.path)}, which has no slide; expected only one of them")
    if arguments.path and "slide" in arguments.path and arguments.slide is None:
        raise MembraneError(f"--path {','.join(arguments.path)} needs --slide X,Y,Z")
