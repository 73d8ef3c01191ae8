"""The command `torchmembrane-edge`. Exit codes: 0 success, 1 some frames failed, 2 wrong usage or model, 130 interrupted."""

import argparse
import glob
import re
import sys
import time
import warnings
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from importlib.util import find_spec
from itertools import islice
from pathlib import Path

import numpy as np

from . import results
from .errors import EdgeError, printable
from .images import SUFFIXES, Frame, frame_name, frames, numbered, pictures, view_frames
from .session import MOST_THREADS, Session, model_file
from .summary import UNREADABLE, Summary
from .summary_row import AXES, CONTACTS, numbers
from .view_status import status_in_words

FINISHED = (0, 3, 7, 8, 9, 10)  # ok; not converged, unexplained, partly hidden, out of range, a view left out: it is kept
OF_SYSTEM = re.compile(r"\._.*|\.DS_Store|(eh)?thumbs\.db|desktop\.ini|icon\r", re.IGNORECASE)
NUMBER = re.compile("_[0-9]{6,12}$")
"""Number of a picture, at the end of a frame's name."""
MOST_BATCH, MOST_NUMBER = 256, 10**9 - 1
SECONDS_PER_MB = 0.5
"""Seconds that a PC core takes to load a model, per MB."""


def main(argv=None) -> int:
    """Run the command with these arguments; return the exit code."""
    arguments = _parser().parse_args(argv)
    for stream in (sys.stdout, sys.stderr):
        if hasattr(stream, "reconfigure"):
            stream.reconfigure(errors="backslashreplace")  # of names that a terminal's encoding lacks
    with warnings.catch_warnings():
        warnings.showwarning = lambda message, *_: print(f"torchmembrane-edge: warning: {message}", file=sys.stderr)
        try:
            return _run(arguments)
        except (EdgeError, OSError) as error:
            print(f"torchmembrane-edge: error: {printable(error)}", file=sys.stderr)
            return 2
        except KeyboardInterrupt:
            print("torchmembrane-edge: interrupted; what is done so far is kept", file=sys.stderr)
            return 130


def _run(arguments: argparse.Namespace) -> int:
    model = model_file(arguments.model)
    paths = _checked(arguments)
    megabytes = Path(model).stat().st_size / 1e6
    seconds = f"{max(1.0, SECONDS_PER_MB * megabytes):.0f}"
    said = f"loading {printable(model)}, {megabytes:.1f} MB; on one core this takes some {seconds} s"
    print(f"torchmembrane-edge: {said}", file=sys.stderr, flush=True)
    session = Session(model, arguments.threads, arguments.providers)
    if arguments.camera is not None:
        return watch(session, arguments.camera, arguments.frames)
    return reconstruct(session, paths, arguments.out, 1 if session.tracks else arguments.batch)


def _checked(arguments: argparse.Namespace) -> list[Path]:
    """Return the image files, after all checks that do not need the model."""
    if arguments.camera is not None:
        if arguments.images or arguments.out:
            raise EdgeError("--camera with images or --out; expected neither with --camera, whose results are only printed")
        if find_spec("cv2") is None:
            raise EdgeError('a camera needs OpenCV, which is not installed: pip install "torchmembrane-edge[camera]"')
        return []
    if arguments.frames is not None:
        raise EdgeError(f"--frames {arguments.frames} without --camera; expected --camera NUMBER with it")
    if not arguments.images or not arguments.out:
        raise EdgeError("nothing to do; expected IMAGES and --out DIR, or --camera NUMBER")
    if find_spec("PIL") is None:
        raise EdgeError('image files need Pillow, which is not installed: pip install "torchmembrane-edge[images]"')
    results.refuse_file(arguments.out)
    return image_files(arguments.images)


def image_files(arguments: Sequence[str]) -> list[Path]:
    """Resolve files, patterns and folders to files, in the order of the call; names as shells sort them, by their numbers.

    Raises:
        EdgeError: an argument matches no file, or two frames would have the same name.
    """
    paths = in_order(without_system_files([path for argument in arguments for path in _expanded(argument)]))
    files = {frame_name(path): path for path in paths}
    for name, uses in Counter(map(frame_name, paths)).items():
        if uses > 1:
            twins = printable(", ".join(str(path) for path in paths if frame_name(path) == name))
            raise EdgeError(
                f"two images of the name {name!r} ({twins}); results are named after images: rename, or use two calls"
            )
    for name, path in files.items():
        if name == "mesh":
            raise EdgeError(f"{printable(path)}: its result would be mesh.npz, which holds the mesh: rename the image")
        stem, _, number = name.rpartition("_")
        if stem in files and re.fullmatch("[0-9]{6,12}", number) and 1 < pictures(files[stem]) > int(number):
            raise EdgeError(f"{printable(path)}: a picture of {printable(files[stem])} has the same name; use two calls")
    return paths


def in_order(paths: list[Path]) -> list[Path]:
    """Return the paths as given, or sorted by the numbers in their names if they are in the order of a shell's expansion."""
    return sorted(paths, key=numbered) if paths == sorted(paths) else paths


def without_system_files(paths: list[Path]) -> list[Path]:
    """Return the paths without the files that macOS and Windows leave in folders, which a shell pattern may match."""
    return [path for path in paths if not OF_SYSTEM.fullmatch(path.name)] or paths


def _expanded(argument: str) -> list[Path]:
    path = Path(argument)
    if path.is_dir():
        files = (p for p in path.iterdir() if p.suffix.lower() in SUFFIXES and p.is_file() and not p.name.startswith("."))
        found = sorted(files, key=numbered)
        if not found:
            raise EdgeError(f"{printable(path)}: the folder holds no files {' '.join(SUFFIXES)}; expected one or more")
        return found
    if path.exists():
        return [path]
    found = [p for p in map(Path, sorted(glob.glob(argument, recursive=True), key=numbered)) if p.is_file()]
    if not found:
        raise EdgeError(f"{printable(argument)}: no such file, no pattern that matches one; expected images, patterns, folders")
    return found


def reconstruct(session: Session, paths: list[Path], out: Path, batch: int) -> int:
    """Write each frame's result as `NAME.npz` to the folder `out`, with `mesh.npz` and `summary.csv`, and print a line for
    each.

    A tracking model treats the frames as a video.
    """
    results.begin(out, session.mesh)
    summary, files = Summary(out, session), first_views(paths, session.views)
    waiting = (frame for path in files for frame in _frames(path, session))
    done, found, names, broken = Counter(), None, set(), set()
    try:
        while group := list(islice(waiting, batch)):
            start = time.perf_counter()
            images = [frame.image for frame in group if frame.image is not None]
            if images:
                found = session.run(_joined(images), found)
            seconds = (time.perf_counter() - start) / max(len(images), 1)
            rows = ({key: values[row] for key, values in found.items()} for row in range(len(images)))
            for frame in group:
                names.add(frame.name)
                broken.update([frame.path] if frame.image is None else [])
                done[_kept(session, frame, None if frame.image is None else next(rows), seconds, summary) in FINISHED] += 1
    except BaseException:  # interrupted, or no space left
        with suppress(EdgeError):
            summary.write()
        raise
    _remove_outdated(out, {frame_name(path): path for path in files if path not in broken}, names, summary)
    summary.write()
    print(f"frames: {done[True]} reconstructed, {done[False]} failed; results in {printable(out)}")
    return 1 if done[False] else 0


def _remove_outdated(out: Path, files: dict[str, Path], names: set[str], summary: Summary) -> None:
    """Remove earlier results of pictures that these files, by the names of their frames, do not contain any more."""
    for earlier in sorted(out.glob("*.npz")):
        name = earlier.stem
        file = files.get(name) or files.get(NUMBER.sub("", name))
        if file and name not in names and results.file_name(earlier) == printable(file.name):
            results.remove(earlier)
            summary.remove(name)
            print(printable(f"{file}: {name} removed, as the file does not contain this picture any more"), file=sys.stderr)


def _joined(images: list) -> np.ndarray | list[np.ndarray]:
    """Join the images of frames into one batch, or into one batch per view."""
    if isinstance(images[0], list):
        return [np.concatenate(view) for view in zip(*images, strict=True)]
    return np.concatenate(images)


def _frames(path: Path, session: Session) -> Iterator[Frame]:
    """Yield the frames of a file, with the images of all views that have files of their own."""
    if not session.views:
        return frames(path, session.image_size, session.bits)
    return view_frames(path, session.views, session.image_sizes, session.bits)


def first_views(paths: list[Path], views: Sequence[str]) -> list[Path]:
    """Return the first view's path for each NAME among the files NAME_VIEW of all `views`, whether or not it exists; all paths
    if the views have no files of their own.

    Raises:
        EdgeError: a file belongs to no view.
    """
    if not views:
        return paths
    firsts = {}
    for path in paths:
        view = max((view for view in views if path.stem.endswith(f"_{view}")), key=len, default=None)
        if view is None:
            raise EdgeError(f"{printable(path)}: expected images NAME_{', NAME_'.join(views)} of each frame")
        frame = path.with_name(path.stem.removesuffix(view))
        if frame not in firsts or view == views[0]:
            firsts[frame] = path.with_name(f"{frame.name}{views[0]}{path.suffix}")
    return list(firsts.values())


def _kept(session: Session, frame: Frame, result: dict | None, seconds: float, summary: Summary) -> int:
    """Write a frame's result and print a line about it; return its status."""
    if result is None:
        results.remove(summary.path.parent / f"{frame.name}.npz")
        summary.add(frame.name, frame.path, f"unreadable: {frame.reason}", None, {})
        print(frame.says(frame.reason), file=sys.stderr)
        return UNREADABLE
    status = int(result["status"])
    text, origin = status_in_words(session, result, frame.lacking), frame.origin | {"seconds": seconds}
    results.save(summary.path.parent / f"{frame.name}.npz", result | origin)
    summary.add(frame.name, frame.path, text, result, origin)
    if status:
        print(frame.says(text), file=sys.stderr)
    if status in FINISHED:
        print(printable(f"{frame.name}: {line(session, result)}, {1000 * seconds:.0f} ms"), flush=True)
    return status


def watch(session: Session, camera: int, frames: int | None) -> int:
    """Process the images of a camera, and print the result and the time of each on a line; Ctrl-C ends the loop."""
    import cv2

    if session.views:
        raise EdgeError(f"--camera {camera} of a model with the views {', '.join(session.views)}; expected image files")
    if hasattr(cv2, "setLogLevel"):
        cv2.setLogLevel(0)  # what goes wrong is said in this package's own words
    width, height = session.image_size
    capture = cv2.VideoCapture(camera)
    capture.set(cv2.CAP_PROP_FRAME_WIDTH, width)
    capture.set(cv2.CAP_PROP_FRAME_HEIGHT, height)
    capture.set(cv2.CAP_PROP_ORIENTATION_AUTO, 0)  # image files are not turned either
    number, result = 0, None
    try:
        while frames is None or number < frames:
            taken, image = capture.read()
            if not taken:
                raise EdgeError(
                    f"camera {camera} gives no image; expected one of {width} x {height} px: check its number, and that no "
                    "other program uses it"
                )
            start = time.perf_counter()
            result = session.run(_red_first(image), result)
            milliseconds = 1000 * (time.perf_counter() - start)
            first = {key: values[0] for key, values in result.items()}
            print(f"{number}: {line(session, first)}, {milliseconds:.1f} ms", flush=True)
            number += 1
    except KeyboardInterrupt:
        pass
    finally:
        capture.release()
    return 0


def _red_first(image: np.ndarray) -> np.ndarray:
    """Convert a frame of OpenCV (grey, BGR or BGRA) to grey `[height, width]` or RGB."""
    channels = 1 if image.ndim == 2 else image.shape[-1]
    if channels == 1:
        return image.reshape(image.shape[:2])
    if channels not in (3, 4):
        raise EdgeError(f"the camera gives frames {list(image.shape)}; expected grey, BGR or BGRA")
    return image[..., 2::-1]


def line(session: Session, result: dict) -> str:
    """Return a line on a frame's result: status, deepest displacement, force and contacts."""
    status = int(result["status"])
    text = session.status_text(status)
    if status not in FINISHED:
        return text
    found = numbers(result, session.mesh["rest_normals"], session.length_unit, session.force_unit)
    length, force = session.length_unit, session.force_unit
    moved = np.linalg.norm(result["displacement"], axis=-1).max()
    said = [text.partition(":")[0], f"moved by at most {moved:.3g} {length}"]
    said.append(f"force {found['force']:.3g} {force} {_vector(found, 'force')}")
    for number in range(1, min(int(found["contacts"]), CONTACTS) + 1):
        patch = f"contact_{number}"
        push = found[f"{patch}_force"]
        said.append(f"contact at {_vector(found, patch)} {length}" + (f" of {push:.3g} {force}" if np.isfinite(push) else ""))
    return ", ".join(said)


def _vector(found: dict, name: str) -> str:
    parts = [f"{found[f'{name}_{axis}']:.3g}" for axis in AXES]
    return f"({', '.join(parts)})"


def _whole(least: int, most: int) -> Callable[[str], int]:
    """Return the argument type of a whole number within bounds."""

    def number(text: str) -> int:
        if not re.fullmatch("[0-9]{1,9}", text) or not least <= int(text) <= most:
            raise argparse.ArgumentTypeError(f"{text!r}; expected a whole number from {least} to {most}")
        return int(text)

    return number


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="torchmembrane-edge", description="Images to surfaces with a model from `torchmembrane export`.",
        epilog="exit code: 0 all well, 1 some frames failed, 2 wrong usage or model, 130 interrupted", allow_abbrev=False,
    )  # fmt: skip
    add = parser.add_argument
    add("model", metavar="MODEL.onnx", help="the exported model of the sensor")
    images = "image files, patterns, folders; several pictures in a file are frames of it; to a model that tracks, a video's"
    add("images", metavar="IMAGES", nargs="*", help=images)
    add("--out", metavar="DIR", type=Path, help="folder of the results: NAME.npz, mesh.npz and summary.csv")
    batch = "images computed at once (default: %(default)s; tracking: 1)"
    add("--batch", metavar="N", type=_whole(1, MOST_BATCH), default=1, help=batch)
    threads = "of onnxruntime (default: %(default)s)"
    add("--threads", metavar="N", type=_whole(1, MOST_THREADS), default=1, help=threads)
    add("--providers", metavar="NAME", nargs="+", default=["CPUExecutionProvider"], help="providers of onnxruntime, in order")
    camera = "instead of images: a camera's, a line printed for each (OpenCV)"
    add("--camera", metavar="NUMBER", type=_whole(0, MOST_NUMBER), help=camera)
    add("--frames", metavar="N", type=_whole(1, MOST_NUMBER), help="stop the camera after so many")
    return parser
