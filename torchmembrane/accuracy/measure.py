"""Measurement of a sensor's spec sheet from simulated presses, reconstructed from their images."""

from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

from ..errors import MembraneError
from ..processes import begin_worker, spawned_pool
from ..progress import Progress, silent
from ..sensor.sensor import Sensor
from . import statistics
from .finished import FinishedSeries
from .presses import pair_states, stroke_states
from .rig import Rig, image_noise
from .spec_sheet import Effort, Outcome, SpecSheet

NEAR = 0.05
"""Largest position error of a contact that counts as found, over the size; at least the markers' spacing is allowed."""
REST, STROKE, PAIR = "frames at rest", "stroke", "pairs"
WORK = {REST: 0.5, STROKE: 1.0, PAIR: 0.5}
"""Approximate time of a series over that of a stroke: frames at rest need no simulated press, pairs are half as many."""


class Series(NamedTuple):
    """Trials that one process runs sequentially: frames at rest, a stroke, or the pairs of one direction."""

    kind: str
    number: int
    effort: Effort
    seed: int


def spec_sheet(
    sensor: Sensor,
    seed: int = 0,
    *,
    noise: float | None = None,
    effort: Effort | None = None,
    jobs: int = 1,
    finished: FinishedSeries | None = None,
    progress: Progress = silent,
) -> SpecSheet:
    """Measure the accuracy of a sensor by trials on simulated images of it.

    The trials give the noise at rest, the lightest detectable touch, errors by force, the smallest distance at which two
    contacts are resolved, and the deepest press that is reconstructed.

    Args:
        sensor: the sensor.
        seed: seed of presses and noise, for reproducible results.
        noise: noise of the images, white level over standard deviation, dB; default: as in the rest image (`image_noise`).
        effort: number of trials.
        jobs: number of processes.
        finished: series finished by an interrupted call with the same arguments; series of this call are added.
        progress: called with the completed share.

    Returns:
        The `SpecSheet`. Trials that cannot be simulated are left out and listed in `left_out`.

    Raises:
        MembraneError: the sensor cannot be simulated or reconstructed, or no stroke can be simulated.

    Limitations:
        The sensor is assumed to match its file: errors of calibration, material and illumination add to these errors. The
        indenters are balls and boxes, every second one with friction.

    Example:
        >>> from torchmembrane.presets import preset
        >>> sheet = spec_sheet(preset("bubble"), effort=Effort(strokes=1, frames=2, directions=0, distances=0, rest=1))
        >>> len(sheet.presses), sheet.force_unit, sheet.rest.touched
        (2, 'N', 0)
    """
    effort = effort or Effort()
    noise = image_noise(sensor) if noise is None else noise
    series = [Series(REST, 0, effort, seed)]
    series += [Series(STROKE, k, effort, seed) for k in range(effort.strokes)]
    series += [Series(PAIR, k, effort, seed) for k in range(effort.directions)]
    progress(_share_done(series, finished.outcomes if finished else ()), "the sensor in the simulator")
    rig = Rig(sensor, noise)
    outcomes = _outcomes(rig, series, jobs, finished, progress)
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
        range=statistics.working_range(presses, sensor.membrane.size, sensor.fingerprint),
    )


def _outcomes(
    rig: Rig, series: Sequence[Series], jobs: int, finished: FinishedSeries | None, progress: Progress
) -> list[Outcome]:
    """Return the outcomes of all series in order; series finished earlier are read, the others are computed."""
    outcomes = dict(finished.outcomes) if finished else {}
    waiting = [(k, series[k]) for k in range(len(series)) if k not in outcomes]
    progress(_share_done(series, outcomes), f"{len(waiting)} series of presses")
    for k, outcome in _in_processes(rig, waiting, jobs):
        outcomes[k] = outcome
        if finished:
            finished.keep(k, outcome)
        progress(_share_done(series, outcomes), f"{len(outcomes)} of {len(series)} series done")
    return [outcomes[k] for k in range(len(series))]


def _share_done(series: Sequence[Series], done: Iterable[int]) -> float:
    """Return the share of the work that the series `done` have."""
    return sum(WORK[series[k].kind] for k in done) / sum(WORK[each.kind] for each in series)


def outcome_of(rig: Rig, series: Series) -> Outcome:
    """Run a series of trials on this rig and return its outcome."""
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


def _in_processes(rig: Rig, series: Sequence[tuple[int, Series]], jobs: int) -> Iterator[tuple[int, Outcome]]:
    """Yield the number and the outcome of each series as it is finished."""
    jobs = min(jobs, len(series))
    if jobs <= 1:
        yield from ((k, outcome_of(rig, each)) for k, each in series)
        return
    with spawned_pool(jobs, _begin, (rig.simulator.sensor, rig.simulator.appearance.noise)) as pool:
        yield from pool.imap_unordered(_work, series)


_rig: Rig


def _begin(path: Path) -> None:
    """Initialise a worker process with the rig that `_work` needs."""
    global _rig
    _rig = Rig(*begin_worker(path))


def _work(numbered: tuple[int, Series]) -> tuple[int, Outcome]:
    number, series = numbered
    return number, outcome_of(_rig, series)
