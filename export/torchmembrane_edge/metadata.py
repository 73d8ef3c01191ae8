"""Validation of a model's metadata on its sensor: the file may be damaged or come from an untrusted source."""

import json
import re
import warnings
from typing import Any, NamedTuple

import numpy as np

from . import __version__
from .errors import EdgeError, in_one_line

FORMAT = "1"
EXPECTED = "a model from `torchmembrane export`: export it again"
TEXTS = ("name", "length_unit", "force_unit")
MESH_TEXTS = (*TEXTS, "sensor", "estimator", "energy", "element", "format")
NUMBERS, WHOLE, FLAGS = ("iuf", np.float32), ("iu", np.int64), ("b", np.bool_)
MESH_ARRAYS = {
    "rest_vertices": (NUMBERS, ("V", 3)),
    "rest_normals": (NUMBERS, ("V", 3)),
    "triangles": (WHOLE, ("T", 3)),
    "fixed": (FLAGS, ("V",)),
    "grid": (WHOLE, (2,)),
    "vertex_pixels": (NUMBERS, ("V", 2)),
    "rest_pixels": (NUMBERS, ("D", 2)),
    "image_size": (WHOLE, (2,)),
    "camera_in_tool": (NUMBERS, ("R", 4)),
}
"""Dtype kind and shape of each mesh array; letters stand for numbers of vertices, triangles, dots and rows (3, or none)."""


class Metadata(NamedTuple):
    """A model's metadata on its sensor.

    Attributes: `name`, `length_unit`, `force_unit`; `status_texts`, from code to text; `mesh`, the content of `mesh.npz`;
        `bits`, the bit depth of the camera, if 16-bit images use fewer bits, else None.
    """

    name: str
    length_unit: str
    force_unit: str
    status_texts: dict[int, str]
    mesh: dict[str, Any]
    bits: int | None

    @classmethod
    def from_properties(cls, known: dict[str, str], model: str) -> "Metadata":
        """Return the checked metadata of a model; `model` is its path, for messages.

        Raises:
            EdgeError: an entry is missing, or is not in the format of `torchmembrane export`.
        """
        if known.get("format") != FORMAT:
            raise EdgeError(f"{model}: format {known.get('format')!r}; expected {FORMAT!r}, of {EXPECTED}")
        try:
            if missing := [key for key in (*TEXTS, "status_texts", "mesh") if not known.get(key)]:
                raise ValueError(f"{missing[0]} is missing")
            texts = _parsed("status_texts", known["status_texts"])
            if not all(isinstance(text, str) and code.isdecimal() for code, text in texts.items()):
                raise ValueError("status_texts are not texts by their codes")
            mesh = _mesh(_parsed("mesh", known["mesh"]))
            if other := [key for key in ("length_unit", "force_unit") if mesh[key] != known[key]]:
                raise ValueError(f"{other[0]} is {known[other[0]]!r}, of the mesh {mesh[other[0]]!r}")
            bits = int(known["bits"]) if known.get("bits") else None
            if bits is not None and not 8 <= bits <= 16:
                raise ValueError(f"bits is {bits}, not 8 to 16")
        except (ValueError, OverflowError, RecursionError) as error:
            raise EdgeError(
                f"{model}: its metadata are not readable ({in_one_line(error)}); expected those of {EXPECTED}"
            ) from error
        _compare_versions(known.get("version", ""), model)
        return cls(*(known[key] for key in TEXTS), {int(code): text for code, text in texts.items()}, mesh, bits)


def _compare_versions(made: str, model: str) -> None:
    """Warn about a model from a later version, whose content may be unknown to this version."""
    parts, here = (tuple(map(int, re.findall(r"\d+", version)[:2])) for version in (made, __version__))
    if parts > here:
        warnings.warn(
            f"{model}: made by torchmembrane {in_one_line(made)}; expected one of this torchmembrane-edge's version, "
            f"{__version__}, or before: install the later torchmembrane-edge",
            stacklevel=4,
        )


def _parsed(key: str, text: str) -> dict[str, Any]:
    value = json.loads(text)
    if not isinstance(value, dict):
        raise ValueError(f"{key} is a {type(value).__name__}, not names with values")
    return value


def _mesh(found: dict[str, Any]) -> dict[str, Any]:
    """Return the mesh with its arrays converted; its other entries, which older models may lack, are settings."""
    found = {"camera_in_tool": []} | found
    if missing := [key for key in (*MESH_TEXTS, *MESH_ARRAYS) if key not in found]:
        raise ValueError(f"mesh lacks {missing[0]}")
    if wrong := [key for key in (*MESH_TEXTS, "view_names") if not isinstance(found.get(key, ""), str)]:
        raise ValueError(f"mesh: {wrong[0]} is not text")
    sizes: dict[str, int] = {}
    mesh = found | {key: _array(key, found[key], sizes) for key in MESH_ARRAYS}
    if min(mesh["image_size"]) < 1 or mesh["grid"].prod() != sizes["V"] or sizes["R"] not in (0, 3):
        said = [f"{key} {mesh[key].tolist()}" for key in ("image_size", "grid", "camera_in_tool")]
        raise ValueError(f"mesh: {', '.join(said)} of {sizes['V']} vertices")
    if not np.isin(mesh["triangles"], np.arange(sizes["V"])).all():
        raise ValueError("mesh: its triangles refer to vertices that do not exist")
    return mesh


def _array(key: str, value: Any, sizes: dict[str, int]) -> np.ndarray:
    """Return an array of the mesh; `sizes` collects the lengths that the letters stand for."""
    (kinds, dtype), shape = MESH_ARRAYS[key]
    array = np.array(value)
    if key == "rest_pixels" and array.ndim == 3:  # of several views
        shape = ("W", array.shape[1], 2)
    if not array.size:
        array = np.zeros((0, *shape[1:]), dtype)  # none is `[]` in JSON, whatever its shape
    rows = sizes.setdefault(shape[0], len(array)) if array.ndim and isinstance(shape[0], str) else shape[0]
    wanted = (rows, *shape[1:])
    if array.dtype.kind not in kinds or array.shape != wanted:
        raise ValueError(f"mesh: {key} is {array.dtype} {list(array.shape)}, not {list(shape)}")
    return array.astype(dtype)
