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
PRESSED = (*FRAME, "torchmembrane/simulate")
JOBS = (*FRAME, "torchmembrane/jobs", "torchmembrane/files", "torchmembrane/results")
FILES = ("torchmembrane/files", "torchmembrane/sensor", "bench/robustness/fuzz_kinds.py", "bench/robustness/malformed_files.py")
SEEDS = (9001, 9002, 9003)
RANDOM_SENSORS = "bench.data.random_sensors DATA"
MADE = {
    "cases": ("bench.data.cases CASES",),
    "independent": (),
    "recordings": (),
    "light": (f"{RANDOM_SENSORS} --sensors 20 --presses 0 --light 54 --seed 2026",),
    "gauge": (f"{RANDOM_SENSORS} --sensors 14 --presses 2 --light 8",),
    "intervals": tuple(f"{RANDOM_SENSORS}/{seed} --sensors 40 --presses 2 --light 6 --seed {seed}" for seed in SEEDS),
    "range": (f"{RANDOM_SENSORS} --sensors 160 --presses 4 --seed 8126",),
    "sequence": (f"{RANDOM_SENSORS} --sensors 10 --presses 0 --light 20 --seed 41995",),
    "degraded-images": (f"{RANDOM_SENSORS} --sensors 15",),
    "precision": (),
    "live-exported": (),
}
"""Folders of data, and what makes them. Nothing makes `independent` and `recordings`, which are not distributed: `make measure
INDEPENDENT=FOLDER RECORDINGS=FOLDER` names them. `precision` and `live-exported` make their own."""


class Part(NamedTuple):
    """One command that writes one record.

    Attributes:
        command: a module of bench and its arguments. CASES or DATA stands for the folder of data.
        measures: paths that the figures depend on, besides the module itself.
        data: which folder of `MADE` the command needs.
        needs_gpu: whether it is left out on a machine without a GPU.
        python: another interpreter, where `make` has set one up; without it the part is left out.
        by_processor: whether the record keeps the latest results of every processor, the newest first.
    """

    command: str
    measures: tuple[str, ...] = FRAME
    data: str | None = None
    needs_gpu: bool = False
    python: str | None = None
    by_processor: bool = False

    @property
    def paths(self) -> tuple[str, ...]:
        """Paths whose change makes the figures old."""
        return (f"{self.command.split()[0].replace('.', '/')}.py", *self.measures)

    @property
    def shown(self) -> str:
        """The command, after the one that makes its data, as documents print it."""
        made = MADE[self.data] if self.data else ()
        return " && ".join(f"{self.python or 'python'} -m {command}" for command in (*made, self.command))


def words(command: str, folder: str) -> list[str]:
    """A command's words, the folder in place of CASES and DATA.

    >>> words("bench.data.cases CASES/a", "out")
    ['bench.data.cases', 'out/a']
    """
    return [re.sub("^(CASES|DATA)(?=/|$)", folder, word) for word in shlex.split(command)]


PARTS = {
    "frame": Part("bench.speed.frame", by_processor=True),
    "training": Part("bench.speed.training --turns 5"),
    "force-balance": Part("bench.speed.speed --only force-balance"),
    "minimum-energy": Part("bench.speed.speed --only minimum-energy"),
    "paper-chain": Part("bench.speed.speed --only paper --image examples/two_contacts.png"),
    "exported-models": Part("bench.speed.exported_models", EXPORT),
    "loading": Part("bench.speed.loading", EXPORT),
    "rim": Part(
        "bench.accuracy.rim",
        tuple(f"torchmembrane/{name}" for name in ("calibrate", "camera", "markers", "presets", "simulate")),
    ),
    "scaling": Part("bench.speed.scaling"),
    "simulator": Part("bench.accuracy.simulator", SIMULATOR),
    "one-dimension": Part("bench.accuracy.one_dimension", ("torchmembrane/estimators/paper/studies",)),
    "window-mistakes": Part("bench.accuracy.window_mistakes", (*CLI, "torchmembrane/forming")),
    "windows": Part("bench.accuracy.window_commands", (*CLI, "torchmembrane/forming", "bench/accuracy/windows.py")),
    "cli-errors": Part("bench.robustness.cli_errors", CLI),
    "memory": Part("bench.speed.memory", (*FRAME, "torchmembrane/jobs/workers.py")),
    "life": Part("bench.robustness.life", (*PRESSED, "torchmembrane/stiffness.py", "bench/robustness/mistakes.py")),
    "mistakes": Part("bench.robustness.mistakes", PRESSED),
    "pins": Part("bench.accuracy.pins", PRESSED),
    "contact-law": Part("bench.accuracy.contact_law", (*SIMULATOR, "torchmembrane/accuracy/contact_law.py")),
    "rest-shapes": Part(
        "bench.accuracy.rest_shapes --sensors 100", ("torchmembrane/forming", "torchmembrane/accuracy/rest_shape.py")
    ),
    "spec-sheets": Part("bench.accuracy.spec_sheets", (*PRESSED, "torchmembrane/accuracy")),
    "calibration": Part(
        "bench.accuracy.calibration lens ports rest effect views depth layout --seeds 1", (*PRESSED, "torchmembrane/calibrate")
    ),
    "material": Part("bench.accuracy.calibration material --seeds 1", (*PRESSED, "torchmembrane/calibrate")),
    "gauge-modulus": Part("bench.accuracy.calibration gauge --seeds 1", (*PRESSED, "torchmembrane/calibrate")),
    "weight": Part("bench.accuracy.weight", (*PRESSED, "torchmembrane/calibrate")),
    "drift": Part("bench.robustness.drift", (*PRESSED, "torchmembrane/track.py", "bench/data/random_sensors.py")),
    **{
        f"crash-{name}": Part(f"bench.robustness.crash_recovery --latest 2.5 --workers 1 {options}", JOBS)
        for name, options in (("npz", "--format npz"), ("parquet", "--format parquet"), ("ray", "--engine ray"))
    },
    "throughput": Part("bench.speed.throughput examples/sensor.toml examples/press_on_axis.png --ray", JOBS),
    "fuzz": Part("bench.robustness.fuzz", FILES),
    "walks": Part("bench.speed.walks", (*PRESSED, *CLI)),
    "live": Part("bench.speed.live", (*FRAME, "torchmembrane/live")),
    "live-exported": Part(
        "bench.speed.live --model DATA/video.onnx --only '17 x 17; exported,17 x 17; exported; recorded'",
        (*EXPORT, "torchmembrane/live"),
        data="live-exported",
    ),
    "ros": Part("bench.speed.ros", (*FRAME, "ros/torchmembrane_ros"), python=".venv-ros/bin/python"),
    "gpu": Part("bench.speed.gpu --batches 1 4 16 64 256 1024 2048", needs_gpu=True),
    "independent": Part("bench.accuracy.accuracy CASES", data="independent"),
    "light-independent": Part(
        f"bench.accuracy.light {' '.join(f'CASES/light/{name}' for name in ('l01', 'l04', 'l06', 'l07'))}", data="independent"
    ),
    "simulator-independent": Part("bench.accuracy.simulator CASES", SIMULATOR, data="independent"),
    "real-bubble": Part("bench.accuracy.real_bubble DATA/punyo", data="recordings"),
    "real-pins": Part(
        "bench.accuracy.real_pins DATA", (*FRAME, "torchmembrane/cli", "torchmembrane/presets"), data="recordings"
    ),
    "cases": Part("bench.accuracy.accuracy CASES", CASES, data="cases"),
    "locators": Part("bench.accuracy.locators CASES", ("torchmembrane/markers", "bench/data/cases.py"), data="cases"),
    "segmentation": Part("bench.accuracy.segmentation CASES", CASES, data="cases"),
    "monge": Part("bench.accuracy.monge CASES", CASES, data="cases"),
    "energy-steps": Part(
        "bench.accuracy.energy_steps CASES",
        ("torchmembrane/estimators/minimum_energy", "torchmembrane/mechanics"),
        data="cases",
    ),
    "mismatched": Part("bench.robustness.mismatched CASES --draws 4", CASES, data="cases"),
    "precision": Part(
        "bench.accuracy.precision DATA/model.onnx examples/press_on_axis.png examples/flat_plate.png examples/two_contacts.png",
        EXPORT,
        data="precision",
    ),
    "ablation": Part("bench.accuracy.ablation CASES", CASES, data="cases"),
    "gauge": Part("bench.accuracy.gauge DATA", RANDOM, data="gauge"),
    "rough-gauge": Part("bench.accuracy.gauge DATA --noise 0.01 --told 0.01", RANDOM, data="gauge"),
    "views": Part("bench.accuracy.views --first 1 --sensors 20 --presses 3", (*RANDOM, "torchmembrane/simulate")),
    "calibration-coverage": Part(
        "bench.accuracy.calibration_coverage --seed 3 --sensors 102",
        ("torchmembrane/calibrate", "torchmembrane/forming", "torchmembrane/presets", "bench/accuracy/windows.py"),
    ),
    "views-deep": Part(
        "bench.accuracy.views --first 1 --sensors 20 --presses 3 --depth 0.2,0.3", (*RANDOM, "torchmembrane/simulate")
    ),
    "views-soft": Part("bench.accuracy.views --first 40 --sensors 20 --presses 3 --soft", (*RANDOM, "torchmembrane/simulate")),
    "iterations": Part("bench.accuracy.iterations --seed 11", PRESSED),
    "knocked": Part("bench.accuracy.knocked --first 1 --sensors 10 --presses 3", (*RANDOM, "torchmembrane/simulate")),
    "at-rest": Part("bench.accuracy.at_rest --sensors 20", (*RANDOM, "torchmembrane/simulate")),
    "sequence": Part("bench.accuracy.sequence DATA", RANDOM, data="sequence"),
    "exports": Part("bench.accuracy.exports", (*EXPORT, "torchmembrane/simulate", "bench/data/random_sensors.py")),
    "light": Part("bench.accuracy.range DATA --only light", RANDOM, data="light"),
    "intervals": Part(f"bench.accuracy.intervals {' '.join(f'DATA/{seed}' for seed in SEEDS)}", RANDOM, data="intervals"),
    "range": Part("bench.accuracy.range DATA", RANDOM, data="range"),
    "degraded-images": Part("bench.robustness.degraded_images DATA --sensors 4,8,14", RANDOM, data="degraded-images"),
}
"""In the order in which they are measured, the quick ones first."""
