"""The largest load of a stream, and of a sensor's life, which is stored in a file that the user names."""

import json
from datetime import date
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import MembraneError
from ..files.atomic import write_text
from ..files.safe_read import read_text
from ..results.reconstruction import Frame
from ..results.status import Status
from ..results.store import Mesh

COUNTED = (Status.OK, Status.OUT_OF_RANGE)
"""Statuses of the frames whose loads count; other frames have unreliable results."""
MOST_BYTES = 2**16
EXPECTED = "the file of a sensor's life as `live --life` keeps it"
NUMBERS = ("force", "depth", "frames")


class Peaks:
    """The largest force and depth of the frames added so far.

    Args:
        mesh: mesh of the stream.

    Attributes:
        force: magnitude of the largest contact force; zero if no frame has counted.
        depth: largest displacement along the inward rest normal.
        frames: number of frames that counted.
    """

    def __init__(self, mesh: Mesh):
        self.mesh = mesh
        self.force = self.depth = 0.0
        self.frames = 0

    def add(self, frame: Frame) -> None:
        """Add a frame; only frames with status ok or out of range count."""
        if int(frame["status"]) in COUNTED:
            self.force = max(self.force, float(np.linalg.norm(frame["force"])))
            self.depth = max(self.depth, -float(self.mesh.normal_displacement(frame).min()))
            self.frames += 1

    @property
    def said(self) -> str:
        """Return a description in words."""
        return f"peaks of {self.frames} frames: {_load(self.force, self.depth, self.mesh)}"

    def kept_in(self, path: Path) -> str:
        """Merge the peaks into the file of the sensor's life, and return a description of the merged values.

        Args:
            path: path of the file; it is created if it does not exist.

        Raises:
            MembraneError: the file is of another kind, or of a sensor with another name or other units.
        """
        mesh = self.mesh
        own = {"name": mesh.name, "length_unit": mesh.length_unit, "force_unit": mesh.force_unit}
        new: dict[str, Any] = own | dict.fromkeys(NUMBERS, 0) | {"since": date.today().isoformat()}
        life = _read(path) if path.exists() else new
        if other := {key: life.get(key) for key in own if life.get(key) != own[key]}:
            raise MembraneError(f"--life {path}: of a sensor with {other}; expected {own}: name another file")
        life |= {"force": max(life["force"], self.force), "depth": max(life["depth"], self.depth)}
        life |= {"frames": life["frames"] + self.frames, "latest": date.today().isoformat()}
        write_text(path, json.dumps(life, indent=1, ensure_ascii=False) + "\n")
        return f"since {life['since']}, {life['frames']} frames: {_load(life['force'], life['depth'], mesh)}; kept in {path}"


def _load(force: float, depth: float, mesh: Mesh) -> str:
    unit = "relative" if mesh.force_unit == "relative" else mesh.force_unit
    return f"force {force:.3g} {unit}, depth {depth:.3g} {mesh.length_unit}"


def _read(path: Path) -> dict[str, Any]:
    try:
        life = json.loads(read_text(path, MOST_BYTES, EXPECTED))
        if not all(isinstance(life[key], int | float) and life[key] >= 0 for key in NUMBERS) or not isinstance(
            life["since"], str
        ):
            raise ValueError
    except (ValueError, TypeError, KeyError) as error:
        if isinstance(error, MembraneError):
            raise
        raise MembraneError(f"--life {path}: not readable; expected {EXPECTED}: name another file") from error
    return dict(life)
