"""`torchmembrane capture`: photographs of a camera, for rest images and weights."""

from argparse import Namespace
from pathlib import Path
from typing import Any

from .arguments import add_command, camera, count, number_from

PURPOSE = "photograph with a camera whose exposure, gain and white balance are held"
EXAMPLES = """\
examples:
  torchmembrane capture --camera 0 --out rest/ --count 20
  torchmembrane capture sensor.toml --camera 0 --out weights/ --count 5 --every 10     # put another weight on meanwhile

The camera is opened as `live` opens it, left alone until what it sets by itself has settled, and then held so,
as far as its driver lets; what cannot be held is said. Most drivers keep the settings until the camera is
unplugged: `live` then sees what was photographed. The files are named after the time, UTC.

exit code: 0 all taken, 2 wrong usage, or a camera that gives no images (any more)"""
LONGEST = 3600.0
"""Seconds between photographs."""


def add_parser(commands: Any) -> None:
    """Add the command's parser."""
    add = add_command(commands, "capture", run, PURPOSE, EXAMPLES)
    size = "the sensor file, whose image size is asked for, or preset:NAME (default: the camera's own size)"
    add("sensor", metavar="SENSOR.toml", nargs="?", help=size)
    opened = "a camera, by OpenCV: its number, 0 the first, or its path or address"
    add("--camera", metavar="NUMBER|PATH", type=camera, required=True, help=opened)
    add("--out", metavar="DIR", type=Path, required=True, help="folder of the photographs; those that it holds are kept")
    add("--count", metavar="N", type=count, default=20, help="photographs (default: %(default)s)")
    add("--every", metavar="SECONDS", type=number_from(0, LONGEST), default=0.0, help="between them, at least (default: none)")


def run(arguments: Namespace) -> int:
    """Photograph; returns the exit code."""
    from ..files.atomic import make_folder
    from ..files.images import write_as_taken
    from ..live.capture import Photographs
    from ..presets import sensor_file
    from ..sensor.sensor import Sensor

    size, bits = None, None
    if arguments.sensor is not None:
        camera = Sensor.from_file(sensor_file(arguments.sensor)).camera
        size, bits = camera.image_size, camera.bits
    photographs = Photographs(arguments.camera, size)
    print(f"camera {arguments.camera}: {photographs.settings.said}", flush=True)
    make_folder(arguments.out)
    for taken, (name, image) in enumerate(photographs.take(arguments.count, arguments.every), 1):
        path = write_as_taken(arguments.out / name, image, bits)
        print(f"{taken} of {arguments.count}: {path}", flush=True)
    height, width = image.shape[:2]
    print(f"{arguments.count} photographs of {width} x {height} px in {arguments.out}")
    return 0
