"""The validated working range of a sensor: a result outside it keeps its values and gets status 9."""

from math import ceil, cos, inf, radians
from pathlib import Path
from typing import NamedTuple

from torch import Tensor

from ..files.atomic import write_text
from ..surface.membrane import Membrane
from .table import Table, toml_lines

TURNED = 0.02
"""Share of the vertices whose normals may have turned by more than the limit."""
HEAD = """\
# The range in which `torchmembrane check --accuracy` showed this sensor's answers right; results beyond it get status 9.
# depth: over the surface's size; turn: degrees by which the surface turns; force: the sensor's force unit"""


class WorkingRange(NamedTuple):
    """Limits of reconstructed (not true) quantities.

    Attributes:
        depth: largest displacement along the inward rest normal, over the surface's size.
        turn: largest rotation of the vertices' normals, degrees. The share `TURNED` of the vertices is excluded, because even a
            shallow press rotates the surface far beside the rim.
        force: largest magnitude of the contact force, the sensor's force unit.
        sensor: fingerprint of the sensor for which the range was found; empty: valid for any sensor.
    """

    depth: float
    turn: float = 180.0
    force: float = inf
    sensor: str = ""

    @classmethod
    def from_file(cls, path: Path) -> "WorkingRange":
        """Read a range that `to_file` has written.

        Raises:
            MembraneError: the file cannot be read, or does not contain a working range.
        """
        table = Table.from_file(path)
        table.allow(cls._fields)
        return cls(table.number("depth"), table.number("turn"), table.number("force"), table.text("sensor"))

    def to_file(self, path: Path) -> None:
        """Write the range as TOML, atomically."""
        write_text(path, "\n".join([HEAD, *toml_lines("", self._asdict())]) + "\n")

    def for_fingerprint(self, fingerprint: str) -> "WorkingRange":
        """Return this range if it is valid for the sensor of this fingerprint, else `GENERAL`."""
        return self if self.sensor in ("", fingerprint) else GENERAL

    def is_beyond(self, x: Tensor, normals: Tensor, traction: Tensor, membrane: Membrane) -> Tensor:
        """Return whether reconstructions are outside the range, `[B]` bool; False where a reconstruction is NaN.

        Args:
            x: vertices of the reconstructed surface, `[B, V, 3]`.
            normals: its outward unit normals, `[B, V, 3]`.
            traction: contact force per rest area, `[B, V, 3]`.
            membrane: the rest surface.
        """
        rest, force = membrane.rest_normals, (traction * membrane.rest_area[:, None]).sum(1)
        depth = ((membrane.rest - x) * rest).sum(-1).amax(-1)
        steep = turn_cosine(normals, rest) < cos(radians(self.turn))
        beyond: Tensor = (depth > self.depth * membrane.size) | steep | (force.norm(dim=-1) > self.force)
        return beyond


def turn_cosine(normals: Tensor, rest: Tensor) -> Tensor:
    """Return the cosine of the angle that only the share `TURNED` of the normals exceeds, `[B]`.

    Args:
        normals: unit normals, `[B, V, 3]`.
        rest: unit normals at rest, `[V, 3]`.
    """
    cosine: Tensor = (normals * rest).sum(-1).topk(ceil(TURNED * len(rest)), largest=False).values.amax(-1)
    return cosine


GENERAL = WorkingRange(depth=0.3, turn=75.0)
"""Default range; `docs/accuracy.md` says on which sensors it was validated."""
UNLIMITED = WorkingRange(depth=inf)


def range_file(sensor: Path) -> Path:
    """Return the path of the file that stores the range of a sensor file.

    Example:
        >>> range_file(Path("day/sensor.toml")).name
        'sensor_range.toml'
    """
    return sensor.with_name(f"{sensor.stem}_range.toml")
