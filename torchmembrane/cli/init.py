"""`torchmembrane init`: write a commented sensor file from a few numbers, given as options or entered when asked."""

import sys
from argparse import ArgumentTypeError, Namespace
from collections.abc import Callable
from pathlib import Path
from typing import Any

from ..errors import MembraneError
from .arguments import Add, add_command, add_force, count, count_pair, number_from, positive, positive_pair, pressure, vector
from .choices import DRAFTS, FARTHEST, FILLINGS, FROM_IMAGE, LENGTH_UNITS, LENSES, LONGEST_SIDE, OUTLINE, POLARITIES

PURPOSE = "write a sensor file, with a comment on every key, from a few numbers"
EXAMPLES = """\
examples:
  torchmembrane init sensor.toml --shape dome --radius 12 --distance 15 --image-size 640,480 --view 120 --lens fisheye
  torchmembrane init sensor.toml --shape bubble --radius 30 --height 18 --distance 60 --rest rest.png --focal 440 \\
      --overpressure 71hPa --shear-modulus 0.3 --thickness 0.3
  torchmembrane init sensor.toml --shape dome --radius 12 --rest rest.png --rim 322,239,210 --focal 385 --lens fisheye
  torchmembrane init sensor.toml --shape dome --radius 12 --rest rest.png --rim auto --view 120 --lens fisheye
  torchmembrane init window.toml --shape rectangle --size 50,36 --corner 4 --height 6 --overpressure 12hPa --prestretch 1.1 \\
      --thickness 0.2 --distance 40 --rest rest.png --focal 620
  torchmembrane init window.toml --outline rim.csv --height 6 --distance 40 --rest rest.png --focal 620
  torchmembrane init pair.toml --shape cap --radius 12 --height 6 --distance 40 --rest rest_left.png --focal 800 \\
      --dots dots.csv --views left right=25,0,5
  torchmembrane init sensor.toml            # asks for the numbers, on a terminal

The command needs the shape and its lengths, the size of the image (--image-size or --rest), the focal length (--focal or
--view) and the distance of the rim from the camera (--distance). For a dome, cap or bubble with --rest, the rim's circle in
the image (--rim) replaces either the distance or the focal length. On a terminal, the command asks for missing numbers. The
camera looks along the membrane's axis. In the file's frame, the origin is the camera's centre of projection, and +z points
to the membrane. The dots are given as a list (--dots) or found in the rest image (--rest). With neither, the file gets
a pattern of dots with the spacing --pitch.

The list of dots is a CSV file with one of the headers
  x,y,z          in the camera's frame        x,y,h           h is the height above the rim's plane
  x,y            seen from above              angle,azimuth   degrees from the pole, and about the axis from x to y
  u,v            px in the rest image
and, if you like, a further column size, which is small or large.

rectangle, ellipse and --outline are sheets that are stretched in a rim and inflated. Their shape is an equilibrium: it is
solved from the rim, the prestretch, and --height or --overpressure or both. rim.csv contains points once around the rim: x,y
from its middle, or x,y,z in the camera's frame, then without --distance. For such a sheet, any three of height, overpressure,
prestretch and shear modulus x thickness give the fourth. For the other shapes, any two of overpressure, prestretch and shear
modulus x thickness give the third. If all are given and they contradict one another, the command says so.

For several views (--views), --rest is the image of the first view, NAME_VIEW.png. The images of the other views lie beside it.
The pose of each camera then follows from the dots in its image.

The files that belong to SENSOR.toml are written beside it. Next, run torchmembrane check SENSOR.toml --out sensor.png

exit code: 0 written, 2 wrong usage"""
ARRAYS = ("heightfield", "grid")
"""Shape names in the sensor file for other surfaces, which are given as arrays."""


def _shape(text: str) -> str:
    if text in DRAFTS:
        return text
    from ..sensor.suggestions import did_you_mean

    of_arrays = f"any other surface goes into the file as arrays: shape = {' or '.join(map(repr, ARRAYS))}, with file"
    meant = did_you_mean(text, (*DRAFTS, *ARRAYS))
    remedy = of_arrays if not meant or any(repr(shape) in meant for shape in ARRAYS) else meant
    raise ArgumentTypeError(f"{text!r}; expected one of {', '.join(DRAFTS)}; {remedy}")


def _length(text: str) -> tuple[float, str | None]:
    """Return a positive length, and its unit if one follows the number."""
    unit = next((unit for unit in sorted(LENGTH_UNITS, key=len, reverse=True) if text.endswith(unit)), None)
    return positive(text.removesuffix(unit or "")), unit


_distance = number_from(-FARTHEST, FARTHEST)

QUESTIONS = {
    "shape": (f"shape, {' | '.join(DRAFTS)}", _shape),
    "radius": ("radius of the dome, of the cap's rim, or of the cylinder", positive),
    "height": ("height of the cap, or of the inflated sheet, over its rim", _length),
    "size": ("size A,B of the rim along x and y", positive_pair("two lengths, A,B")),
    "semi_axes": ("half axes A,B,C of the fingertip along x, y, z", vector),
    "length": ("length of the half cylinder", positive),
    "image_size": ("size of the camera's image, WIDTH,HEIGHT, px", count_pair("WIDTH,HEIGHT", LONGEST_SIDE)),
    "view": ("field of view across the image's width, degrees", positive),
    "distance": ("distance from the camera's pinhole to the rim's plane", _distance),
}
"""Questions asked on a terminal, and the types of the answers."""
INSTEAD = {
    "distance": "; or --rim, the rim's circle in the rest image, if it is one, with --view or --focal, which give it",
    "view": "; or --focal, px; or --rim with --distance, which give it, if the rim is a circle",
}


def add_parser(commands: Any) -> None:
    """Add the parser of the command."""
    add = add_command(commands, "init", run, PURPOSE, EXAMPLES)
    add("sensor", metavar="SENSOR.toml", type=Path, help="the file to write")
    add("--name", help="name of the sensor (default: the name of the file)")
    add("--unit", choices=LENGTH_UNITS, default=LENGTH_UNITS[0], help="unit of all lengths (default: %(default)s)")
    add_force(add)
    _add_membrane(add)
    _add_camera(add)
    _add_material(add)
    _add_markers(add)


def _add_membrane(add: Add) -> None:
    add(
        "--shape",
        metavar=f"{{{','.join(DRAFTS)}}}",
        type=_shape,
        help="dome: half a sphere; cap: of a sphere; bubble: a cap filled with gas; fingertip: half an ellipsoid; "
        "half_cylinder; rectangle, ellipse: a sheet inflated in such a rim",
    )
    add(
        "--outline",
        metavar="RIM.csv",
        type=Path,
        help="instead of --shape: a sheet inflated in the closed rim of these points",
    )
    add("--size", metavar="A,B", type=positive_pair("two lengths, A,B"), help="size of the rectangle or ellipse, along x and y")
    add("--corner", metavar="R", type=positive, help="radius of the rectangle's corners (default: 0)")
    add(
        "--radius",
        metavar="R",
        type=positive,
        help="radius of the dome, of the rim of the cap or bubble, or of the half cylinder",
    )
    height = "height of the cap, bubble or inflated sheet above its rim's plane; a unit may follow, as 6mm"
    add("--height", metavar="H", type=_length, help=height)
    add("--semi-axes", metavar="A,B,C", type=vector, help="semi-axes of the fingertip along x, y, z")
    add("--length", metavar="L", type=positive, help="length of the half cylinder, along x")
    add(
        "--half-angle",
        metavar="DEGREES",
        type=positive,
        help="angle from the top of the half cylinder to either side (default: 90)",
    )


def _add_camera(add: Add) -> None:
    depth = (
        "distance of the rim's plane from the camera's centre of projection; 0 or less if a fisheye camera stands "
        "within the membrane"
    )
    add("--distance", metavar="Z", type=_distance, help=depth)
    add("--lens", choices=LENSES, default=LENSES[0], help="model of the lens (default: %(default)s)")
    size = count_pair("two counts, WIDTH,HEIGHT", LONGEST_SIDE)
    add("--image-size", metavar="WIDTH,HEIGHT", type=size, help="size of the image, px (default: that of the rest image)")
    add("--focal", metavar="PX", type=positive, help="focal length, px; for a fisheye lens px / rad")
    add("--view", metavar="DEGREES", type=positive, help="field of view across the image's width, instead of --focal")
    centre = positive_pair("two numbers, U,V")
    add("--centre", metavar="U,V", type=centre, help="principal point, px (default: the rim's centre, else the image's)")
    few = "bits that the camera uses of 16-bit images, as 10 or 12 (default: 16)"
    add("--bits", metavar="N", type=count, help=few)
    further = (
        "name of the first view, and NAME=X,Y,Z for each further camera: roughly where it stands, in the first one's frame"
    )
    same = "it has the same lens, stands upright and looks at the membrane's middle"
    add("--views", metavar="NAME", nargs="+", help=f"{further}; {same}")
    rim = "the rim's circle in the rest image, px, as measured with an image viewer; auto: it is found in the image"
    add("--rim", metavar="U,V,RADIUS|auto", type=_rim, help=rim)


def _add_material(add: Add) -> None:
    add(
        "--filling",
        choices=FILLINGS,
        help="filling of the cavity (default: gas for a bubble or an inflated sheet, else liquid)",
    )
    prestretch = (
        "stretch of the membrane at rest (default: from the overpressure, else 1.2); of a rectangle, ellipse or --outline, "
        "that of the flat sheet before it is inflated (default: from the overpressure, else 1.1)"
    )
    add(
        "--overpressure",
        metavar="P",
        type=pressure,
        help="pressure inside minus outside, at rest, with its unit, as 20hPa, 2kPa, 0.3psi",
    )
    add("--prestretch", metavar="L", type=positive, help=prestretch)
    add("--shear-modulus", metavar="G", type=positive, help="shear modulus, N / length unit^2: a third of Young's modulus")
    add(
        "--thickness",
        metavar="T",
        type=positive,
        help="thickness of the membrane at rest (of a rectangle, ellipse or --outline, before the sheet is inflated): "
        "unstretched thickness / prestretch^2",
    )


def _add_markers(add: Add) -> None:
    add("--rest", metavar="REST.png", help="image of the membrane at rest; without --dots, the dots are found in it")
    add("--dots", metavar="FILE.csv", type=Path, help="list of dots, in one of the frames below")
    add(
        "--pitch",
        metavar="LENGTH",
        type=positive,
        help="spacing of the pattern of dots, without --rest and --dots (default: a pattern of about 11 x 11)",
    )
    add(
        "--polarity",
        choices=POLARITIES,
        default=POLARITIES[0],
        help="whether dots are darker or lighter than the membrane around them (default: %(default)s)",
    )


def _rim(text: str) -> list[float] | str:
    if text == FROM_IMAGE:
        return text
    u, v, radius = vector(text)
    return [u, v, positive(f"{radius:g}")]


def run(arguments: Namespace) -> int:
    """Write the file; return the exit code."""
    path: Path = arguments.sensor
    if path.suffix != ".toml":
        raise MembraneError(f"init {path}: expected a file that ends with .toml, as sensor.toml")
    from ..files.targets import refuse_overwriting
    from ..sensor.companions import companions_of
    from .draft import in_unit, needed, refuse_foreign, write_draft

    read = [file for file in (arguments.rest, arguments.dots, arguments.outline) if file is not None]
    refuse_overwriting(f"init {path}", companions_of(path), read, arguments.force)
    if arguments.outline is not None:
        if arguments.shape is not None:
            raise MembraneError("init: --outline and --shape; expected only one of them, because both define the rim")
        arguments.shape = OUTLINE
    if arguments.shape is None:
        arguments.shape = _asked("shape", *QUESTIONS["shape"])
    refuse_foreign(arguments)
    for name in needed(arguments):
        setattr(arguments, name, _asked(name, *QUESTIONS[name]))
    if arguments.height is not None:
        arguments.height = in_unit(*arguments.height, wanted=arguments.unit)
    print("\n".join(write_draft(arguments)))
    return 0


def _asked(name: str, question: str, kind: Callable[[str], Any]) -> Any:
    """Return an answer from the terminal; if there is no answer, raise an error that names the missing option."""
    option = f"--{name.replace('_', '-')}"
    if not sys.stdin.isatty():
        raise MembraneError(f"init: {option} is missing; expected the {question}{INSTEAD.get(name, '')}")
    try:
        return kind(input(f"{question}: ").strip())
    except (ArgumentTypeError, EOFError) as error:
        raise MembraneError(f"init: {option} {error or 'without an answer'}") from None
