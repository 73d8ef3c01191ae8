"""`torchmembrane check`: describe and draw what a sensor file means, and estimate the accuracy of the sensor."""

import os
import sys
from argparse import Namespace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from .. import __version__
from ..errors import MembraneError
from .arguments import add_command, add_force, add_sensor, count, number_from, pressure, seed
from .choices import MOST_DECIBEL
from .progress import ProgressDisplay, announce

if TYPE_CHECKING:
    from ..accuracy.finished import FinishedSeries
    from ..accuracy.spec_sheet import SpecSheet
    from ..sensor.sensor import Sensor
    from ..sensor.working_range import WorkingRange

PURPOSE = "describe and draw what a sensor file means, and estimate the accuracy of the sensor"
EXAMPLES = """\
examples:
  torchmembrane check sensor.toml
  torchmembrane check sensor.toml --out sensor.png
  torchmembrane check sensor.toml --overpressure 12hPa
  torchmembrane check sensor.toml --robot robot      # as URDF and MJCF, with its contact law
  torchmembrane check preset:bubble --accuracy --out bubble.png

The command tests whether the rest surface is in equilibrium. It reports the force that tension and pressure leave unbalanced.
It fits a sheet inflated in the same rim, and reports its distance from the surface and its pressure. With --overpressure, it
compares the model's pressure with the gauge's. For each difference, it says how much the forces are affected.

--accuracy presses the sensor in the simulator and reconstructs some 150 images. It reports the noise at rest, the lightest
touch that is found, the errors of force, depth and contact point, the smallest distance at which two contacts are resolved,
and how deep a press may be. It takes some minutes of processor time, more for larger images. The tested range of depth and
force is kept in SENSOR_range.toml beside the sensor file (not of a preset); later results beyond it get status 9. An
interrupted command keeps the finished series of presses in a file accuracy-*.unfinished.json beside --out, or else in the
current folder. The same command continues from there and removes the file at the end. SENSOR.toml may be preset:NAME.

exit code: 0 the sensor can be used, 2 it cannot: the message says why"""


def add_parser(commands: Any) -> None:
    """Add the parser of the command."""
    add = add_command(commands, "check", run, PURPOSE, EXAMPLES)
    add_sensor(add)
    add(
        "--out",
        metavar="FIGURE.png",
        type=Path,
        help="draw the sensor: side view with rays, rest surface, rest image, accuracy",
    )
    add_force(add)
    add(
        "--robot",
        metavar="FOLDER",
        type=Path,
        help="write the sensor for robot simulators: URDF, MJCF, meshes (STL) and contact law, in SI units",
    )
    gauge = (
        "reading of a gauge at rest, inside minus outside, with its unit, as 12hPa; it is compared with the model's pressure"
    )
    add("--overpressure", metavar="P", type=pressure, help=gauge)
    add("--accuracy", action="store_true", help="also make a spec sheet of the sensor from simulated presses")
    add("--seed", type=seed, help="seed of presses and noise of --accuracy (default: 0)")
    noise = "image noise for --accuracy: white over the noise's standard deviation, dB (default: as in the rest image, else 40)"
    add("--noise", metavar="DB", type=number_from(0, MOST_DECIBEL), help=noise)
    add("--jobs", metavar="J", type=count, help="number of processes of --accuracy (default: one per core)")


def run(arguments: Namespace) -> int:
    """Describe and draw the sensor; return the exit code."""
    for name in ("seed", "noise", "jobs"):
        if getattr(arguments, name) is not None and not arguments.accuracy:
            raise MembraneError(f"--{name} goes with --accuracy only: add it")
    if arguments.accuracy:
        announce("check --accuracy")
    from ..presets import PREFIX, sensor_file
    from ..reconstruct import Reconstructor
    from ..sensor.sensor import Sensor
    from ..sensor.working_range import range_file
    from .describe import described, rest_frame
    from .rest_words import rest_in_words

    if arguments.out:
        _spare_files(arguments, sensor_file(arguments.sensor))
    sensor = Sensor.from_file(sensor_file(arguments.sensor))
    reconstructor, problem = None, None
    try:
        reconstructor = Reconstructor(sensor, check_rest=False)
        reconstructor.observer.check_rest(sensor.name)
    except MembraneError as error:
        problem = MembraneError(f"{arguments.sensor}: {error}")
    frame = None if reconstructor is None else rest_frame(reconstructor)
    print("\n".join([*described(sensor, reconstructor, frame), *rest_in_words(sensor, arguments.overpressure)]), flush=True)
    if arguments.robot:
        from ..integrations.robot_model import file_stem, write_robot_model

        folder = write_robot_model(sensor, arguments.robot)
        stem = file_stem(sensor)
        print(f"{stem}.urdf, {stem}.xml (MJCF) and their meshes written to {folder}", flush=True)
        _write_contact(sensor, folder)
    finished = _finished(sensor, arguments) if arguments.accuracy and not problem else None
    sheet = _sheet(sensor, arguments, finished) if finished else None
    if sheet and sheet.range and not str(arguments.sensor).startswith(PREFIX):
        _keep(sheet.range, range_file(sensor_file(arguments.sensor)))
    if arguments.out:
        from ..plot.files import save
        from ..plot.sensor import sensor_figure

        save(sensor_figure(sensor, reconstructor, frame, sheet), arguments.out, "check")
        print(f"drawn in {arguments.out}")
    if finished:
        finished.remove()
    if problem:
        raise problem
    return 0


def _write_contact(sensor: "Sensor", folder: Path) -> None:
    """Write the contact-pressure law beside the robot model, and print a line about it."""
    from ..accuracy.contact_law import contact_law
    from ..integrations.contact_files import write_contact_law

    try:
        with ProgressDisplay("check --robot") as progress:
            law = contact_law(sensor, progress)
        write_contact_law(law, sensor, folder)
    except MembraneError as error:
        print(f"contact.toml not written: {error}")
        return
    worst = abs(law.errors()).max(initial=0.0)
    print(f"contact.toml, .csv, .png: contact pressure over depth, off by {worst:.1%} of the force at most in presses held out")


def _keep(range: "WorkingRange", path: Path) -> None:
    """Store the working range beside the sensor file, and print where."""
    try:
        range.to_file(path)
        print(f"          kept in {path}: this sensor's results beyond it get status 9")
    except MembraneError as error:
        print(f"          not kept: {error}")


def _spare_files(arguments: Namespace, sensor: Path) -> None:
    """Refuse to overwrite any file other than an earlier figure of a sensor."""
    from functools import partial

    from ..files.targets import refuse_overwriting
    from ..plot.files import drawn_by
    from ..sensor.companions import files_of

    refuse_overwriting("check --out", [arguments.out], files_of(sensor), arguments.force, partial(drawn_by, "check"))


def _finished(sensor: "Sensor", arguments: Namespace) -> "FinishedSeries":
    """Return the series that an interrupted command has finished, and print how many there are."""
    from ..accuracy.finished import FinishedSeries
    from ..accuracy.spec_sheet import Effort

    folder = arguments.out.parent if arguments.out else Path()
    finished = FinishedSeries.resumed(folder, __version__, sensor, arguments.seed or 0, arguments.noise, Effort())
    if finished.outcomes:
        print(
            f"check --accuracy: continues from {len(finished.outcomes)} finished series in {finished.path}",
            file=sys.stderr,
            flush=True,
        )
    return finished


def _sheet(sensor: "Sensor", arguments: Namespace, finished: "FinishedSeries") -> "SpecSheet":
    """Print and return the spec sheet of the sensor."""
    from ..accuracy.measure import spec_sheet
    from .sheet import sheet_lines

    jobs = arguments.jobs or os.cpu_count() or 1
    with ProgressDisplay("check --accuracy") as progress:
        options: dict[str, Any] = dict(noise=arguments.noise, jobs=jobs, finished=finished, progress=progress)
        sheet = spec_sheet(sensor, arguments.seed or 0, **options)
    print("\n".join(sheet_lines(sheet)))
    return sheet
