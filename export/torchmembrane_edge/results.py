"""The folder of a call's results: `NAME.npz` for each frame, and one `mesh.npz`."""

import io
import os
from collections.abc import Mapping
from hashlib import blake2b
from pathlib import Path
from typing import Any

import numpy as np

from .errors import EdgeError, in_one_line, printable

MESH = "mesh.npz"
SETTINGS = ("estimator", "energy", "element", "format", "volume", "flow", "smoothing", "locator", "rest", "pressure",
            "pressure_noise", "fields")  # fmt: skip
"""Mesh entries that all results in a folder share in addition to the sensor. Files of earlier versions lack some."""


def refuse_file(out: Path) -> None:
    """Refuse a results path that is a file."""
    if out.exists() and not out.is_dir():
        raise EdgeError(f"--out {printable(out)}: is a file; expected a new folder, or one with earlier results of this sensor")


def begin(out: Path, mesh: Mapping[str, Any]) -> None:
    """Write `mesh.npz`, into a folder that is new or holds results of the same sensor and settings.

    Raises:
        EdgeError: the folder holds other results, or cannot be written to.
    """
    said = f"--out {printable(out)}"
    refuse_file(out)
    try:
        out.mkdir(parents=True, exist_ok=True)
        others = any(out.glob("*.npz")) or (out / "frames").exists()
    except OSError as error:
        raise EdgeError(f"{said}: cannot be made ({error.strerror}); expected a folder: choose another") from error
    if not (out / MESH).exists():
        if others:
            raise EdgeError(f"{said}: holds .npz files or frames/ but no {MESH}; choose another folder")
    else:
        there = _read(out / MESH)
        if there["sensor"] != mesh["sensor"]:
            other = f"{in_one_line(repr(there['name']))} ({in_one_line(there['sensor'])[:12]}, here {mesh['sensor'][:12]})"
            raise EdgeError(f"{said}: holds results of another sensor, {other}; choose another folder")
        for key in SETTINGS:
            if key in there and key in mesh and there[key] != mesh[key]:
                before = in_one_line(there[key])
                raise EdgeError(f"{said}: was made with {key} {before}, the model has {mesh[key]}; choose another folder")
    save(out / MESH, mesh)


def save(path: Path, arrays: Mapping[str, Any]) -> None:
    """Write arrays to a file atomically: completely or not at all.

    Raises:
        EdgeError: the file cannot be written.
    """
    content = io.BytesIO()
    np.savez(content, **arrays)
    write(path, content.getbuffer())


def write(path: Path, content: bytes | memoryview) -> None:
    """Write the content of a file atomically: completely or not at all.

    Raises:
        EdgeError: the file cannot be written.
    """
    partial = path.with_name(f".{blake2b(os.fsencode(path.name), digest_size=8).hexdigest()}-{os.getpid()}.partial")
    try:
        try:
            partial.write_bytes(content)
            partial.replace(path)
        finally:
            partial.unlink(missing_ok=True)
    except OSError as error:
        cause = f"{printable(path)}: cannot be written ({error.strerror})"
        raise EdgeError(f"{cause}; expected a folder with space that can be written: what is done so far is kept") from error


def remove(path: Path) -> None:
    """Remove an earlier result, if there is one.

    Raises:
        EdgeError: it cannot be removed.
    """
    try:
        path.unlink(missing_ok=True)
    except OSError as error:
        cause = f"{printable(path)}: an earlier result, cannot be removed ({error.strerror})"
        raise EdgeError(f"{cause}; expected a folder that can be written: remove it yourself") from error


def file_name(path: Path) -> str:
    """Return the name of the image file of a result; an empty text if it is unknown or the result is damaged."""
    try:
        with np.load(path) as file:
            return Path(file["path"].item()).name
    except Exception:  # numpy and zipfile raise what they like of damaged files
        return ""


def _read(path: Path) -> dict[str, Any]:
    """Return the texts and numbers of an earlier `mesh.npz`."""
    try:
        with np.load(path) as file:
            found = {key: file[key].item() for key in ("name", "sensor", *SETTINGS) if key in file.files}
        if missing := [key for key in ("name", "sensor") if not isinstance(found.get(key), str)]:
            raise ValueError(f"it has no {missing[0]}")
    except Exception as error:  # numpy and zipfile raise what they like of damaged files
        cause = f"{printable(path)}: not a {MESH} of torchmembrane ({in_one_line(error)})"
        raise EdgeError(f"{cause}; expected the {MESH} that is written beside results: choose another folder") from error
    return found
