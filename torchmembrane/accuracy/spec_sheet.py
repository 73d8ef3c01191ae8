"""The contents of a sensor's spec sheet: the errors of its reconstructions, trial by trial and summarised.

Lengths are in the sensor's unit, forces and pressures in its force unit; errors over the truth have none.
"""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

from ..results.status import Status
from ..sensor.working_range import WorkingRange

CLOSE = 0.25
"""Largest error of a surface, over its displacement, up to which a press counts as reconstructed."""
LOST = 0.05
"""Largest share of the markers found at rest that a press may lose and count so."""


class Spread(NamedTuple):
    """Median and 90 % quantile of some values; NaN where there are none."""

    median: float
    most: float


class PressTrial(NamedTuple):
    """One frame of a stroke: the truth and the errors of the reconstruction.

    Attributes:
        stroke: number of the stroke that it belongs to.
        force: magnitude of the true force.
        depth: true depth, the deepest displacement along the inward normal.
        force_error: error of the force as a vector, over the true one's magnitude.
        depth_error: absolute, of the depth.
        place_error: distance from the centre of the true contact to the strongest one reported; infinite where none is.
        surface_error: rms over the part in view, over the rms of the true displacement there.
        lost: share of the markers found at rest that are lost.
        at_rim: whether a contact is said to reach the rim, its force to be a lower bound.
        status: a `Status`.
        turn: by which the surface found turns, degrees, as `WorkingRange` has it.
    """

    stroke: int
    force: float
    depth: float
    force_error: float
    depth_error: float
    place_error: float
    surface_error: float
    lost: float
    at_rim: bool
    status: int
    turn: float = 0.0

    @property
    def relied_on(self) -> bool:
        """Whether the result reports that its force can be relied on: status ok and no contact at the rim."""
        return self.status == Status.OK and not self.at_rim

    @property
    def is_wrong(self) -> bool:
        """Whether surface or force are off by more than `CLOSE`; a force that is reported as a lower bound does not count."""
        return self.surface_error > CLOSE or (self.force_error > CLOSE and not self.at_rim)

    def is_found(self, near: float) -> bool:
        """Whether the strongest contact is reported within `near` (length) of where it is, with status ok."""
        return self.status == Status.OK and self.place_error < near

    @property
    def failure(self) -> str:
        """The reason why the frame does not count as reconstructed; empty if it does."""
        if self.status != Status.OK:
            return Status(self.status).name.lower().replace("_", " ")
        if self.lost > LOST:
            return "markers lost"
        return "" if self.surface_error <= CLOSE else "surface off"


class PairTrial(NamedTuple):
    """A pair of simultaneous touches.

    Attributes:
        direction: number of the line on which pairs are moved together.
        distance: between the centres of the two true contacts.
        told: whether two contacts are reported, each within half of the distance of one of the true ones, with status ok.
    """

    direction: int
    distance: float
    told: bool


class RestTrial(NamedTuple):
    """One frame at rest.

    Attributes:
        surface: rms displacement found, over the part in view.
        force: magnitude found.
        pressure: magnitude of the change found.
        contacts: how many are reported.
        status: a `Status`.
    """

    surface: float
    force: float
    pressure: float
    contacts: int
    status: int


class Effort(NamedTuple):
    """The extent of the trials.

    Attributes:
        strokes: from the first touch on, towards random places.
        frames: number of frames of each stroke.
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
    """The outcome of one series of trials; `reason` says why it could not be simulated."""

    rest: Sequence[RestTrial] = ()
    presses: Sequence[PressTrial] = ()
    pairs: Sequence[PairTrial] = ()
    reason: str = ""


class RestFloor(NamedTuple):
    """What is found in frames at rest, where nothing should be found.

    Attributes:
        frames: how many.
        not_ok: number of them with another status than ok; not in the spreads.
        touched: number of them with a contact reported.
        surface: rms displacement.
        force: magnitude.
        pressure: magnitude of the change.
    """

    frames: int
    not_ok: int
    touched: int
    surface: Spread
    force: Spread
    pressure: Spread


class LightestTouch(NamedTuple):
    """The force and depth from which on a growing press is found.

    Attributes:
        strokes: in how many strokes.
        found: in how many of them the contact is found at all.
        force: force of the first frame found, over those strokes.
        depth: depth of the same frame.
    """

    strokes: int
    found: int
    force: Spread
    depth: Spread


class Band(NamedTuple):
    """Errors of presses whose true force is above `low` and up to `high`.

    Attributes:
        low: force.
        high: force.
        presses: how many.
        relied_on: share of them with status ok and no contact at the rim; the errors are theirs.
        found: share of those whose contact is found.
        force: relative error of the force.
        depth: error of the depth.
        place: error of the contact's place, where one is reported.
    """

    low: float
    high: float
    presses: int
    relied_on: float
    found: float
    force: Spread
    depth: Spread
    place: Spread


class ClosestPair(NamedTuple):
    """The distance from which on two touches are resolved.

    Attributes:
        directions: in how many directions pairs were moved together.
        told: in how many of them the widest pair is resolved.
        distance: the smallest at which this and every wider pair is resolved, over those.
        nearest: the smallest distance tried.
        widest: the largest distance tried.
    """

    directions: int
    told: int
    distance: Spread
    nearest: float
    widest: float


class DeepestPress(NamedTuple):
    """The depth up to which strokes are reconstructed.

    Attributes:
        depths: depth of the deepest press of each stroke that is reconstructed, as are all between it and the first one found.
        forces: forces of those presses.
        ends: how many strokes end by what: a status, markers lost, the surface off, nothing up to the deepest press tried.
    """

    depths: Sequence[float]
    forces: Sequence[float]
    ends: Mapping[str, int]


class SpecSheet(NamedTuple):
    """What to expect of a sensor.

    Attributes:
        name: name of the sensor.
        length_unit: the sensor's.
        force_unit: "N" | "relative".
        noise: noise of the images, white over its standard deviation, dB.
        seed: seed of presses and noise.
        simulated_on: the simulator's grid.
        reconstructed_on: the sensor's own.
        spacing: spacing of the markers, length unit.
        near: distance from where it is within which a contact counts as found, length unit.
        left_out: for each stroke or direction of pairs that could not be simulated, why.
        rest: at rest.
        lightest: figures of light touches.
        bands: errors by force, the lightest first.
        closest: figures of two touches.
        deepest: figures of deep presses.
        presses: every press of the strokes.
        pairs: every pair.
        range: in which presses are right; None where none is.
    """

    name: str
    length_unit: str
    force_unit: str
    noise: float
    seed: int
    simulated_on: tuple[int, int]
    reconstructed_on: tuple[int, int]
    spacing: float
    near: float
    left_out: Sequence[str]
    rest: RestFloor
    lightest: LightestTouch
    bands: Sequence[Band]
    closest: ClosestPair
    deepest: DeepestPress
    presses: Sequence[PressTrial]
    pairs: Sequence[PairTrial]
    range: WorkingRange | None = None
