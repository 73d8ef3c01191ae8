"""The command `torchmembrane`. Exit codes: 0 all well, 1 some frames failed, 2 wrong usage, 130 interrupted."""

import argparse
import os
import sys
import warnings
from pathlib import Path

import torch

from .. import __version__
from ..errors import MembraneError
from ..estimators.minimum_energy import ELEMENTS
from ..io.images import read_image
from ..io.results import load_frame
from ..io.store import FORMATS, MESH, Mesh, Settings, check_folder
from ..jobs.local import find_inputs, reconstruct_files
from ..mechanics.hyperelastic import MODELS
from ..presets import sensor_file
from ..reconstruct import ESTIMATORS, Reconstructor
from ..sensor.model import Sensor
from .calibrate import add_calibrate
from .describe import described, rest_frame
from .simulate import add_simulate

RECONSTRUCT_EXAMPLES = """\
examples:
  torchmembrane reconstruct sensor.toml press.png --out results --figures
  torchmembrane reconstruct sensor.toml 'day1/*.jpg' day2/ --out results --batch 32
  torchmembrane reconstruct sensor.toml press.mp4 --out results --format parquet

DIR then holds
  NAME.npz       the result for the image NAME.png (parquet: the dataset frames/part-*.parquet)
  mesh.npz       rest surface, triangles, units
  summary.csv    a row for every frame
  NAME.png       its figure (--figures)
Frames of a video are called STEM_000000, STEM_000001 ... The same command again goes on after an
interruption: finished frames are skipped, failed ones tried again. In Python,
torchmembrane.io.store.read_results(DIR) gives names and all frames as one batch.

exit code: 0 all well, 1 some frames failed (see stderr and summary.csv), 2 wrong usage or sensor file"""
CHECK_EXAMPLES = """\
examples:
  torchmembrane check sensor.toml
  torchmembrane check sensor.toml --out sensor.png

exit code: 0 the sensor can be used, 2 it cannot: the message says why"""
VIEW_EXAMPLES = """\
examples:
  torchmembrane view results/press.npz --out press.png
  torchmembrane view results/press.npz --image press.png

Without --out a window is opened; without a display, RESULT_view.png is written."""


EXPORT_EXAMPLES = """\
examples:
  torchmembrane export sensor.toml -o model.onnx
  torchmembrane export preset:fingertip -o fingertip.onnx --estimator minimum-energy
  torchmembrane export sensor.toml -o video.onnx --tracking

The model takes `image` [batch, 1, height, width], grey in 0..1, and gives the arrays of a NAME.npz, a row a frame;
--tracking, also previous_vertices, previous_pressure and (dots) previous_pixels: those of the frames before, NaN to start from
rest. To run it without torch: the package torchmembrane-edge (folder export/). Needs: pip install "torchmembrane[export]"

exit code: 0 written, 2 wrong usage or sensor file"""


def main(argv: list[str] | None = None) -> int:
    """Run the command with these arguments (default: the process's); returns the exit code."""
    arguments = _parser().parse_args(argv)
    with warnings.catch_warnings():
        warnings.showwarning = lambda message, *_: print(f"torchmembrane: warning: {message}", file=sys.stderr)
        try:
            return arguments.run(arguments)
        except (MembraneError, OSError) as error:
            print(f"torchmembrane: error: {error}", file=sys.stderr)
            return 2
        except KeyboardInterrupt:
            print("torchmembrane: interrupted; what is done so far is kept", file=sys.stderr)
            return 130


def reconstruct(arguments) -> int:
    """`torchmembrane reconstruct`"""
    if arguments.device == "cuda" and not torch.cuda.is_available():
        raise MembraneError("--device cuda: torch sees no CUDA device; pass --device cpu, or install torch with CUDA")
    inputs = find_inputs(arguments.images, arguments.video)
    sensor = Sensor.from_file(sensor_file(arguments.sensor))
    energy = arguments.energy or sensor.material.model
    settings = Settings(arguments.estimator, energy, arguments.element, arguments.format)
    check_folder(arguments.out, sensor.fingerprint, settings)
    reconstructor = Reconstructor(sensor, arguments.estimator, model=energy, element=arguments.element)
    outcome = reconstruct_files(
        reconstructor.to(arguments.device), inputs, arguments.out, settings,
        batch=arguments.batch, figures=arguments.figures,
    )  # fmt: skip
    unsure = f" ({outcome.not_converged} not converged)" if outcome.not_converged else ""
    print(
        f"frames: {outcome.reconstructed} reconstructed{unsure}, {outcome.failed} failed, "
        f"{outcome.skipped} finished before; results in {arguments.out}"
    )
    return 1 if outcome.failed else 0


def check(arguments) -> int:
    """`torchmembrane check`"""
    sensor = Sensor.from_file(sensor_file(arguments.sensor))
    try:
        reconstructor, problem = Reconstructor(sensor), None
    except MembraneError as error:
        reconstructor, problem = None, error
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


def export(arguments) -> int:
    """`torchmembrane export`"""
    try:
        from ..onnx.export import export as write_model
    except ImportError as error:
        raise MembraneError(
            f'export needs {error.name}, which is not installed: pip install "torchmembrane[export]"'
        ) from error
    sensor = Sensor.from_file(sensor_file(arguments.sensor))
    energy = arguments.energy or sensor.material.model
    settings = Settings(arguments.estimator, energy, arguments.element, FORMATS[0])
    reconstructor = Reconstructor(sensor, arguments.estimator, model=energy, element=arguments.element)
    write_model(reconstructor, arguments.out, settings, arguments.tracking)
    print(f"written: {arguments.out}, {arguments.out.stat().st_size / 1e6:.1f} MB")
    return 0


def view(arguments) -> int:
    """`torchmembrane view`"""
    from ..plot.drawing import save, show
    from ..plot.frames import figure

    frame, mesh = load_frame(arguments.result), Mesh.load(arguments.mesh or arguments.result.parent / MESH)
    vertices, expected = len(frame["vertices"]), len(mesh.rest_vertices)
    if vertices != expected:
        raise MembraneError(
            f"{arguments.result}: {vertices} vertices, the mesh has {expected}; pass the {MESH} of its folder as --mesh"
        )
    image = read_image(arguments.image) if arguments.image else None
    drawing = figure(frame, mesh, image, arguments.result.stem)
    if arguments.out is None and _has_display():
        show(drawing)
        return 0
    out = arguments.out or arguments.result.with_name(f"{arguments.result.stem}_view.png")
    save(drawing, out)
    print(f"drawn in {out}")
    return 0


def _has_display() -> bool:
    return sys.platform in ("win32", "darwin") or any(os.environ.get(key) for key in ("DISPLAY", "WAYLAND_DISPLAY"))


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="torchmembrane", description="3-D shape of a deformable membrane from one image of its markings."
    )
    parser.add_argument("--version", action="version", version=f"torchmembrane {__version__}")
    commands = parser.add_subparsers(title="commands", metavar="COMMAND", required=True)
    _reconstruct_parser(commands)
    add_simulate(commands, _command)
    add_calibrate(commands, _command)
    _check_parser(commands)
    _view_parser(commands)
    _export_parser(commands)
    return parser


def _reconstruct_parser(commands) -> None:
    purpose = "reconstruct surfaces from images or a video of one sensor"
    add = _command(commands, "reconstruct", reconstruct, purpose, RECONSTRUCT_EXAMPLES)
    add("sensor", metavar="SENSOR.toml", help="the sensor file, or preset:NAME")
    add("images", metavar="IMAGES", nargs="+", help="image files, globs (quoted or not), folders, or videos")
    add("--out", metavar="DIR", type=Path, required=True, help="folder of the results: new, or of the same sensor")
    add("--estimator", choices=ESTIMATORS, default=ESTIMATORS[0], help="how it is found (default: %(default)s)")
    add("--energy", choices=MODELS, help="the membrane's elastic energy (default: the sensor file's)")
    element = "triangle (default), or quadrilateral: the paper's, harmonic, with the tension of --energy"
    add("--element", choices=ELEMENTS, default=ELEMENTS[0], help=element)
    add("--device", choices=("cpu", "cuda"), default="cpu", help="where to compute (default: %(default)s)")
    add("--batch", metavar="N", type=_count, default=16, help="frames computed at once (default: %(default)s)")
    add("--video", action="store_true", help="take every input for a video (mp4, mov, avi, mkv, webm are anyway)")
    add("--format", choices=FORMATS, default=FORMATS[0], help="one .npz a frame, or one dataset (default: %(default)s)")
    add("--figures", action="store_true", help="also NAME.png: flow, side view and displacement of every frame")


def _check_parser(commands) -> None:
    add = _command(commands, "check", check, "say in words, and draw, what a sensor file means", CHECK_EXAMPLES)
    add("sensor", metavar="SENSOR.toml", help="the sensor file, or preset:NAME")
    add("--out", metavar="FIGURE.png", type=Path, help="draw it: side view with rays, rest surface, rest image")


def _view_parser(commands) -> None:
    add = _command(commands, "view", view, "draw a stored result", VIEW_EXAMPLES)
    add("result", metavar="RESULT.npz", type=Path, help="a frame's result")
    add("--mesh", metavar="mesh.npz", type=Path, help="the mesh of its folder (default: mesh.npz beside it)")
    add("--image", metavar="IMAGE", type=Path, help="the frame's image, drawn behind the flow")
    add("--out", metavar="FILE.png", type=Path, help="where to draw it (default: in a window, if there is a display)")


def _export_parser(commands) -> None:
    add = _command(commands, "export", export, "write image to result as one ONNX model", EXPORT_EXAMPLES)
    add("sensor", metavar="SENSOR.toml", help="the sensor file, or preset:NAME")
    add("-o", "--out", metavar="MODEL.onnx", type=Path, required=True, help="the model's file")
    add("--estimator", choices=ESTIMATORS, default=ESTIMATORS[0], help="how it is found (default: %(default)s)")
    add("--energy", choices=MODELS, help="the membrane's elastic energy (default: the sensor file's)")
    add("--element", choices=ELEMENTS, default=ELEMENTS[0], help="as for reconstruct (default: %(default)s)")
    add("--tracking", action="store_true", help="start from the frame before, given with the image (force balance)")


def _command(commands, name: str, run, purpose: str, examples: str):
    parser = commands.add_parser(
        name, help=purpose, description=purpose[0].upper() + purpose[1:] + ".", epilog=examples,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )  # fmt: skip
    parser.set_defaults(run=run)
    return parser.add_argument


def _count(text: str) -> int:
    if not text.isdigit() or int(text) < 1:
        raise argparse.ArgumentTypeError(f"{text!r}; expected a whole number, 1 or more")
    return int(text)
