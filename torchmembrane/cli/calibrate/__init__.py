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
SENSOR.toml may be preset:NAME. DIR then holds
"""
CALIBRATED = """\
  sensor.toml    the calibrated sensor, with its files
  report.json    the values found, their standard deviations and correlations
  report.png     a figure of the fit, with its residuals"""
LAID_OUT = """\
  sensor.toml    the sensor with these dots, with its files
  layout.csv     the dots, for fabrication
  layout.svg     the layout, for viewing
  report.png     a figure of the layout"""
ORDER = """\
A sensor is calibrated in this order, each step starting from the sensor file of the one before:
  camera     finds the lens, from a checkerboard in air, before windows are mounted
  ports      if the camera looks through flat windows (ports): finds their distance, thickness and refractive index, from a
             board of dots, in air and in the medium
then exactly one of
  rest       finds the pose of the rest surface, its dots, and the poses of further views, from the rest image, if the
             dots are listed
  views      finds rest surface and dots from several views, if the dots are not listed
  depth      finds rest surface and dots from a depth image, if the dots are not listed
and at last
  material   finds the prestretch from images of presses, and the stiffness if forces or pressures of some are known
One further step goes in the opposite direction; it is used before the membrane is made:
  layout     computes positions on the rest surface, for fabrication, from the dots wanted in the image"""


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
        example += LAID_OUT if name == "layout" else CALIBRATED
        add = add_command(steps, name, partial(_run, step.module, name), step.purpose, example, *step.aliases)
        add("sensor", metavar="SENSOR.toml", help="sensor file of the design, as from init, or of the preceding step")
        step.add_options(add)
        add(
            "--out",
            metavar="DIR",
            type=Path,
            required=True,
            help="folder for the calibrated sensor; not the folder of SENSOR.toml",
        )
        add_force(add)


def _run(module: str, step: str, arguments: Namespace) -> int:
    announce(f"calibrate {step}")
    from .files import spare_files

    spare_files(step, arguments)
    arguments.step = step
    return int(getattr(import_module(f".{module}", __name__), step)(arguments))


def _view_option(add: Add, whose: str) -> None:
    add("--view", metavar="NAME", help=f"for a sensor with several views: the view {whose}")


def _camera_options(add: Add) -> None:
    corners = count_pair("two counts, COLUMNS,ROWS")
    add("images", metavar="IMAGES", nargs="+", help="images of the checkerboard in different poses; it should fill the image")
    add("--corners", metavar="COLUMNS,ROWS", type=corners, required=True, help="inner corners of the checkerboard")
    add("--square", metavar="LENGTH", type=positive, required=True, help="side of its squares, in the sensor's unit")
    _view_option(add, "whose lens is to be found, from its images of the checkerboard")


def _ports_options(add: Add) -> None:
    add("--air", metavar="IMAGES", nargs="+", default=[], help="images of the board of dots through the ports, before filling")
    add("--medium", metavar="IMAGES", nargs="+", default=[], help="images of the same board in the medium")
    add(
        "--dots",
        metavar="COLUMNS,ROWS",
        type=count_pair("two counts, COLUMNS,ROWS"),
        required=True,
        help="number of dots of the board",
    )
    add("--pitch", metavar="LENGTH", type=positive, required=True, help="pitch of its dots, in the sensor's unit")
    add(
        "--radius",
        metavar="LENGTH",
        type=positive,
        help="radius of the dots (default: 0.22 pitches); that of the three large ones is 1.7 times as large",
    )
    add(
        "--held",
        metavar="NAME",
        nargs="+",
        choices=PORTS,
        default=[],
        help="values of the sensor file that are known and stay as they are",
    )
    _view_option(add, "through whose ports the images were taken")


def _rest_options(add: Add) -> None:
    at_rest = (
        "image of the membrane at rest; for a sensor with several views, the first view's image, NAME_VIEW.png, with the "
        "others beside it, or the image that contains all views as regions"
    )
    add("image", metavar="REST.png", help=at_rest)
    gauge = "for an inflated surface: reading of a gauge at rest, inside minus outside, with its unit, as 12hPa"
    add("--overpressure", metavar="P", type=pressure, help=gauge)


def _views_options(add: Add) -> None:
    add(
        "images",
        metavar="IMAGES",
        nargs="+",
        help="images of the membrane at rest; the first with the camera in its place in the sensor; for a sensor with several "
        "views, one image of each, NAME_VIEW.png, or the image that contains all views as regions",
    )
    where = (
        "CSV x,y,z,turn_x,turn_y,turn_z: approximate pose of the camera for each image, relative to that of the first image; "
        "rotation in degrees; not for a sensor with several views, whose file contains the poses"
    )
    add("--motions", metavar="FILE.csv", type=Path, help=where)
    scale = "standard deviation of the second camera's distance from the first, which sets the scale, in the sensor's unit"
    scale += " (default: 0.01 mm)"
    add("--travel-error", metavar="LENGTH", type=positive, help=scale)


def _depth_options(add: Add) -> None:
    where = (
        "depth image registered to the camera, .npy, TIFF or 16-bit PNG: z along the axis; 0, NaN or infinite where "
        "there is no depth"
    )
    add("depth", metavar="DEPTH", type=Path, help=where)
    step = "unit of the depth values, in the sensor's unit (default: 1 mm for 16-bit images, else the sensor's unit)"
    add("--unit", metavar="LENGTH", type=positive, help=step)
    at_rest = (
        "image of the membrane at rest, in which the dots are found; for a sensor with several views, the first view's image, "
        "NAME_VIEW.png, or the image that contains all views as regions"
    )
    add("--image", metavar="REST.png", required=True, help=at_rest)
    _view_option(add, "to whose camera the depth image is registered")


def _material_options(add: Add) -> None:
    add(
        "images",
        metavar="IMAGES",
        nargs="+",
        help="images of presses or of the known weight, with --pressure also one at rest",
    )
    vectors, lengths = "CSV image,fx,fy,fz (on the membrane, in the camera's frame)", "image,force (magnitude)"
    table = (
        f"{vectors} or {lengths}, N: total force in some of the images; a column deviation with their standard "
        "deviations may follow"
    )
    add("--forces", metavar="FILE.csv", type=Path, help=table)
    gauge = (
        "a gauge's log, CSV: name or time of an image, and pressure (at rest and pressed) or pressure_change (since rest), hPa"
    )
    add("--pressure", metavar="FILE.csv", type=Path, help=gauge)
    at_rest = "reading of a gauge at rest, inside minus outside, with its unit, as 12hPa; can be combined with the others"
    add("--overpressure", metavar="P", type=pressure, help=at_rest)
    sure = "relative standard deviation of the rest surface's height over its rim (default: %(default)s)"
    add("--rest-error", metavar="SHARE", type=number_from(1e-3, MOST_HEIGHT_ERROR), default=HEIGHT_ERROR, help=sure)
    lies = "weight that lies alone on the membrane in every image that --forces does not list, as 200g or 1.96N"
    add("--weight", metavar="WEIGHT", type=weight, help=lies)


def _layout_options(add: Add) -> None:
    add("--pixels", metavar="FILE.csv", type=Path, help="CSV of the wanted dots: u,v,size (small | large)")
    add("--pitch", metavar="PX", type=positive, help="use a square lattice of this pitch within the rim's outline instead")


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
        "find the rest surface's pose, its dots, and the poses of further views from a rest image of listed dots",
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
