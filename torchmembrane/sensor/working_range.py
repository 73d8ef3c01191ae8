"""The range in which a sensor's answers were shown right: a result beyond it keeps its answer, with status 9."""

from math import ceil, cos, inf, radians
from pathlib import Path
from typing import NamedTuple

from torch import Tensor

from ..files.atomic import write_text
from ..surface.membrane import Membrane
from .table import Table, toml_lines

TURNED = 0.02
"""Share of the vertices that may have turned further."""
HEAD = """\
# The range in which `torchmembrane check --accuracy` showed this sensor's answers right; results beyond it get status 9.
# depth: over the surface's size; turn: degrees by which the surface turns; force: the sensor's force unit"""


class WorkingRange(NamedTuple):
    """Limits of what is found, not of what is true.

    Attributes:
        depth: the deepest displacement along the inward rest normal, over the surface's size.
        turn: the angle by which all but `TURNED` of the vertices' normals turn at most, degrees: beside the rim a press that
            is not deep turns the surface far.
        force: magnitude of the contact force, the sensor's force unit.
        sensor: fingerprint of the sensor that it was found for; empty: of any.
    """

    depth: float
    turn: float = 180.0
    force: float = inf
    sensor: str = ""

    @classmethod
    def from_file(cls, path: Path) -> "WorkingRange":
        """Read what `to_file` wrote.

        Raises:
            MembraneError: the file cannot be read, or holds something else.
        """
        table = Table.from_file(path)
        table.allow(cls._fields)
        return cls(table.number("depth"), table.number("turn"), table.number("force"), table.text("sensor"))

    def to_file(self, path: Path) -> None:
        """Write it as TOML, whole or not at all."""
        write_text(path, "\n".join([HEAD, *toml_lines("", self._asdict())]) + "\n")

    def for_fingerprint(self, fingerprint: str) -> "WorkingRange":
        """This one where it was found for the sensor of this fingerprint, or for any; else `GENERAL`."""
        return self if self.sensor in ("", fingerprint) else GENERAL

    def is_beyond(self, x: Tensor, normals: Tensor, traction: Tensor, membrane: Membrane) -> Tensor:
        """Whether what is found is outside, `[B]` bool; False where nothing is found.

        Args:
            x: the surface, `[B, V, 3]`.
            normals: its outward normals, unit, `[B, V, 3]`.
            traction: contact force per rest area, `[B, V, 3]`.
            membrane: the rest surface.
        """
        rest, force = membrane.rest_normals, (traction * membrane.rest_area[:, None]).sum(1)
        depth = ((membrane.rest - x) * rest).sum(-1).amax(-1)
        steep = turn_cosine(normals, rest) < cos(radians(self.turn))
        beyond: Tensor = (depth > self.depth * membrane.size) | steep | (force.norm(dim=-1) > self.force)
        return beyond


def turn_cosine(normals: Tensor, rest: Tensor) -> Tensor:
    """The cosine of the angle that all but `TURNED` of the normals have turned by at most, `[B]`.

    Args:
        normals: unit, `[B, V, 3]`.
        rest: the same at rest, `[V, 3]`.
    """
    cosine: Tensor = (normals * rest).sum(-1).topk(ceil(TURNED * len(rest)), largest=False).values.amax(-1)
    return cosine


GENERAL = WorkingRange(depth=0.175, turn=60.0)
"""Range of sensors that have none of their own; `docs/accuracy.md` says on which sensors it was found."""
UNLIMITED = WorkingRange(depth=inf)


def range_file(sensor: Path) -> Path:
    """Where the range of a sensor file is kept.

    Example:
        >>> range_file(Path("day/sensor.toml")).name
        'sensor_range.toml'
    """
    return sensor.with_name(f"{sensor.stem}_range.toml")
