"""A sensor's spec sheet: presses simulated on it, reconstructed from their images, summed up."""

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
"""Over the size: within it, or within the markers' spacing, of where it is a contact counts as found."""
REST, STROKE, PAIR = "frames at rest", "stroke", "pairs"
WORK = {REST: 0.5, STROKE: 1.0, PAIR: 0.5}
"""Time that a series takes over that of a stroke, roughly: frames at rest are not simulated, pairs are half as many."""


class Series(NamedTuple):
    """Trials that one process runs one after another: frames at rest, a stroke, or the pairs of a direction."""

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
    """Measure what to expect of a sensor, by trials on a simulated one, through images.

    Noise at rest, the lightest touch found, errors by force, the distance that resolves two contacts, the deepest press.

    Args:
        sensor: the sensor.
        seed: seed of presses and noise; the same gives the same.
        noise: noise of the images, white over its standard deviation, dB; default: as in the rest image (`image_noise`).
        effort: how much is tried.
        jobs: processes.
        finished: series that an interrupted call of the same arguments has finished, which keeps those of this call as well.
        progress: is told how far it is.

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
    """The outcomes of all series in their order: those finished earlier are read, the others are computed now."""
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
    """The share of the work in the series of these numbers."""
    return sum(WORK[series[k].kind] for k in done) / sum(WORK[each.kind] for each in series)


def outcome_of(rig: Rig, series: Series) -> Outcome:
    """The outcome of a series of trials on this rig."""
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
    """Numbers of series and their outcomes, as they are finished."""
    jobs = min(jobs, len(series))
    if jobs <= 1:
        yield from ((k, outcome_of(rig, each)) for k, each in series)
        return
    with spawned_pool(jobs, _begin, (rig.simulator.sensor, rig.simulator.appearance.noise)) as pool:
        yield from pool.imap_unordered(_work, series)


_rig: Rig


def _begin(path: Path) -> None:
    """Start a worker process: what `_work` needs, once."""
    global _rig
    _rig = Rig(*begin_worker(path))


def _work(numbered: tuple[int, Series]) -> tuple[int, Outcome]:
    number, series = numbered
    return number, outcome_of(_rig, series)
