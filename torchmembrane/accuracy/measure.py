"""A sensor's spec sheet: presses simulated on it, reconstructed from their images, summed up."""

import multiprocessing
import pickle
import signal
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import torch

from ..errors import MembraneError
from ..sensor.sensor import Sensor
from . import statistics
from .presses import pair_states, stroke_states
from .rig import Rig, image_noise
from .spec_sheet import PairTrial, PressTrial, RestTrial, SpecSheet

NEAR = 0.05
"""Over the size: within it, or within the markers' spacing, of where it is a contact counts as found."""
REST, STROKE, PAIR = "rest", "stroke", "pair"


class Effort(NamedTuple):
    """How much is tried.

    Attributes:
        strokes: from the first touch on, towards random places.
        frames: of each stroke.
        directions: in which two touches are moved together.
        distances: between them that are tried.
        rest: frames at rest.
    """

    strokes: int = 8
    frames: int = 14
    directions: int = 3
    distances: int = 7
    rest: int = 24


class Outcome(NamedTuple):
    """What one series of trials gave; `reason` where it could not be simulated."""

    rest: Sequence[RestTrial] = ()
    presses: Sequence[PressTrial] = ()
    pairs: Sequence[PairTrial] = ()
    reason: str = ""


class Series(NamedTuple):
    """Trials that one process does in a row: frames at rest, a stroke, or the pairs of a direction."""

    kind: str
    number: int
    effort: Effort
    seed: int


def spec_sheet(
    sensor: Sensor, seed: int = 0, *, noise: float | None = None, effort: Effort | None = None, jobs: int = 1
) -> SpecSheet:
    """What to expect of a sensor: trials on a simulated one, through images.

    Noise at rest, the lightest touch found, errors by force, how near two touches are told apart, the deepest press.

    Args:
        sensor: the sensor.
        seed: of presses and noise; the same gives the same.
        noise: of the images, white over its standard deviation, dB; default: as in the rest image (`image_noise`).
        effort: how much is tried.
        jobs: processes.

    Returns:
        The `SpecSheet`. Trials that cannot be simulated are left out, and said.

    Raises:
        MembraneError: the sensor cannot be simulated or reconstructed, or none of the strokes can.

    Limitations:
        Of a sensor that is as its file says: errors of its calibration, its material and its light come on top. Bodies are
        balls and boxes, every second with friction.

    Example:
        >>> from torchmembrane.presets import preset
        >>> sheet = spec_sheet(preset("bubble"), effort=Effort(strokes=1, frames=2, directions=0, distances=0, rest=1))
        >>> len(sheet.presses), sheet.force_unit, sheet.rest.touched
        (2, 'N', 0)
    """
    from tqdm import tqdm

    effort = effort or Effort()
    noise = image_noise(sensor) if noise is None else noise
    rig = Rig(sensor, noise)
    series = [Series(REST, 0, effort, seed)]
    series += [Series(STROKE, k, effort, seed) for k in range(effort.strokes)]
    series += [Series(PAIR, k, effort, seed) for k in range(effort.directions)]
    outcomes = list(tqdm(_in_processes(rig, series, jobs), total=len(series), unit="series", desc="accuracy"))
    left_out = [outcome.reason for outcome in outcomes if outcome.reason]
    presses = [trial for outcome in outcomes for trial in outcome.presses]
    pairs = [trial for outcome in outcomes for trial in outcome.pairs]
    if effort.strokes and not presses:
        raise MembraneError(f"sensor {sensor.name!r}: none of {effort.strokes} strokes can be simulated; {left_out[0]}")
    spacing = sensor.membrane.size / len(rig.reconstructor.rest_markers) ** 0.5
    near = max(spacing, NEAR * sensor.membrane.size)
    return SpecSheet(
        name=sensor.name,
        length_unit=sensor.length_unit,
        force_unit=sensor.force_unit,
        noise=noise,
        seed=seed,
        simulated_on=rig.simulator.grid,
        reconstructed_on=sensor.membrane.grid,
        spacing=spacing,
        near=near,
        left_out=left_out,
        rest=statistics.rest_floor([trial for outcome in outcomes for trial in outcome.rest]),
        lightest=statistics.lightest_touch(presses, near),
        bands=statistics.bands(presses, near),
        closest=statistics.closest_pair(pairs),
        deepest=statistics.deepest_press(presses, near),
        presses=presses,
        pairs=pairs,
    )


def outcome_of(rig: Rig, series: Series) -> Outcome:
    """What a series of trials gives on this rig."""
    kind, number, effort, seed = series
    try:
        if kind == REST:
            return Outcome(rest=rig.rest_trials(effort.rest, seed))
        if kind == STROKE:
            states = stroke_states(rig.simulator, number, effort.frames, number / effort.strokes, seed)
            return Outcome(presses=rig.press_trials(states, number, seed))
        pairs = pair_states(rig.simulator, number, effort.distances, seed)
        return Outcome(pairs=rig.pair_trials(pairs, number, seed))
    except MembraneError as error:
        return Outcome(reason=str(error))


def _in_processes(rig: Rig, series: Sequence[Series], jobs: int) -> Iterator[Outcome]:
    jobs = min(jobs, len(series))
    if jobs <= 1:
        yield from (outcome_of(rig, each) for each in series)
        return
    sensor = pickle.dumps(rig.simulator.sensor)  # as bytes: torch would move tensors whose memory arrays look at
    arguments = sensor, rig.simulator.appearance.noise
    with multiprocessing.get_context("spawn").Pool(jobs, _begin, arguments) as pool:
        yield from pool.imap(_work, series)


_rig: Rig


def _begin(sensor: bytes, noise: float) -> None:
    """Start a worker process: what `_work` needs, once."""
    global _rig
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent ends its workers
    torch.set_num_threads(1)
    _rig = Rig(pickle.loads(sensor), noise)


def _work(series: Series) -> Outcome:
    return outcome_of(_rig, series)
