"""`torchmembrane calibrate`: sensor files from images, and the layout of dots to fabricate from a pattern in the image.

Here are the steps' parsers; what a step does is in the module that its entry in `STEPS` names, loaded when it runs.
"""

from argparse import Namespace, RawDescriptionHelpFormatter
from collections.abc import Callable
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import Any, NamedTuple

from ..arguments import Add, add_command, add_force, count_pair, number_from, positive, pressure, weight
from ..choices import HEIGHT_ERROR, MOST_HEIGHT_ERROR, PORTS
from ..progress import announce

PURPOSE = "find lens, ports, rest surface and dots from images; make a layout of dots"
CONTENT = """
SENSOR.toml holds the design; it may be preset:NAME. DIR then holds
  sensor.toml    the sensor as calibrated, with its files
  report.json    what was found, standard deviations, correlations
  report.png     residuals and what goes with them"""
ORDER = """\
A sensor is calibrated in this order, each step starting from the sensor file of the one before:
  camera     lens, from a checkerboard in air, ports not mounted
  ports      distance, thickness and index of flat layers, from a board of dots, in air and in the medium
  rest       where the rest surface stands, and its dots, from the rest image, when the dots are listed; and
             where further views stand
  views      the same from several views, when they are not
  depth      the same from a depth image
  material   prestretch from images of presses; stiffness, where forces, or pressures in the cavity, of some are known
and the other way round:
  layout     from the dots wanted in the image to positions on the rest surface, to fabricate them"""


def add_parser(commands: Any) -> None:
    """Add the command's parser with its steps."""
    parser = commands.add_parser(
        "calibrate",
        help=PURPOSE,
        description="Calibrate a sensor (section 5.2 of the paper).",
        epilog=ORDER,
        formatter_class=RawDescriptionHelpFormatter,
    )
    steps = parser.add_subparsers(title="steps", metavar="STEP", required=True)
    for name, step in STEPS.items():
        example = f"example:\n  torchmembrane calibrate {name} {step.example}\n{CONTENT}"
        add = add_command(steps, name, partial(_run, step.module, name), step.purpose, example, *step.aliases)
        add("sensor", metavar="SENSOR.toml", help="the design, or the sensor file of the step before")
        step.add_options(add)
        add(
            "--out",
            metavar="DIR",
            type=Path,
            required=True,
            help="folder for the calibrated sensor; not that of SENSOR.toml",
        )
        add_force(add)


def _run(module: str, step: str, arguments: Namespace) -> int:
    announce(f"calibrate {step}")
    from .files import spare_files

    spare_files(step, arguments)
    arguments.step = step
    return int(getattr(import_module(f".{module}", __name__), step)(arguments))


def _view_option(add: Add, whose: str) -> None:
    add("--view", metavar="NAME", help=f"of a sensor with several views, the one {whose}")


def _camera_options(add: Add) -> None:
    corners = count_pair("two counts, COLUMNS,ROWS")
    add("images", metavar="IMAGES", nargs="+", help="images of the checkerboard in different poses, filling the image")
    add("--corners", metavar="COLUMNS,ROWS", type=corners, required=True, help="inner corners of the checkerboard")
    add("--square", metavar="LENGTH", type=positive, required=True, help="side of its squares, in the sensor's unit")
    _view_option(add, "whose lens is to be found, by its images of the checkerboard")


def _ports_options(add: Add) -> None:
    add("--air", metavar="IMAGES", nargs="+", default=[], help="images of the board of dots through the ports, before filling")
    add("--medium", metavar="IMAGES", nargs="+", default=[], help="images of the same board in the medium")
    add("--dots", metavar="COLUMNS,ROWS", type=count_pair("two counts, COLUMNS,ROWS"), required=True, help="dots of the board")
    add("--pitch", metavar="LENGTH", type=positive, required=True, help="pitch of its dots, in the sensor's unit")
    add(
        "--radius",
        metavar="LENGTH",
        type=positive,
        help="radius of dots (default: 0.22 pitches; the three marks: 1.7 times that)",
    )
    add("--held", metavar="NAME", nargs="+", choices=PORTS, default=[], help=f"taken as known: {', '.join(PORTS)}")
    _view_option(add, "through whose ports the images were taken")


def _rest_options(add: Add) -> None:
    at_rest = "image of the membrane at rest; of several views the first one's, NAME_VIEW, or the image whose regions they are"
    add("image", metavar="REST.png", help=at_rest)
    gauge = "of an inflated surface: what a gauge reads at rest, inside over outside, with its unit, as 12hPa"
    add("--overpressure", metavar="P", type=pressure, help=gauge)


def _views_options(add: Add) -> None:
    add(
        "images",
        metavar="IMAGES",
        nargs="+",
        help="images of the membrane at rest; the first by the camera as it is in the sensor; of a sensor with several views "
        "one of each, NAME_VIEW, or the image whose regions they are",
    )
    where = "CSV x,y,z,turn_x,turn_y,turn_z: where the camera was for each image, roughly, in its first frame; degrees"
    where += "; not for a sensor with several views, in whose file the poses are"
    add("--motions", metavar="FILE.csv", type=Path, help=where)
    scale = "standard deviation of the second camera's distance from the first, which sets the scale, in the sensor's unit"
    scale += " (default: 0.01 mm)"
    add("--travel-error", metavar="LENGTH", type=positive, help=scale)


def _depth_options(add: Add) -> None:
    where = ".npy, TIFF or 16-bit PNG, registered to the camera: z along the axis; 0, NaN or infinite where there is none"
    add("depth", metavar="DEPTH", type=Path, help=where)
    step = "of one step of its values, in the sensor's unit (default: of images of 16 bits 1 mm, else that unit)"
    add("--unit", metavar="LENGTH", type=positive, help=step)
    at_rest = "the membrane at rest, to find the dots in; of several views the first one's, NAME_VIEW, or the shared image"
    add("--image", metavar="REST.png", required=True, help=at_rest)
    _view_option(add, "to whose camera the depth image is registered")


def _material_options(add: Add) -> None:
    add("images", metavar="IMAGES", nargs="+", help="images of deep presses: files, globs, folders")
    vectors, lengths = "CSV image,fx,fy,fz (on the membrane, in the camera's frame)", "image,force (magnitude)"
    table = f"{vectors} or {lengths}, N: total force in some images; each with a further column deviation or without"
    add("--forces", metavar="FILE.csv", type=Path, help=table)
    gauge = (
        "a gauge's log, CSV: name or time of an image, and pressure (at rest and pressed) or pressure_change (since rest), hPa"
    )
    add("--pressure", metavar="FILE.csv", type=Path, help=gauge)
    at_rest = "what a gauge reads at rest, inside over outside, with its unit, as 12hPa; goes with the others"
    add("--overpressure", metavar="P", type=pressure, help=at_rest)
    sure = "standard deviation of the rest surface's height over its rim, relative (default: %(default)s)"
    add("--rest-error", metavar="SHARE", type=number_from(1e-3, MOST_HEIGHT_ERROR), default=HEIGHT_ERROR, help=sure)
    lies = "that lies on the membrane, alone, in every image that --forces does not list, as 200g or 1.96N"
    add("--weight", metavar="WEIGHT", type=weight, help=lies)


def _layout_options(add: Add) -> None:
    add("--pixels", metavar="FILE.csv", type=Path, help="the wanted dots: u,v,size (small | large)")
    add("--pitch", metavar="PX", type=positive, help="a square lattice of this pitch within the rim's outline")


class Step(NamedTuple):
    """A step of calibration: the module that has a function of its name, its parser's texts, options and other names."""

    module: str
    purpose: str
    add_options: Callable[[Add], None]
    example: str
    aliases: tuple[str, ...] = ()


STEPS = {
    "camera": Step(
        "camera",
        "find the lens from images of a checkerboard",
        _camera_options,
        "design.toml board/*.png --corners 11,8 --square 2.5 --out lens",
    ),
    "ports": Step(
        "camera",
        "find the flat layers from images of a board of dots through them",
        _ports_options,
        "lens/sensor.toml --air dry/ --medium wet/ --dots 17,13 --pitch 2 --out ports",
    ),
    "rest": Step(
        "surface",
        "find the rest surface's pose and its dots from a rest image of listed dots; of several views their poses, too",
        _rest_options,
        "ports/sensor.toml rest.png --out rest",
    ),
    "views": Step(
        "surface",
        "find dots and rest surface from several views",
        _views_options,
        "ports/sensor.toml first.png second.png third.png --motions motions.csv --out rest",
    ),
    "depth": Step(
        "surface",
        "find rest surface and dots from a depth image",
        _depth_options,
        "sensor.toml depth.npy --image rest.png --out rest",
    ),
    "material": Step(
        "material",
        "find prestretch and stiffness from images of presses",
        _material_options,
        "rest/sensor.toml press/*.png --forces forces.csv --out material",
    ),
    "layout": Step(
        "layout",
        "turn dots wanted in the image into positions on the rest surface",
        _layout_options,
        "design.toml --pitch 30 --out layout",
        ("pattern",),
    ),
}
