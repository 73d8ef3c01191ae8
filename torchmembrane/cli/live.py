"""`torchmembrane live`: reconstruct the frames of a camera, or of a recording played like one, as they arrive."""

import signal
import sys
import warnings
from argparse import ArgumentTypeError, Namespace
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from threading import Event, Thread, current_thread, main_thread
from typing import TYPE_CHECKING, Any

from ..live.background import Background
from ..user_warnings import warn_user
from .arguments import (
    add_command,
    add_device,
    add_estimator,
    add_force,
    add_rerun,
    add_sensor,
    camera,
    check_device,
    count,
    number_from,
    of_each_view,
    pressure,
    wants_rerun,
    weight,
)

if TYPE_CHECKING:
    from ..live.loop import LiveFrame, Request, StreamStats
    from ..live.mailbox import Captured
    from ..live.streams import Stream
    from ..sensor.sensor import Sensor

PURPOSE = "reconstruct a live camera: wrench, status, frame rate and latency"
EXAMPLES = """\
examples:
  torchmembrane live sensor.toml --camera 0
  torchmembrane live sensor.toml --camera 0 --grid 17 17 --record today
  torchmembrane live sensor.toml --camera 0 --model video.onnx         # from torchmembrane export --tracking
  torchmembrane live sensor.toml --video press.mp4                     # at its own rate, unless --rate is given
  torchmembrane live sensor.toml --images frames/ --rate 30
  torchmembrane live pair.toml --camera left=0 --camera right=2        # several views

The command always computes the newest frame; frames that arrive in the meantime are dropped and counted. The latency is
the time from the capture (when a camera's image has been read, or when an image from a file is due) to the result. On a
terminal, one line is rewritten in place; elsewhere, one line per second is printed. Type `z` and Enter while nothing
touches the membrane to take the present state as the rest state. Ctrl-C or SIGTERM ends the command with a summary.

Softening of the membrane can be detected only with a known load. Type `200g` and Enter while this weight, and nothing
else, stands on the middle of the membrane, or `12hPa` and Enter while a gauge reads this change of the pressure since
rest. The result is compared with the load. After some comparisons, a warning says if a calibration is due.

exit code: 0 the recording has ended, or the command was stopped; 2 wrong usage, the source cannot be opened, or the camera
gives no more images"""
MODULUS = (
    "softening of the membrane can be detected only with a known load: type a weight or a gauge's reading, as 200g or 12hPa"
)
SOURCES = ("camera", "video", "images")
OF_TORCH = ("grid", "energy", "flow", "smoothing", "locator")
DEFAULTS = {"estimator": "force-balance", "device": "cpu"}
"""Defaults of the options that apply to torch only."""


def add_parser(commands: Any) -> None:
    """Add the parser of the command."""
    add = add_command(commands, "live", run, PURPOSE, EXAMPLES)
    add_sensor(add)
    opened = (
        "the camera, opened by OpenCV: its number from 0, its path or its address; for a sensor with several views, give the "
        "option once for each view, as VIEW=CAMERA"
    )
    add("--camera", metavar="[VIEW=]NUMBER|PATH", action="append", help=opened)
    recorded = (
        "a video, played like a camera (needs the extra video); for a sensor with several views, the first view's video, "
        "NAME_VIEW.mp4, with the others beside it"
    )
    add("--video", metavar="FILE", type=Path, help=recorded)
    add("--images", metavar="FOLDER", type=Path, help="a folder of images, played like a camera in the order of their names")
    add(
        "--rate",
        metavar="HZ",
        type=number_from(0.001, 1e6),
        help="frames per second of a video or of images (default: the video's own rate; 30 for images)",
    )
    add("--grid", metavar=("M", "N"), nargs=2, type=count, help="solver grid (default: the sensor file's)")
    model = "compute with a model from torchmembrane export in onnxruntime; needs torchmembrane-edge"
    add("--model", metavar="MODEL.onnx", type=Path, help=model)
    add("--threads", metavar="N", type=count, default=1, help="number of threads that compute (default: %(default)s)")
    kept = "store images, results and times in a new folder; frames for which the disk is too slow are dropped and counted"
    add("--record", metavar="DIR", type=Path, help=kept)
    life = "file with the largest force and depth that this sensor has ever had; it is created if it does not exist"
    add("--life", metavar="FILE.json", type=Path, help=life)
    add_rerun(add)
    add_force(add)
    add_estimator(add)
    add_device(add)


def run(arguments: Namespace) -> int:
    """Reconstruct the frames of the source until it ends or is stopped; return the exit code."""
    from ..interruption import answer
    from ..live.line import StatusLine, summary
    from ..live.loop import StreamStats, follow
    from ..live.mailbox import capture
    from ..live.peaks import Peaks
    from ..presets import sensor_file
    from ..sensor.sensor import Sensor

    _check(arguments)
    _spare_files(arguments)
    sensor = Sensor.from_file(sensor_file(arguments.sensor))
    images, stream = _images(arguments, sensor), _stream(arguments, sensor)
    line = StatusLine(stream.mesh, sys.stdout)
    warnings.showwarning = lambda message, *_: line.say(f"torchmembrane: warning: {message}")  # main restores it
    said: list[Callable[[], str]] = []
    try:
        with ExitStack() as stack:
            watchers = _watchers(arguments, stream, sensor, stack, said)
            stop, requests = stack.enter_context(_stopped_by_signals()), _requests_by_keys(sensor.length_unit)
            mailbox, stats, peaks = stack.enter_context(capture(images)), StreamStats(), Peaks(stream.mesh)
            watchers.append(lambda seen, _: peaks.add(seen.frame))
            if arguments.life is not None:
                peaks.kept_in(arguments.life)  # nothing yet: another sensor's file is refused before the stream begins
            try:
                follow(stream, mailbox, stats, [line, *watchers], stop, requests, line.say)
            finally:
                if stop.is_set():
                    answer()
                line.say(f"{peaks.said}; {MODULUS}")
                if arguments.life is not None:
                    line.say(peaks.kept_in(arguments.life))
                line.say(summary(stats))
    finally:
        for each in said:
            line.say(each())
    return 0


def _check(arguments: Namespace) -> None:
    from ..errors import MembraneError

    given = [f"--{name}" for name in SOURCES if getattr(arguments, name) is not None]
    if len(given) != 1:
        came = " and ".join(given) or "no source"
        raise MembraneError(f"live: {came}; expected one of --camera NUMBER, --video FILE, --images FOLDER")
    if arguments.rate is not None and arguments.camera is not None:
        raise MembraneError("live: --rate with --camera; leave --rate out, because a camera sets its own rate")
    foreign = [name for name in OF_TORCH if getattr(arguments, name) is not None]
    foreign += [name for name, default in DEFAULTS.items() if getattr(arguments, name) != default]
    if arguments.model is not None and foreign:
        raise MembraneError(
            f"live: --{foreign[0]} with --model; a model contains its own settings: export the model with this option"
        )
    check_device(arguments.device)


def _spare_files(arguments: Namespace) -> None:
    """Refuse to overwrite a file with the Rerun recording."""
    from ..files.targets import refuse_overwriting
    from ..presets import sensor_file
    from ..sensor.companions import files_of

    if wants_rerun(arguments) and arguments.save is not None:
        read = [*files_of(sensor_file(arguments.sensor)), *filter(None, [arguments.video, arguments.model])]
        refuse_overwriting("live --save", [arguments.save], read, arguments.force)


def _images(arguments: Namespace, sensor: "Sensor") -> "Iterator[Captured]":
    from ..live.sources import IMAGE_RATE, camera_images, folder_images, paced, video_images
    from ..live.view_sources import moments_of_cameras, moments_of_folder, moments_of_videos

    names, views, size, bits = sensor.views_apart, sensor.views, sensor.image_size, sensor.camera.bits
    rate = arguments.rate or IMAGE_RATE
    if arguments.camera is not None:
        opened = [camera(given) for given in of_each_view("--camera", "NUMBER", arguments.camera, names)]
        if not names:
            return camera_images(opened[0], size)
        each = zip(names, opened, views, strict=True)
        return moments_of_cameras({name: camera_images(given, view.camera.image_size) for name, given, view in each})
    if names and arguments.video is not None:
        return paced(moments_of_videos(arguments.video, views, arguments.rate))
    if names:
        return paced(moments_of_folder(arguments.images, views, rate))
    if arguments.video is not None:
        return paced(video_images(arguments.video, size, arguments.rate, bits))
    return paced(folder_images(arguments.images, size, rate, bits))


def _stream(arguments: Namespace, sensor: "Sensor") -> "Stream":
    """Return the stream that computes the results."""
    from dataclasses import replace

    import torch

    from ..live.streams import ModelStream, TrackedStream
    from .build import build_reconstructor

    if arguments.model is not None:
        print(f"torchmembrane: loading {arguments.model}; this takes some seconds per MB", file=sys.stderr)
        return ModelStream(arguments.model, sensor.fingerprint, arguments.threads)
    torch.set_num_threads(arguments.threads)
    if arguments.grid is not None:
        sensor = replace(sensor, membrane=sensor.surface.membrane(tuple(arguments.grid)))
    return TrackedStream(build_reconstructor(sensor, arguments).to(arguments.device))


def _watchers(
    arguments: Namespace, stream: "Stream", sensor: "Sensor", stack: ExitStack, said: "list[Callable[[], str]]"
) -> "list[Callable[[LiveFrame, StreamStats], None]]":
    """Return the other consumers of the frames; to `said`, add functions that report on them at the end."""
    from ..integrations.rerun import RerunLog
    from ..live.recording import Recording
    from ..sensor.view_images import first_view_picture

    watchers: list[Callable[[LiveFrame, StreamStats], None]] = []

    def add(keep: "Callable[[LiveFrame], None]", done: str) -> None:
        later = stack.enter_context(Background(keep, tell=_warn))
        watchers.append(lambda seen, _: later(seen))
        said.append(lambda: f"{done}; {_left_out(later)}")

    if arguments.record is not None:
        bits = [camera.bits for camera in sensor.image_cameras]
        recording = stack.enter_context(Recording(arguments.record, stream.mesh, *bits))
        add(recording.keep, f"recorded in {arguments.record}")
    if wants_rerun(arguments):
        log = stack.enter_context(RerunLog(stream.mesh, arguments.save))

        def show(seen: "LiveFrame") -> None:
            log.add(seen.number, seen.frame, first_view_picture(seen.image, sensor.views), seen.time)

        add(show, "shown in Rerun")
    return watchers


def _warn(error: BaseException) -> None:
    warn_user(f"{error}; frames that cannot be kept are left out and counted")


def _left_out(later: "Background[LiveFrame]") -> str:
    failed = f", {later.failed} frames that could not be kept" if later.failed else ""
    return f"{later.late} frames left out, because there was no time for them{failed}"


@contextmanager
def _stopped_by_signals() -> Iterator[Event]:
    """Yield an event that the first SIGINT or SIGTERM sets; a second signal, or a frame that takes too long, ends the
    command."""
    stop = Event()
    before: dict[signal.Signals, Any] = {}

    def on_signal(number: int, _: object) -> None:
        stop.set()
        handler = before[signal.Signals(number)]
        signal.signal(number, handler if callable(handler) else signal.default_int_handler)

    if current_thread() is main_thread():
        before = {number: signal.signal(number, on_signal) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield stop
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _requests_by_keys(length_unit: str) -> "deque[Request]":
    """Return a queue of the requests that are typed on the standard input."""
    requests: deque[Request] = deque()

    def read() -> None:
        for text in sys.stdin or ():
            if text.strip():
                requests.append(request_of(text.strip(), length_unit))

    Thread(target=read, name="keys", daemon=True).start()
    return requests


def request_of(text: str, length_unit: str) -> "Request":
    """Return the request of a typed line: `z`, a weight or a gauge reading; for any other line, a request that returns the
    expected input.

    Example:
        >>> request_of("q", "mm")(None)
        "'q' is not understood; expected z (take this for rest), a weight as 200g, or a gauge's change since rest as 12hPa"
    """
    from ..live.loop import rezeroed
    from ..sensor.units import hectopascal

    if text == "z":
        return rezeroed
    try:
        if text.lower().endswith("pa"):
            change = pressure(text) * hectopascal(length_unit)
            return lambda stream: stream.gauge(change)
        force = weight(text)
    except ArgumentTypeError:
        known = "z (take this for rest), a weight as 200g, or a gauge's change since rest as 12hPa"
        return lambda _: f"{text!r} is not understood; expected {known}"
    return lambda stream: stream.weigh(force)
