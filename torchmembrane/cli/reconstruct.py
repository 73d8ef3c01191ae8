"""`torchmembrane reconstruct`: reconstruct images or videos into a folder of results."""

import sys
from argparse import Namespace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from .arguments import (
    Add,
    add_command,
    add_device,
    add_estimator,
    add_force,
    add_sensor,
    check_device,
    count,
    count_or_auto,
    of_each_view,
    positive,
    share,
)
from .choices import ENGINES, FIELDS, RESULT_FORMATS
from .film import FrameImages, draw_film

if TYPE_CHECKING:
    from ..jobs.frame_reconstructor import Gauge
    from ..jobs.inputs import Inputs
    from ..jobs.local import FrameCounts
    from ..reconstruct import Reconstructor
    from ..results.store import Settings

PURPOSE = "reconstruct surfaces from images or a video of one sensor"
EXAMPLES = """\
examples:
  torchmembrane reconstruct sensor.toml press.png --out results --figures
  torchmembrane reconstruct sensor.toml 'day1/*.jpg' day2/ --out results --batch 32
  torchmembrane reconstruct sensor.toml press.mp4 --out results --format parquet
  torchmembrane reconstruct sensor.toml run.mcap --topic /camera/image --out results --bag forces
  torchmembrane reconstruct sensor.toml day1/ --out results --pressure gauge.csv
  torchmembrane reconstruct sensor.toml day1/ --out results --shard 2/8    # on the second of eight machines

DIR then holds
  NAME.npz       the result of the image NAME (parquet: the dataset frames/part-*.parquet)
  NAME.png       a figure of this result (--figures)
  mesh.npz       rest surface, triangles, units
  summary.csv    one row per frame; summary_columns.csv explains its columns
Frames of a video, of a bag, or of an image file with several pictures (TIFF, MPO, animated PNG, WebP or GIF) are
named STEM_000000, STEM_000001 ... After an interruption, run the same command again: it skips finished frames, and
repeats frames that failed, whose result is damaged, or whose image has changed. In Python,
torchmembrane.read_results(DIR) gives the frames one by one, by name, or as one batch.

exit code: 0 all well, 1 some frames failed (see stderr and summary.csv), 2 wrong usage or sensor file"""


def add_parser(commands: Any) -> None:
    """Add the parser of the command."""
    add = add_command(commands, "reconstruct", run, PURPOSE, EXAMPLES)
    add_sensor(add)
    add("images", metavar="IMAGES", nargs="+", help="image files, globs (quoted or not), folders, videos, or bags")
    add("--out", metavar="DIR", type=Path, required=True, help="folder of the results: new, or of the same sensor")
    add_force(add)
    add_estimator(add)
    add_device(add)
    _add_work(add)
    _add_measured(add)
    _add_stored(add)


def _add_work(add: Add) -> None:
    add(
        "--batch",
        metavar="N",
        type=count_or_auto,
        help="number of frames computed at once (default: auto, chosen from the available memory)",
    )
    each = "number of processes, of one thread each; 1: only this process (default: one per core, if there are enough frames)"
    add("--workers", metavar="N", type=count, help=each)
    where = (
        "local: compute in this process and its workers (default); ray: compute with Ray, on the cluster of RAY_ADDRESS or "
        "else on this machine, and write a Parquet dataset; see docs/clusters.md"
    )
    add("--engine", choices=ENGINES, default=ENGINES[0], help=where)
    part = (
        "compute the I-th of N disjoint parts of the frames; other commands may compute the others in the same DIR "
        "at the same time"
    )
    add("--shard", metavar="I/N", type=share, default=(1, 1), help=part)


def _add_measured(add: Add) -> None:
    add(
        "--video",
        action="store_true",
        help="treat every input as a video (mp4, mov, avi, mkv, webm and gif always are); needs the extra video",
    )
    of_bags = (
        "topic of the images in ROS 2 bags (default: the only one; needs the extra ros); for a sensor with several "
        "views, give the option once for each view, as VIEW=TOPIC"
    )
    add("--topic", metavar="[VIEW=]TOPIC", action="append", default=[], help=of_bags)
    messages = (
        "for ROS 2 bags as input: also write the results as messages to a new bag (a folder), in SI units: wrench, its "
        "deviation, tractions, contacts, status, and the absolute pressure if the filling is a gas"
    )
    add("--bag", metavar="BAG", type=Path, help=messages)
    own = (
        "images of this recording without contact, or first:N for its first N frames; their mean is the rest state "
        "(default: the sensor's rest image)"
    )
    add("--rest", metavar="IMAGES", nargs="+", default=[], help=own)
    gauge = (
        "a gauge's log, CSV: name or time of a frame, and pressure (across the membrane) or pressure_change (since rest), hPa"
    )
    add("--pressure", metavar="FILE.csv", type=Path, help=gauge)
    noise = "standard deviation of these readings, over the rest pressure (default: 0.01)"
    add("--pressure-noise", metavar="SHARE", type=positive, help=noise)


def _add_stored(add: Add) -> None:
    one = "npz: one .npz per frame; parquet: one dataset (default: npz; with --engine ray parquet)"
    add("--format", choices=RESULT_FORMATS, help=one)
    principal = "also store the principal stretches or tensions (force / length) at the vertices, [V, 2] each (npz only)"
    add("--fields", metavar="FIELD", nargs="+", choices=FIELDS, default=[], help=principal)
    film = (
        "also draw a film of all frames in DIR, in name order: .mp4, .mov, .mkv (extra video) or .gif; as view DIR "
        "--video-out does"
    )
    add("--video-out", metavar="FILE", type=Path, help=film)
    add("--figures", action="store_true", help="also draw NAME.png for every frame: flow, side view and displacement")


def run(arguments: Namespace) -> int:
    """Reconstruct; return the exit code."""
    from ..files.folder_lock import Shard
    from ..jobs.bags import bag_remarks, result_bag, write_bag
    from ..jobs.inputs import frame_name
    from ..jobs.local import reconstruct_files
    from ..jobs.ray_engine import RayEngine
    from ..jobs.rest import recording_rest
    from ..presets import sensor_file
    from ..results.read import read_results
    from ..results.store import Mesh, check_folder
    from ..sensor.sensor import Sensor
    from .build import build_reconstructor

    _check(arguments)
    by_ray = arguments.engine == "ray"
    sensor = Sensor.from_file(sensor_file(arguments.sensor))
    inputs = _inputs(arguments, sensor.views_apart)
    _spare_files(arguments, inputs)
    reconstructor = build_reconstructor(sensor, arguments).to("cpu" if by_ray else arguments.device)
    pressure = _pressures(arguments.pressure, reconstructor, inputs) if arguments.pressure else None
    format = arguments.format or ("parquet" if by_ray else "npz")
    settings = _settings(reconstructor, arguments, format, inputs)
    check_folder(arguments.out, sensor.fingerprint, settings)
    for remark in bag_remarks(inputs, sensor.image_cameras):
        print(f"torchmembrane: {remark}", file=sys.stderr)
    mesh, shard = Mesh.from_reconstructor(reconstructor, settings), Shard(*arguments.shard)
    bag = result_bag(arguments.bag, inputs, mesh, reconstructor, shard) if arguments.bag else None
    rest = recording_rest(reconstructor, arguments.rest, inputs) if arguments.rest else None
    counts = reconstruct_files(
        reconstructor,
        inputs,
        arguments.out,
        settings,
        batch=arguments.batch,
        workers=arguments.workers,
        engine=RayEngine(arguments.device, arguments.workers) if by_ray else None,
        shard=shard,
        figures=arguments.figures,
        rest_pixels=rest,
        pressure=pressure,
    )
    if bag is not None:
        print(f"{write_bag(bag, inputs, arguments.out)} frames with a wrench written to the bag {arguments.bag}")
    if arguments.video_out is not None:
        files = {frame_name(path): path for path in inputs.images}
        images = FrameImages(files, mesh, sensor.camera.bits)
        draw_film(read_results(arguments.out), images, arguments.video_out)
    print(f"frames: {_said(counts)}; results in {arguments.out}")
    return 1 if counts.failed else 0


def _inputs(arguments: Namespace, views: "list[str]") -> "Inputs":
    """Return the inputs to reconstruct; for several views, the files of the first view."""
    from ..jobs.inputs import find_inputs, of_first_view, without_rest
    from ..presets import sensor_file
    from ..sensor.companions import files_of

    topics = of_each_view("--topic", "TOPIC", arguments.topic, views)
    found = find_inputs(arguments.images, arguments.video, next(iter(topics), None))
    inputs = of_first_view(without_rest(found, arguments.images, files_of(sensor_file(arguments.sensor))), views, topics)
    if inputs.rest:
        said = ", ".join(map(str, inputs.rest))
        print(f"torchmembrane: left out, as it is the sensor's rest image: {said}", file=sys.stderr)
    return inputs


def _settings(reconstructor: "Reconstructor", arguments: Namespace, format: str, inputs: "Inputs") -> "Settings":
    """Return the settings of the results."""
    from ..jobs.rest import rest_hash
    from ..results.store import Settings

    fields = sorted(set(arguments.fields), key=FIELDS.index)
    given = " ".join(arguments.rest), str(arguments.pressure or "")
    return Settings.from_reconstructor(reconstructor, format, *given, fields, rest_hash(arguments.rest, inputs))


def _pressures(log: Path, reconstructor: "Reconstructor", inputs: "Inputs") -> "Gauge":
    """Return a gauge's readings of the frames; report the number of unused readings."""
    from ..jobs.pressure import recording_pressures

    readings = recording_pressures(reconstructor, log, inputs)
    if readings.unused:
        print(f"torchmembrane: {log}: {readings.unused} readings belong to no frame of this call and are not used")
    return readings.at


def _check(arguments: Namespace) -> None:
    """Refuse options that exclude each other or are impossible on this machine, before anything is read."""
    from ..errors import MembraneError

    if arguments.engine == "local":
        check_device(arguments.device)
    if arguments.fields and (arguments.engine == "ray" or arguments.format == "parquet"):
        raise MembraneError("--fields does not work with a Parquet dataset, whose columns are fixed; pass --format npz")
    if arguments.engine == "ray" and arguments.format == "npz":
        raise MembraneError("--engine ray --format npz: Ray's results are one dataset; leave --format out, or pass parquet")
    if arguments.video_out is not None:
        from ..plot.film import check_film

        check_film(arguments.video_out)


def _spare_files(arguments: Namespace, inputs: "Inputs") -> None:
    """Refuse to overwrite files other than the results that this call continues."""
    from functools import partial

    from ..files.targets import refuse_overwriting
    from ..jobs.result_folder import files_at_risk
    from ..jobs.workers import DRAWS
    from ..plot.files import drawn_by
    from ..presets import sensor_file
    from ..sensor.companions import files_of

    given = [path for path in (arguments.pressure, *map(Path, arguments.rest)) if path is not None]
    read = [*files_of(sensor_file(arguments.sensor)), *inputs.images, *inputs.videos, *given]
    targets = [*files_at_risk(arguments.out, inputs, arguments.figures), *filter(None, [arguments.video_out])]
    refuse_overwriting("reconstruct", targets, read, arguments.force, partial(drawn_by, DRAWS))


def _said(counts: "FrameCounts") -> str:
    doubts = {"not converged": counts.not_converged, "unexplained": counts.unexplained, "partly hidden": counts.hidden}
    doubts["out of range"] = counts.out_of_range
    said = ", ".join(f"{count} {doubt}" for doubt, count in doubts.items() if count)
    unsure = f" ({said})" if said else ""
    return f"{counts.reconstructed} reconstructed{unsure}, {counts.failed} failed, {counts.skipped} finished before"
