"""The command `torchmembrane-edge`. Exit codes: 0 all well, 1 some frames failed, 2 wrong usage."""

import argparse
import re
import sys
import time
from importlib.util import find_spec
from pathlib import Path

import numpy as np

from .session import EdgeError, Session, grey

FINISHED = (0, 3, 7, 8)  # ok; not converged, unexplained, partly hidden: the answer is kept
MESH = "mesh.npz"


def main(argv=None) -> int:
    """Run the command with these arguments; returns the exit code."""
    arguments = _parser().parse_args(argv)
    try:
        session = Session(arguments.model, arguments.threads, arguments.providers)
        if arguments.camera is not None:
            return watch(session, arguments.camera, arguments.frames)
        if not arguments.images or not arguments.out:
            raise EdgeError("nothing to do; expected IMAGES and --out DIR, or --camera NUMBER")
        if arguments.batch < 1:
            raise EdgeError(f"--batch {arguments.batch}; expected at least 1")
        return reconstruct(session, in_order(arguments.images), arguments.out, 1 if session.tracks else arguments.batch)
    except (EdgeError, OSError) as error:
        print(f"torchmembrane-edge: error: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        return 0


def in_order(paths: list) -> list:
    """The paths as they are given; in the order of the numbers in their names where they come as shells expand a pattern."""

    def numbered(path):
        parts = re.split("([0-9]+)", str(path))  # texts at even places, numbers at odd ones
        digits = [part.lstrip("0") for part in parts]
        return [(len(digits[k]), digits[k]) if k % 2 else (-1, part) for k, part in enumerate(parts)], str(path)

    return sorted(paths, key=numbered) if paths == sorted(paths) else paths


def reconstruct(session: Session, paths: list, out: Path, batch: int) -> int:
    """Every image's result as `NAME.npz` in the folder `out`, with `mesh.npz`; a model that tracks takes them for a video."""
    if find_spec("PIL") is None:
        raise EdgeError('image files need Pillow, which is not installed: pip install "torchmembrane-edge[images]"')
    if len({path.stem for path in paths}) < len(paths):
        raise EdgeError("two images of one name; results bear it: rename, or use two calls")
    if any(path.stem == Path(MESH).stem for path in paths):
        raise EdgeError(f"an image's result would be {MESH}, which holds the mesh: rename the image")
    _write_mesh(out, session.mesh)
    failed, results = 0, None
    for begin in range(0, len(paths), batch):
        frames = []
        for path in paths[begin : begin + batch]:
            try:
                frames.append((path, _read(path, session.image_size)))
            except EdgeError as error:
                failed += 1
                print(f"{path}: {error}", file=sys.stderr)
        if not frames:
            continue
        results = session.run(np.concatenate([image for _, image in frames]), results)
        for i, (path, _) in enumerate(frames):
            _save(out / f"{path.stem}.npz", {key: values[i] for key, values in results.items()})
            status = int(results["status"][i])
            if status:
                print(f"{path}: {session.status_texts[status]}", file=sys.stderr)
            failed += status not in FINISHED
    print(f"frames: {len(paths) - failed} reconstructed, {failed} failed; results in {out}")
    return 1 if failed else 0


def watch(session: Session, camera: int, frames: int | None) -> int:
    """Images of a camera, a line each: what was found and how long it took."""
    try:
        import cv2
    except ImportError as error:
        raise EdgeError("a camera needs OpenCV, which is not installed: pip install opencv-python-headless") from error
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
                raise EdgeError(f"camera {camera} gives no image; expected one of {width} x {height} px")
            start = time.perf_counter()
            result = session.run(_red_first(image)[None], result)
            milliseconds = 1000 * (time.perf_counter() - start)
            print(f"{number}: {_line(session, result)}, {milliseconds:.1f} ms", flush=True)
            number += 1
    finally:
        capture.release()
    return 0


def _red_first(image: np.ndarray) -> np.ndarray:
    """A frame of OpenCV's - grey, BGR or BGRA - as grey `[height, width]` or RGB."""
    channels = 1 if image.ndim == 2 else image.shape[-1]
    if channels == 1:
        return image.reshape(image.shape[:2])
    if channels not in (3, 4):
        raise EdgeError(f"the camera gives frames {list(image.shape)}; expected grey, BGR or BGRA")
    return image[..., 2::-1]


def _line(session: Session, result: dict) -> str:
    status = int(result["status"][0])
    if status not in FINISHED:
        return session.status_texts[status]
    moved = np.linalg.norm(result["displacement"][0], axis=-1).max()
    force = np.linalg.norm(result["force"][0])
    return f"moved by at most {moved:.3g} {session.length_unit}, force {force:.3g} {session.force_unit}"


def _read(path: Path, size) -> np.ndarray:
    """An image file as grey values `[1, height, width]`."""
    from PIL import Image

    try:
        with Image.open(path) as image:
            plain = image.mode in ("1", "L", "LA", "La")
            wide = image.mode == "F" or image.mode.startswith("I;16")
            array = np.asarray(image if wide else image.convert("L" if plain else "RGB"))
    except (OSError, SyntaxError, ValueError) as error:
        raise EdgeError(f"not readable as an image ({error})") from error
    values = grey(array[None])
    if values.shape[:0:-1] != tuple(size):
        raise EdgeError(f"the image is {values.shape[2]} x {values.shape[1]} px, the sensor's are {size[0]} x {size[1]}")
    return values


def _write_mesh(out: Path, mesh: dict) -> None:
    out.mkdir(parents=True, exist_ok=True)
    if (out / MESH).exists():
        with np.load(out / MESH) as there:
            for key in ("sensor", "estimator", "energy", "element"):
                if str(there[key]) != mesh[key]:
                    raise EdgeError(f"{out} holds results of another {key} ({there[key]}, not {mesh[key]}); choose another")
    _save(out / MESH, mesh)


def _save(path: Path, arrays: dict) -> None:
    """Whole or not at all."""
    partial = path.with_name(path.name + ".partial")
    with open(partial, "wb") as file:
        np.savez(file, **arrays)
    partial.replace(path)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="torchmembrane-edge", description="Images to surfaces with a model from `torchmembrane export`.",
        epilog="exit code: 0 all well, 1 some frames failed, 2 wrong usage or model",
    )  # fmt: skip
    add = parser.add_argument
    add("model", metavar="MODEL.onnx", help="the exported model of the sensor")
    add("images", metavar="IMAGES", nargs="*", type=Path, help="image files; to a model that tracks, a video's in order")
    add("--out", metavar="DIR", type=Path, help="folder of the results: NAME.npz and mesh.npz")
    add("--batch", metavar="N", type=int, default=1, help="images computed at once (default: %(default)s; tracking: 1)")
    add("--threads", metavar="N", type=int, default=1, help="of onnxruntime (default: %(default)s)")
    add("--providers", metavar="NAME", nargs="+", default=["CPUExecutionProvider"], help="of onnxruntime, in order")
    add("--camera", metavar="NUMBER", type=int, help="instead of images: a camera's, a line printed for each (OpenCV)")
    add("--frames", metavar="N", type=int, help="stop the camera after so many")
    return parser
