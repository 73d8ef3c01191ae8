"""What `make measure` measures, part by part: the command, its data, and the paths whose change makes the figures old."""

import re
import shlex
from typing import NamedTuple

FRAME = ("torchmembrane/camera", "torchmembrane/estimators", "torchmembrane/markers", "torchmembrane/mechanics")
FRAME += ("torchmembrane/reconstruct.py", "torchmembrane/solve", "torchmembrane/surface")
EXPORT = (*FRAME, "torchmembrane/onnx", "torchmembrane/control_flow.py")
CASES = (*FRAME, "bench/data/cases.py")
RANDOM = (*FRAME, "bench/data/random_sensors.py")
SIMULATOR = ("torchmembrane/simulate", "torchmembrane/mechanics", "torchmembrane/surface")
CLI = (*FRAME, "torchmembrane/cli", "torchmembrane/calibrate", "torchmembrane/presets")
SEEDS = (9001, 9002, 9003)
RANDOM_SENSORS = "bench.data.random_sensors DATA"
MADE = {
    "cases": ("bench.data.cases CASES",),
    "independent": (),
    "light": (f"{RANDOM_SENSORS} --sensors 20 --presses 0 --light 54 --seed 2026",),
    "gauge": (f"{RANDOM_SENSORS} --sensors 14 --presses 2 --light 8",),
    "intervals": tuple(f"{RANDOM_SENSORS}/{seed} --sensors 40 --presses 2 --light 6 --seed {seed}" for seed in SEEDS),
    "range": (f"{RANDOM_SENSORS} --sensors 240 --presses 4 --seed 8126",),
}
"""Folders of data, and what makes them. Nothing makes the independent ones: `make measure INDEPENDENT=FOLDER` names them."""


class Part(NamedTuple):
    """One command that writes one record.

    Attributes:
        command: a module of bench and its arguments. CASES or DATA stands for the folder of data.
        measures: paths that the figures depend on, besides the module itself.
        data: which folder of `MADE` the command needs.
        needs_gpu: whether it is left out on a machine without a GPU.
    """

    command: str
    measures: tuple[str, ...] = FRAME
    data: str | None = None
    needs_gpu: bool = False

    @property
    def paths(self) -> tuple[str, ...]:
        """Paths whose change makes the figures old."""
        return (f"{self.command.split()[0].replace('.', '/')}.py", *self.measures)

    @property
    def shown(self) -> str:
        """The command, after the one that makes its data, as documents print it."""
        made = MADE[self.data] if self.data else ()
        return " && ".join(f"python -m {command}" for command in (*made, self.command))


def words(command: str, folder: str) -> list[str]:
    """A command's words, the folder in place of CASES and DATA.

    >>> words("bench.data.cases CASES/a", "out")
    ['bench.data.cases', 'out/a']
    """
    return [re.sub("^(CASES|DATA)(?=/|$)", folder, word) for word in shlex.split(command)]


PARTS = {
    "frame": Part("bench.speed.frame"),
    "training": Part("bench.speed.training --turns 5"),
    "force-balance": Part("bench.speed.speed --only force-balance"),
    "minimum-energy": Part("bench.speed.speed --only minimum-energy"),
    "paper-chain": Part("bench.speed.speed --only paper --image examples/two_contacts.png"),
    "exported-models": Part("bench.speed.exported_models", EXPORT),
    "scaling": Part("bench.speed.scaling"),
    "simulator": Part("bench.accuracy.simulator", SIMULATOR),
    "one-dimension": Part("bench.accuracy.one_dimension", ("torchmembrane/estimators/paper/studies",)),
    "window-mistakes": Part("bench.accuracy.window_mistakes", (*CLI, "torchmembrane/forming")),
    "windows": Part("bench.accuracy.window_commands", (*CLI, "torchmembrane/forming", "bench/accuracy/windows.py")),
    "cli-errors": Part("bench.robustness.cli_errors", CLI),
    "memory": Part("bench.speed.memory", (*FRAME, "torchmembrane/jobs/workers.py")),
    "gpu": Part("bench.speed.gpu --batches 1 4 16 64 256 1024 2048", needs_gpu=True),
    "independent": Part("bench.accuracy.accuracy CASES", data="independent"),
    "simulator-independent": Part("bench.accuracy.simulator CASES", SIMULATOR, data="independent"),
    "cases": Part("bench.accuracy.accuracy CASES", CASES, data="cases"),
    "locators": Part("bench.accuracy.locators CASES", ("torchmembrane/markers", "bench/data/cases.py"), data="cases"),
    "segmentation": Part("bench.accuracy.segmentation CASES", CASES, data="cases"),
    "monge": Part("bench.accuracy.monge CASES", CASES, data="cases"),
    "ablation": Part("bench.accuracy.ablation CASES", CASES, data="cases"),
    "gauge": Part("bench.accuracy.gauge DATA", RANDOM, data="gauge"),
    "views": Part("bench.accuracy.views --first 1 --sensors 20 --presses 3", (*RANDOM, "torchmembrane/simulate")),
    "light": Part("bench.accuracy.range DATA --only light", RANDOM, data="light"),
    "intervals": Part(f"bench.accuracy.intervals {' '.join(f'DATA/{seed}' for seed in SEEDS)}", RANDOM, data="intervals"),
    "range": Part("bench.accuracy.range DATA", RANDOM, data="range"),
}
"""In the order in which they are measured, the quick ones first."""
