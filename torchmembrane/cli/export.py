"""`torchmembrane export`: write the computation from image to result as one ONNX model."""

from argparse import Namespace
from pathlib import Path
from time import monotonic
from typing import Any

from .arguments import add_command, add_estimator, add_force, add_sensor
from .progress import ProgressDisplay, announce

PURPOSE = "write the computation from image to result as one ONNX model"
EXAMPLES = """\
examples:
  torchmembrane export sensor.toml -o model.onnx
  torchmembrane export preset:fingertip -o fingertip.onnx --estimator minimum-energy
  torchmembrane export sensor.toml -o video.onnx --tracking

The input of the model is `image` [batch, 1, height, width], grey in 0..1. Its outputs are the arrays of a NAME.npz, one row
per frame. With --tracking (for dots), it has a second input `previous_pixels`, the pixels of the dots in the preceding
frames, or NaN to search for them from rest. The package torchmembrane-edge (folder export/) runs the model without torch. The
command needs pip install "torchmembrane[export]".

exit code: 0 written, 2 wrong usage or sensor file"""


def add_parser(commands: Any) -> None:
    """Add the parser of the command."""
    add = add_command(commands, "export", run, PURPOSE, EXAMPLES)
    add_sensor(add)
    add("-o", "--out", metavar="MODEL.onnx", type=Path, required=True, help="file of the model")
    add_force(add)
    add_estimator(add)
    add(
        "--tracking",
        action="store_true",
        help="follow the dots from their pixels in the preceding frame, which are given with the image",
    )


def run(arguments: Namespace) -> int:
    """Write the model; return the exit code."""
    announce("export")
    from ..errors import MembraneError
    from ..files.targets import refuse_overwriting
    from ..presets import sensor_file
    from ..sensor.companions import files_of
    from ..sensor.sensor import Sensor
    from .build import build_reconstructor

    try:
        from ..onnx.export import export
    except ImportError as error:
        raise MembraneError(
            f'export needs {error.name}, which is not installed: pip install "torchmembrane[export]"'
        ) from error
    refuse_overwriting("export", [arguments.out], files_of(sensor_file(arguments.sensor)), arguments.force)
    sensor, start = Sensor.from_file(sensor_file(arguments.sensor)), monotonic()
    with ProgressDisplay("export") as progress:
        progress(0.0, "sensor")
        reconstructor = build_reconstructor(sensor, arguments)
        export(reconstructor, arguments.out, tracking=arguments.tracking, progress=progress)
    print(f"written: {arguments.out}, {arguments.out.stat().st_size / 1e6:.1f} MB, {monotonic() - start:.0f} s")
    return 0
