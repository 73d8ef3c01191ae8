"""The work of `torchmembrane init`: from options to a sensor and its commented file."""

from argparse import Namespace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch

from ..calibrate.rim import find_rim
from ..camera.model import Camera
from ..errors import MembraneError
from ..files.images import read_image
from ..markers.dots.pattern import find_dots
from ..markers.placement import FEWEST_MARKERS
from ..markers.spacing import in_view
from ..presets.annotate import annotate
from ..presets.blown_up import BlownUp, Stated, blown_up
from ..presets.design import AIR
from ..presets.dot_list import read_drafted_dots
from ..presets.draft import SHAPES, SHEETS, RimCircle, balanced, drafted_dots, drafted_surface, focal_of_view, overpressure
from ..reconstruct import Reconstructor
from ..sensor.inflated import read_rim
from ..sensor.parts import Cavity, Markers, Surface
from ..sensor.sensor import Sensor
from ..sensor.toml import default_grid
from ..sensor.units import METRE
from .choices import FROM_IMAGE

IN_PLANE = 0.05  # mean z of a rim's points over its extent, up to which they count from its plane
ROUND = 0.95  # shorter over longer half axis of a rim, from which on it is taken for a circle
CIRCULAR = ("dome", "cap", "bubble")  # shapes with a rim that is a circle
LENGTHS = ("radius", "height", "semi_axes", "length", "half_angle", "size", "corner")


class Optics(NamedTuple):
    """The camera, and its distance from the rim's plane; None if the rim is given in the camera's frame."""

    camera: Camera
    distance: float | None


def needed(arguments: Namespace) -> list[str]:
    """Return the names of the required options that are missing."""
    lens = arguments.focal or arguments.view
    wanted = [*SHAPES[arguments.shape]]
    if arguments.rest is None:
        wanted.append("image_size")
    if (arguments.rim is None or not lens) and not _rim_in_space(arguments):
        wanted.append("distance")
    if arguments.rim is None and not lens:
        wanted.append("view")
    if arguments.shape in SHEETS and arguments.overpressure is not None:
        wanted.remove("height")
    return [name for name in wanted if getattr(arguments, name) is None]


def in_unit(length: float, unit: str | None, *, wanted: str) -> float:
    """Convert a length from one unit to another; a length without a unit is already in the wanted unit.

    Example:
        >>> in_unit(0.6, "cm", wanted="mm")
        6.0
    """
    return length if unit is None else float(f"{length * METRE[wanted] / METRE[unit]:.12g}")


def _rim_in_space(arguments: Namespace) -> bool:
    """Return whether the rim file gives z as well; without a distance, its points are in the camera's frame."""
    return arguments.outline is not None and read_rim(arguments.outline).shape[1] == 3


def write_draft(arguments: Namespace) -> list[str]:
    """Write the sensor that the arguments describe; return lines on what was written, assumed and derived."""
    rest = None if arguments.rest is None else read_image(arguments.rest, bits=arguments.bits)
    seen = _rim_in_words(arguments, rest) if arguments.rim == FROM_IMAGE and rest is not None else []
    camera, distance = _optics(arguments, rest)
    lengths = {name: value for name in LENGTHS if (value := getattr(arguments, name)) is not None}
    unit = arguments.unit
    surface: Surface
    if arguments.shape in SHEETS:
        surface, material, inside, said = _sheet(arguments, distance)
        markers = _markers(arguments, rest, surface, camera)
        membrane = surface.membrane(default_grid(markers))
    else:
        assert distance is not None  # as `needed` has asked for it
        surface = drafted_surface(arguments.shape, lengths, distance)
        markers = _markers(arguments, rest, surface, camera)
        membrane, inside = surface.membrane(default_grid(markers)), arguments.overpressure
        material, said = balanced(membrane, unit, inside, arguments.prestretch, arguments.shear_modulus, arguments.thickness)
        if inside is None and material.shear_modulus is not None and material.thickness is not None:
            inside = overpressure(membrane, material, unit)
    filling = arguments.filling or ("gas" if arguments.shape in ("bubble", *SHEETS) else "liquid")
    cavity = Cavity(filling, round(AIR + (inside or 0.0), 2) if filling == "gas" else None)
    sensor = Sensor(arguments.name or arguments.sensor.stem, unit, camera, membrane, material, cavity, markers, surface)
    if arguments.views:
        from .draft_views import with_views

        sensor, places = with_views(sensor, arguments)
        seen += places
    found = _dots_in_words(sensor)
    path = sensor.to_file(arguments.sensor)
    annotate(path, said, sensor.force_unit == "relative", unit)
    return [f"sensor file: {path}", *seen, *found, *said, f"next: torchmembrane check {path} --out {path.with_suffix('.png')}"]


def _sheet(arguments: Namespace, distance: float | None) -> BlownUp:
    """Return the sheet that is inflated in the rim that the arguments describe."""
    rim: dict[str, Any] = {"outline": arguments.shape}
    if arguments.outline is not None:
        rim["outline"] = points = read_rim(arguments.outline)
        if distance is not None and points.shape[1] == 3:
            _refuse_twice(points, distance, arguments.outline)
    else:
        rim |= {key: getattr(arguments, key) for key in ("size", "corner") if getattr(arguments, key) is not None}
    if distance is not None:
        rim["base_z"] = distance
    names = "height", "overpressure", "prestretch", "shear_modulus", "thickness"
    return blown_up(rim, arguments.unit, Stated(*(getattr(arguments, name) for name in names)))


def _refuse_twice(points: np.ndarray, distance: float, path: Path) -> None:
    """Refuse a distance of the rim's plane for points `[N, 3]` that are already at a distance from the camera."""
    away, extent = float(points[:, 2].mean()), float(np.ptp(points[:, :2], axis=0).max())
    if abs(away) > IN_PLANE * extent:
        raise MembraneError(
            f"init: --distance {distance:g}, but the points of {path} lie at z = {away:.4g}; expected either z in the camera's "
            "frame and no --distance, or z about 0, from the rim's plane"
        )


def refuse_foreign(arguments: Namespace) -> None:
    """Refuse lengths that belong to other shapes, and redundant options."""
    more = {"half_cylinder": "half_angle", "rectangle": "corner"}
    allowed = {*SHAPES[arguments.shape], more.get(arguments.shape)}
    for name in LENGTHS:
        if getattr(arguments, name) is not None and name not in allowed:
            expected = ", ".join(f"--{other.replace('_', '-')}" for other in SHAPES[arguments.shape])
            raise MembraneError(f"init: --{name.replace('_', '-')} is not a length of a {arguments.shape}; expected {expected}")
    for one, other in (("focal", "view"), ("dots", "pitch"), ("rest", "pitch")):
        if getattr(arguments, one) is not None and getattr(arguments, other) is not None:
            raise MembraneError(f"init: --{one} and --{other}; expected only one of them, because they are alternatives")
    if arguments.rim is not None and arguments.rest is None:
        raise MembraneError("init: --rim without --rest; expected also --rest, the image that shows the rim")
    if arguments.rim is not None and arguments.shape not in CIRCULAR:
        raise MembraneError(
            f"init: --rim with --shape {arguments.shape}; expected a shape with a circular rim ({', '.join(CIRCULAR)}): leave "
            "out --rim, and give --distance and --focal or --view"
        )
    if arguments.rim is not None and arguments.distance is not None and (arguments.focal or arguments.view):
        lens = "--focal" if arguments.focal else "--view"
        raise MembraneError(f"init: --rim, --distance and {lens}; expected two of them, because they determine the third")


def _optics(arguments: Namespace, rest: np.ndarray | None) -> Optics:
    size = arguments.image_size or list(rest.shape[::-1] if rest is not None else ())
    if rest is not None and list(rest.shape[::-1]) != size:
        raise MembraneError(
            f"init: --image-size {size[0]},{size[1]}, but {arguments.rest} has {rest.shape[1]} x {rest.shape[0]} px; expected "
            "the same size: leave out --image-size, or give a rest image of that size"
        )
    focal = arguments.focal or (arguments.view and focal_of_view(arguments.lens, size[0], arguments.view))
    distance, centre = arguments.distance, arguments.centre or [(side - 1) / 2 for side in size]
    if arguments.lens == "pinhole" and distance is not None and not distance > 0:
        raise MembraneError(
            f"init: --distance {distance:g}: the rim behind a pinhole, which sees nothing there; expected a positive distance, "
            "or --lens fisheye"
        )
    if arguments.rim is not None:
        u, v, pixels = arguments.rim
        circle, centre = RimCircle(arguments.radius, pixels, arguments.lens), arguments.centre or [u, v]
        distance = circle.distance(focal) if distance is None else distance
        focal = focal or circle.focal(distance)
    camera = Camera(arguments.lens, tuple(size), (round(focal, 3),) * 2, centre, bits=arguments.bits)
    return Optics(camera, None if distance is None else float(f"{distance:.7g}"))


def _rim_in_words(arguments: Namespace, rest: np.ndarray) -> list[str]:
    """Replace `FROM_IMAGE` by the circle of the rim found in the rest image; return lines on what was found."""
    rim = find_rim(rest, find_dots(rest, arguments.polarity).pixels)
    (u, v), (longer, shorter) = rim.centre, rim.half_axes
    if shorter < ROUND * longer:
        raise MembraneError(
            f"init: the rim in {arguments.rest} is an ellipse with semi-axes of {longer:.1f} and {shorter:.1f} px, centred at "
            f"{u:.1f},{v:.1f}; expected a circle, as a camera on the membrane's axis sees it: take the photograph along the "
            "axis, or pass --rim U,V,RADIUS for a first guess and list the dots, --dots, for `calibrate rest`, which finds the "
            "tilt"
        )
    radius = (longer + shorter) / 2
    arguments.rim = [round(number, 2) for number in (u, v, radius)]
    return [
        f"rim found in the rest image: --rim {u:.2f},{v:.2f},{radius:.2f}, to {rim.deviation:.1f} px; an edge along "
        f"{rim.share:.0%} of it: see that `check --out` draws it where it is"
    ]


def _markers(arguments: Namespace, rest: np.ndarray | None, surface: Surface, camera: Camera) -> Markers:
    if arguments.dots is None and rest is not None:
        return Markers("dots", arguments.polarity, rest_image=rest)
    dots = (
        drafted_dots(surface, arguments.pitch) if arguments.dots is None else read_drafted_dots(arguments.dots, surface, camera)
    )
    return Markers("dots", arguments.polarity, *dots, rest_image=rest)


def _dots_in_words(sensor: Sensor) -> list[str]:
    """Return lines on the number of dots and how many are in view or found at rest; refuse too few dots in view."""
    listed = sensor.markers.positions
    if sensor.markers.rest_image is None and listed is not None:
        seen = int(in_view(sensor.camera.point_to_pixel(torch.from_numpy(listed)).numpy(), sensor.camera.image_size).sum())
        if seen < FEWEST_MARKERS:
            raise MembraneError(
                f"init: {seen} of {len(listed)} dots are in the camera's view; expected at least {FEWEST_MARKERS}: check "
                "--distance, --view or --focal, and --centre"
            )
        return [
            f"{len(listed)} dots, to be made on the membrane" + f", {seen} of them in the camera's view" * (seen < len(listed))
        ]
    observer = Reconstructor(sensor, check_rest=False).observer
    found = int(observer.seen_at_rest.sum())
    return [f"{found} of {len(observer.measured_rest)} dots found in the rest image"]
