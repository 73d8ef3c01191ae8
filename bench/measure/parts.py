"""What `make measure` measures, part by part: the command, its data, and the paths whose change makes the figures old."""

import shlex
from typing import NamedTuple

FRAME = ("torchmembrane/camera", "torchmembrane/estimators", "torchmembrane/markers", "torchmembrane/mechanics")
FRAME += ("torchmembrane/reconstruct.py", "torchmembrane/solve", "torchmembrane/surface")
EXPORT = (*FRAME, "torchmembrane/onnx", "torchmembrane/control_flow.py")
CASES = (*FRAME, "bench/data/cases.py")
MADE = {
    "cases": "bench.data.cases CASES",
    "independent": None,
}
"""Folders of data, and what makes them; None: not distributed, `make measure INDEPENDENT=FOLDER` names it."""


class Part(NamedTuple):
    """One command that writes one record.

    Attributes:
        command: a module of bench and its arguments. CASES or DATA stands for the folder of data.
        measures: paths that the figures depend on, besides the module itself.
        data: which folder of `MADE` the command needs.
    """

    command: str
    measures: tuple[str, ...] = FRAME
    data: str | None = None

    @property
    def paths(self) -> tuple[str, ...]:
        """Paths whose change makes the figures old."""
        return (f"{self.command.split()[0].replace('.', '/')}.py", *self.measures)

    @property
    def shown(self) -> str:
        """The command, after the one that makes its data, as documents print it."""
        made = MADE[self.data] if self.data else None
        return " && ".join(f"python -m {command}" for command in (made, self.command) if command)


def words(command: str, folder: str) -> list[str]:
    """A command's words, the folder in place of CASES and DATA.

    >>> words("bench.data.cases CASES", "out")
    ['bench.data.cases', 'out']
    """
    return [folder if word in ("CASES", "DATA") else word for word in shlex.split(command)]


PARTS = {
    "frame": Part("bench.speed.frame"),
    "training": Part("bench.speed.training --turns 5"),
    "force-balance": Part("bench.speed.speed --only force-balance"),
    "minimum-energy": Part("bench.speed.speed --only minimum-energy"),
    "paper-chain": Part("bench.speed.speed --only paper --image examples/two_contacts.png"),
    "exported-models": Part("bench.speed.exported_models", EXPORT),
    "scaling": Part("bench.speed.scaling"),
    "independent": Part("bench.accuracy.accuracy CASES", data="independent"),
    "cases": Part("bench.accuracy.accuracy CASES", CASES, data="cases"),
}
"""In the order in which they are measured, the quick ones first."""
