"""`torchmembrane check`: what a sensor file means, in words and drawn."""

from argparse import Namespace
from pathlib import Path
from typing import Any

from .arguments import add_command, add_sensor

PURPOSE = "say in words, and draw, what a sensor file means"
EXAMPLES = """\
examples:
  torchmembrane check sensor.toml
  torchmembrane check sensor.toml --out sensor.png

exit code: 0 the sensor can be used, 2 it cannot: the message says why"""


def add_parser(commands: Any) -> None:
    """Add the command's parser."""
    add = add_command(commands, "check", run, PURPOSE, EXAMPLES)
    add_sensor(add)
    add("--out", metavar="FIGURE.png", type=Path, help="draw it: side view with rays, rest surface, rest image")


def run(arguments: Namespace) -> int:
    """Describe and draw the sensor; returns the exit code."""
    from ..errors import MembraneError
    from ..presets import sensor_file
    from ..reconstruct import Reconstructor
    from ..sensor.sensor import Sensor
    from .describe import described, rest_frame

    sensor = Sensor.from_file(sensor_file(arguments.sensor))
    reconstructor, problem = None, None
    try:
        reconstructor = Reconstructor(sensor, check_rest=False)
        reconstructor.observer.check_rest(sensor.name)
    except MembraneError as error:
        problem = error
    frame = None if reconstructor is None else rest_frame(reconstructor)
    print("\n".join(described(sensor, reconstructor, frame)))
    if arguments.out:
        from ..plot.drawing import save
        from ..plot.sensor import sensor_figure

        save(sensor_figure(sensor, reconstructor, frame), arguments.out)
        print(f"drawn in {arguments.out}")
    if problem:
        raise problem
    return 0
