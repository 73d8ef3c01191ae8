"""`torchmembrane calibrate`: sensor files from images, and dots for a mill from a pattern in the image."""

import argparse
import csv
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from ..calibrate.boards import PORTS, CameraFit, Views, lens_from_views, ports_from_views
from ..calibrate.depth import rest_from_depth
from ..calibrate.material import STRETCHES, material_from_images
from ..calibrate.mill import dots_for_pixels, pixel_lattice, read_pixels, write_mill, write_svg
from ..calibrate.rest import rest_from_image
from ..calibrate.surface import fine_surface
from ..calibrate.targets import find_target
from ..calibrate.views import rest_from_views
from ..errors import MembraneError
from ..io.images import read_image
from ..io.report import Report
from ..jobs.local import find_inputs
from ..presets import sensor_file
from ..sensor.model import Markers, Sensor
from ..targets import Checkerboard, DotBoard

CONTENT = """
SENSOR.toml holds the design; it may be preset:NAME. DIR then holds
  sensor.toml    the sensor as calibrated, with its files
  report.json    what was found, standard deviations, correlations
  report.png     residuals and what goes with them"""
STEPS = """\
A sensor is calibrated in this order, each step starting from the sensor file of the one before:
  camera     lens, from a checkerboard in air, ports not mounted
  ports      distance, thickness and index of flat layers, from a board of dots, in air and in the medium
  rest       where the rest surface stands, and its dots, from the rest image, when the dots are listed
  views      the same from several views, when they are not
  depth      the same from a depth image
  material   prestretch from images of presses; stiffness, where the forces of some are known
and the other way round:
  pattern    from the dots wanted in the image to places on the rest surface, for a mill"""
EXAMPLES = {
    "camera": "torchmembrane calibrate camera design.toml board/*.png --corners 11,8 --square 2.5 --out lens",
    "ports": "torchmembrane calibrate ports lens/sensor.toml --air dry/ --medium wet/ --dots 17,13 --pitch 2 --out ports",
    "rest": "torchmembrane calibrate rest ports/sensor.toml rest.png --out rest",
    "views": "torchmembrane calibrate views ports/sensor.toml first.png second.png third.png --motions motions.csv --out rest",
    "depth": "torchmembrane calibrate depth sensor.toml depth.npy --image rest.png --out rest",
    "material": "torchmembrane calibrate material rest/sensor.toml press/*.png --forces forces.csv --out material",
    "pattern": "torchmembrane calibrate pattern design.toml --pitch 30 --out mill",
}


def add_calibrate(commands, command) -> None:
    """Add the command's parser with its verbs; `command` is `cli._command`."""
    parser = commands.add_parser(
        "calibrate", help="find lens, ports, rest surface and dots from images; make a dot pattern",
        description="Calibrate a sensor (section 5.2 of the paper).", epilog=STEPS,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )  # fmt: skip
    verbs = parser.add_subparsers(title="steps", metavar="STEP", required=True)
    for name, (run, purpose, options) in VERBS.items():
        add = command(verbs, name, run, purpose, f"example:\n  {EXAMPLES[name]}\n{CONTENT}")
        add("sensor", metavar="SENSOR.toml", help="the design, or the sensor file of the step before")
        options(add)
        add("--out", metavar="DIR", type=Path, required=True, help="folder of the calibrated sensor")


def camera(arguments) -> int:
    """`torchmembrane calibrate camera`"""
    sensor, (columns, rows) = _sensor(arguments), arguments.corners
    board = Checkerboard(columns, rows, arguments.square)
    pixels = _targets(arguments.images, sensor, board)
    found = lens_from_views(sensor.camera, board, Views(pixels, np.zeros(len(pixels), bool)))
    units = [{"focal": "px", "centre": "px"}.get(name.split("[")[0], "") for name in found.names]
    return _camera_done(arguments, sensor, found, pixels, units, f"lens: {sensor.camera.model}, {len(pixels)} images")


def ports(arguments) -> int:
    """`torchmembrane calibrate ports`"""
    sensor, (columns, rows) = _sensor(arguments), arguments.dots
    board = DotBoard(columns, rows, arguments.pitch, arguments.radius)
    sets = [_targets(images, sensor, board) for images in (arguments.air, arguments.medium) if images]
    if not sets:
        raise MembraneError("calibrate ports: no images; expected --air IMAGES, --medium IMAGES, best both")
    pixels = np.concatenate(sets)
    filled = np.arange(len(pixels)) >= (len(sets[0]) if arguments.air else 0)
    found = ports_from_views(sensor.camera, board, Views(pixels, filled), arguments.held)
    units = ["" if "index" in name else sensor.length_unit for name in found.names]
    title = f"ports: {(~filled).sum()} images in air, {filled.sum()} in the medium"
    return _camera_done(arguments, sensor, found, pixels, units, title)


def rest(arguments) -> int:
    """`torchmembrane calibrate rest`"""
    sensor, image = _sensor(arguments), read_image(arguments.image)
    found = rest_from_image(sensor, image)
    units = ["degrees"] * 3 + [sensor.length_unit] * 3
    shifts = np.linalg.norm(found.shifts, axis=1)
    notes = [
        f"{np.isfinite(found.pixels).all(1).sum()} of {len(shifts)} dots found; moved along the surface to null what is left: "
        f"{np.sqrt((shifts**2).mean()):.4f} {sensor.length_unit} rms, at most {shifts.max():.4f}"
    ]
    report = Report.of(
        "rest surface from one image", found.names, units, np.zeros(6), found.fit, found.pixels, found.residuals, notes
    )
    return _done(arguments, found.sensor, report)


def views(arguments) -> int:
    """`torchmembrane calibrate views`"""
    sensor, motions = _sensor(arguments), _motions(arguments.motions)
    found = rest_from_views(sensor, [read_image(path) for path in arguments.images], motions, arguments.travel_error)
    unit, P = sensor.length_unit, len(motions)
    design = np.concatenate([motions[1:, 3:], motions[1:, :3]], 1).ravel()
    rms = np.sqrt((found.deviations**2).mean(0))
    notes = [
        f"{len(found.dots)} dots, standard deviations along x, y, z {rms[0]:.4f}, {rms[1]:.4f}, {rms[2]:.4f} {unit}",
        _moved(found.surface, unit),
    ]
    units = (["degrees"] * 3 + [unit] * 3) * (P - 1)
    modelled = found.sensor.camera.point_to_pixel(torch.from_numpy(found.dots)).numpy()
    pixels = np.broadcast_to(modelled, found.residuals.shape)
    report = Report.of(f"rest surface from {P} views", found.names, units, design, found.fit, pixels, found.residuals, notes)
    size, places = sensor.camera.image_size, fine_surface(sensor).rest.numpy()
    return _done(arguments, found.sensor, report, lambda plot: plot.surface_figure(report, size, places, found.surface, unit))


def depth(arguments) -> int:
    """`torchmembrane calibrate depth`"""
    sensor = _sensor(arguments)
    found = rest_from_depth(sensor, _depth_image(arguments), read_image(arguments.image))
    unit = sensor.length_unit
    notes = [
        f"{len(found.deviations)} squares of depths, each known to {np.median(found.deviations):.4f} {unit}",
        _moved(found.surface, unit),
        f"{len(found.sensor.markers.positions)} dots placed on the surface",
    ]
    report = Report.without_parameters("rest surface from a depth image", notes)
    size, places = sensor.camera.image_size, fine_surface(sensor).rest.numpy()
    return _done(arguments, found.sensor, report, lambda plot: plot.surface_figure(report, size, places, found.surface, unit))


def material(arguments) -> int:
    """`torchmembrane calibrate material`"""
    sensor, paths = _sensor(arguments), find_inputs(arguments.images).images
    forces = _forces(arguments.forces, paths) if arguments.forces else None
    images = torch.from_numpy(np.stack([_image(path, sensor) for path in paths]))[:, None]
    found = material_from_images(sensor, images, forces)
    unit, before = sensor.length_unit, [sensor.material.prestretch, sensor.material.modulus]
    n = len(found.values)
    report = Report.without_parameters(f"material from {len(paths)} images of presses")._replace(
        names=["prestretch", "modulus"][:n], units=["", f"N/{unit}"][:n], design=np.array(before[:n]), values=found.values,
        deviations=found.deviations, correlations=found.covariance / np.outer(found.deviations, found.deviations),
        notes=[
            f"{path.name} alone: prestretch {one:.3f} ± {sd:.2g}" for path, (one, sd) in zip(paths, found.each, strict=True)
        ],
    )  # fmt: skip
    if found.values[0] + found.deviations[0] > STRETCHES[-1]:
        report.notes.append(f"the prestretch may be larger: {STRETCHES[-1]:g} is the largest that was tried")
    if n == 2:
        report.notes.append("modulus: shear modulus x thickness; the sensor file's thickness is kept, or 1 where it has none")
    return _done(arguments, found.sensor, report, lambda plot: plot.material_figure(report, found, [p.name for p in paths]))


def pattern(arguments) -> int:
    """`torchmembrane calibrate pattern`"""
    sensor = _sensor(arguments)
    if (arguments.pixels is None) == (arguments.pitch is None):
        raise MembraneError("calibrate pattern: expected either --pixels FILE or --pitch PX")
    wanted = read_pixels(arguments.pixels) if arguments.pixels else pixel_lattice(sensor, arguments.pitch)
    dots = dots_for_pixels(sensor, *wanted)
    made = replace(sensor, markers=Markers("dots", sensor.markers.polarity, dots.positions, dots.sizes))
    path = made.to_file(arguments.out)
    write_mill(arguments.out / "mill.csv", sensor, dots)
    write_svg(arguments.out / "mill.svg", sensor, dots)
    from ..plot import calibration, drawing

    title = f"{len(dots.radii)} dots, radii {dots.radii.min():.3g} to {dots.radii.max():.3g} {sensor.length_unit}"
    drawing.save(calibration.mill_figure(title, sensor, dots), arguments.out / "report.png")
    print(f"{title}\n{arguments.out / 'mill.csv'} for the mill, mill.svg to look at, and the sensor that has them: {path}")
    return 0


def _camera_done(arguments, sensor: Sensor, found: CameraFit, pixels: np.ndarray, units: list[str], title: str) -> int:
    design = [_value(sensor.camera, name) for name in found.names]
    report = Report.of(title, found.names, units, design, found.fit, pixels, found.residuals)
    return _done(arguments, replace(sensor, camera=found.camera), report)


def _done(arguments, sensor: Sensor, report: Report, draw=None) -> int:
    from ..plot import calibration, drawing

    folder, path = arguments.out, sensor.to_file(arguments.out)
    report.write(folder)
    drawing.save(draw(calibration) if draw else calibration.fit_figure(report, sensor.camera.image_size), folder / "report.png")
    print("\n".join([*report.lines, f"calibrated sensor: {path}; report.json and report.png beside it"]))
    return 0


def _sensor(arguments) -> Sensor:
    return Sensor.from_file(sensor_file(arguments.sensor))


def _value(camera, name: str) -> float:
    key, _, index = name.rstrip("]").partition("[")
    values = getattr(camera, key).reshape(-1).tolist()
    i = int(index or 0)
    return values[i] if i < len(values) else 0.0


def _image(path: Path, sensor: Sensor) -> np.ndarray:
    image = read_image(path)
    if image.shape[::-1] != sensor.camera.image_size:
        raise MembraneError(f"{path}: {image.shape[1]} x {image.shape[0]} px; expected {list(sensor.camera.image_size)}")
    return image


def _targets(images: Sequence[str], sensor: Sensor, board) -> np.ndarray:
    """The board's points in every image that shows it, `[P, D, 2]`; what shows none is said and left out."""
    found = []
    for path in find_inputs(images).images:
        image = _image(path, sensor)
        try:
            found.append(find_target(image, board))
        except MembraneError as error:
            print(f"{path} left out: {error}")
    if not found:
        raise MembraneError(f"calibrate: no image of {len(images)} shows {board}")
    return np.stack(found)


def _motions(path: Path) -> np.ndarray:
    try:
        rows = np.loadtxt(path, delimiter=",", skiprows=1, ndmin=2)
    except (OSError, ValueError) as error:
        raise MembraneError(
            f"{path}: not readable ({error}); expected CSV with the header x,y,z,turn_x,turn_y,turn_z and a line an image"
        ) from error
    if rows.shape[1] != 6 or not np.isfinite(rows).all():
        raise MembraneError(f"{path}: {rows.shape[1]} columns; expected six finite numbers, x,y,z,turn_x,turn_y,turn_z")
    return rows


def _forces(path: Path, images: Sequence[Path]) -> np.ndarray:
    """Forces of the images `[B, 3]`, or magnitudes `[B, 1]`, NaN where the file has none."""
    expected = "CSV with the header image,fx,fy,fz or image,force and a line an image, N"
    try:
        header, *rows = csv.reader(path.read_text(encoding="utf-8-sig").splitlines())
        known = {name: [float(value) for value in values] for name, *values in rows}
    except (OSError, ValueError) as error:
        raise MembraneError(f"{path}: not readable ({error}); expected {expected}") from error
    if header not in (["image", "fx", "fy", "fz"], ["image", "force"]):
        raise MembraneError(f"{path}: the header is {','.join(header)!r}; expected {expected}")
    if wrong := [name for name, values in known.items() if len(values) != len(header) - 1 or not np.isfinite(values).all()]:
        raise MembraneError(f"{path}: {wrong[0]} has {known[wrong[0]]}; expected {len(header) - 1} finite numbers")
    if unknown := known.keys() - {image.name for image in images}:
        raise MembraneError(f"{path}: {min(unknown)} is none of the images given; expected their names, as {images[0].name}")
    if not known:
        raise MembraneError(f"{path}: no forces after the header; expected {expected}")
    return np.array([known.get(image.name, [np.nan] * (len(header) - 1)) for image in images])


def _depth_image(arguments) -> np.ndarray:
    path = arguments.depth
    if path.suffix != ".npy":
        return read_image(path).astype(float) * 65535 * arguments.unit
    try:
        return arguments.unit * np.load(path, allow_pickle=False).astype(float)
    except (OSError, ValueError) as error:
        raise MembraneError(f"{path}: not readable ({error}); expected a depth image as numpy.save writes it") from error


def _moved(surface, unit: str) -> str:
    rms, sd = (float(np.sqrt((a**2).mean())) for a in (surface.offsets, surface.deviations))
    return f"surface moved along its normals by {rms:.4f} {unit} rms, known to {sd:.4f} {unit} rms"


def _camera_options(add) -> None:
    add("images", metavar="IMAGES", nargs="+", help="of the checkerboard in different poses, filling the image")
    add("--corners", metavar="COLUMNS,ROWS", type=_pair, required=True, help="inner corners of the checkerboard")
    add("--square", metavar="LENGTH", type=_length, required=True, help="side of its squares, in the sensor's unit")


def _ports_options(add) -> None:
    add("--air", metavar="IMAGES", nargs="+", default=[], help="of the board of dots through the ports, before filling")
    add("--medium", metavar="IMAGES", nargs="+", default=[], help="of the same in the medium")
    add("--dots", metavar="COLUMNS,ROWS", type=_pair, required=True, help="of the board")
    add("--pitch", metavar="LENGTH", type=_length, required=True, help="of its dots, in the sensor's unit")
    add("--radius", metavar="LENGTH", type=_length, help="of its dots (default: 0.22 pitches; the three marks: 1.7 times that)")
    add("--held", metavar="NAME", nargs="+", choices=PORTS, default=[], help=f"taken as known: {', '.join(PORTS)}")


def _rest_options(add) -> None:
    add("image", metavar="REST.png", help="the membrane at rest")


def _views_options(add) -> None:
    add("images", metavar="IMAGES", nargs="+", help="of the membrane at rest; the first by the camera as it is in the sensor")
    where = "CSV x,y,z,turn_x,turn_y,turn_z: where the camera was for each image, roughly, in its first frame; degrees"
    add("--motions", metavar="FILE.csv", type=Path, required=True, help=where)
    scale = "standard deviation of the second image's travel, which sets the scale (default: %(default)s)"
    add("--travel-error", metavar="LENGTH", type=_length, default=0.01, help=scale)


def _depth_options(add) -> None:
    add("depth", metavar="DEPTH", type=Path, help=".npy or 16-bit PNG, registered to the camera: z along the axis, 0 none")
    add("--unit", metavar="LENGTH", type=_length, default=1.0, help="of one step of its values (default: %(default)s)")
    add("--image", metavar="REST.png", required=True, help="the membrane at rest, to find the dots in")


def _material_options(add) -> None:
    add("images", metavar="IMAGES", nargs="+", help="of presses, deep ones: files, globs, folders")
    where = (
        "CSV image,fx,fy,fz (on the membrane, in the camera's frame) or image,force (magnitude), N: total force in some images"
    )
    add("--forces", metavar="FILE.csv", type=Path, help=where)


def _pattern_options(add) -> None:
    add("--pixels", metavar="FILE.csv", type=Path, help="the wanted dots: u,v,size (small | large)")
    add("--pitch", metavar="PX", type=_length, help="a square lattice of this pitch within the rim's outline")


def _pair(text: str) -> tuple[int, int]:
    parts = text.split(",")
    if len(parts) != 2 or not all(part.isdigit() for part in parts):
        raise argparse.ArgumentTypeError(f"{text!r}; expected two counts, COLUMNS,ROWS")
    return int(parts[0]), int(parts[1])


def _length(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = 0.0
    if not 0 < value < np.inf:
        raise argparse.ArgumentTypeError(f"{text!r}; expected a positive number")
    return value


VERBS = {
    "camera": (camera, "find the lens from images of a checkerboard", _camera_options),
    "ports": (ports, "find the flat layers from images of a board of dots through them", _ports_options),
    "rest": (rest, "find the rest surface's pose and its dots from one rest image of listed dots", _rest_options),
    "views": (views, "find dots and rest surface from several views", _views_options),
    "depth": (depth, "find rest surface and dots from a depth image", _depth_options),
    "material": (material, "find prestretch and stiffness from images of presses", _material_options),
    "pattern": (pattern, "turn dots wanted in the image into places on the rest surface", _pattern_options),
}
