"""`torchmembrane capture`: take photographs with a camera, for rest images and weights."""

from argparse import Namespace
from pathlib import Path
from typing import Any

from .arguments import add_command, camera, count, number_from, of_each_view

PURPOSE = "take photographs with fixed exposure, gain and white balance"
EXAMPLES = """\
examples:
  torchmembrane capture --camera 0 --out rest/ --count 20
  torchmembrane capture sensor.toml --camera 0 --out weights/ --count 5 --every 10     # change the weight in between
  torchmembrane capture --camera left=0 --camera right=2 --out rest/                   # several views

The camera is opened in the same way as by `live`. When its automatic settings have settled, they are fixed at their
values, as far as the driver allows; the command reports settings that cannot be fixed. Most drivers keep the settings
until the camera is unplugged, so that `live` then uses the same ones. The files are named after the time (UTC); for
several views, their names are TIME_VIEW.png.

exit code: 0 all taken, 2 wrong usage, or the camera gives no (more) images"""
LONGEST = 3600.0
"""Longest time between photographs, seconds."""


def add_parser(commands: Any) -> None:
    """Add the parser of the command."""
    add = add_command(commands, "capture", run, PURPOSE, EXAMPLES)
    size = "the sensor file, or preset:NAME; its image size is requested from the camera (default: the camera's own size)"
    add("sensor", metavar="SENSOR.toml", nargs="?", help=size)
    opened = (
        "the camera, opened by OpenCV: its number from 0, its path or its address; for a sensor with several views, give the "
        "option once for each view, as VIEW=CAMERA"
    )
    add("--camera", metavar="[VIEW=]NUMBER|PATH", action="append", required=True, help=opened)
    add("--out", metavar="DIR", type=Path, required=True, help="folder of the photographs; photographs in it are kept")
    add("--count", metavar="N", type=count, default=20, help="number of photographs (default: %(default)s)")
    add(
        "--every",
        metavar="SECONDS",
        type=number_from(0, LONGEST),
        default=0.0,
        help="smallest time between two photographs (default: 0)",
    )


def run(arguments: Namespace) -> int:
    """Take the photographs; return the exit code."""
    from ..files.atomic import make_folder
    from ..files.images import write_as_taken
    from ..live.capture import Photographs, taken_together

    cameras = _cameras(arguments)
    photographs = {ending: Photographs(opened, size) for ending, (opened, size, _) in cameras.items()}
    for (opened, *_), each in zip(cameras.values(), photographs.values(), strict=True):
        print(f"camera {opened}: {each.settings.said}", flush=True)
    make_folder(arguments.out)
    taken = taken_together(list(photographs.values()), arguments.count, arguments.every)
    for number, (name, images) in enumerate(taken, 1):
        for (ending, (_, _, bits)), image in zip(cameras.items(), images, strict=True):
            path = write_as_taken(arguments.out / f"{name}{ending}", image, bits)
            print(f"{number} of {arguments.count}: {path}", flush=True)
    height, width = image.shape[:2]
    print(f"{arguments.count} photographs of {width} x {height} px in {arguments.out}")
    return 0


def _cameras(arguments: Namespace) -> "dict[str, tuple[int | str, tuple[int, int] | None, int | None]]":
    """Return, by the suffix of its image names, each camera with its requested image size and its bit depth."""
    from ..presets import sensor_file
    from ..sensor.sensor import Sensor

    sensor = None if arguments.sensor is None else Sensor.from_file(sensor_file(arguments.sensor))
    named = [given.partition("=")[0] for given in arguments.camera if len(arguments.camera) > 1]
    views = named if sensor is None else sensor.views_apart
    opened = [camera(given) for given in of_each_view("--camera", "NUMBER", arguments.camera, views)]
    if not views:
        size, bits = (None, None) if sensor is None else (sensor.image_size, sensor.camera.bits)
        return {"": (opened[0], size, bits)}
    if sensor is None:
        return {f"_{view}": (each, None, None) for view, each in zip(views, opened, strict=True)}
    each_view = zip(sensor.views, opened, strict=True)
    return {f"_{view.name}": (each, view.camera.image_size, view.camera.bits) for view, each in each_view}
