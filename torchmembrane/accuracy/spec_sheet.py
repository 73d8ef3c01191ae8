"""The contents of a sensor's spec sheet: errors of its reconstructions, for each trial and summarised.

Lengths are in the sensor's length unit, forces and pressures in its force unit; relative errors have no unit.
"""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

from ..results.status import Status
from ..sensor.working_range import WorkingRange

CLOSE = 0.25
"""Largest relative error of the surface of a press that counts as reconstructed."""
LOST = 0.05
"""Largest share of the markers found at rest that are lost in a press that counts as reconstructed."""


class Spread(NamedTuple):
    """Median and 90 % quantile of values; NaN if there are none."""

    median: float
    most: float


class PressTrial(NamedTuple):
    """One frame of a stroke: the truth and the errors of the reconstruction.

    Attributes:
        stroke: number of the stroke.
        force: magnitude of the true force.
        depth: true depth, the largest displacement along the inward normal.
        force_error: magnitude of the force's vector error, over the magnitude of the true force.
        depth_error: absolute error of the depth.
        place_error: distance of the strongest reported contact from the centre of the true one; infinite if none is reported.
        surface_error: rms error of the displacement in view, over the rms of the true displacement there.
        lost: share of the markers found at rest that are lost.
        at_rim: whether a contact is reported to reach the rim, so that its force is a lower bound.
        status: a `Status`.
        turn: rotation of the reconstructed surface, degrees, as defined in `WorkingRange`.
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
        """Whether the result claims a reliable force: status ok and no contact at the rim."""
        return self.status == Status.OK and not self.at_rim

    @property
    def is_wrong(self) -> bool:
        """Whether the relative error of surface or force exceeds `CLOSE`; forces reported as lower bounds do not count."""
        return self.surface_error > CLOSE or (self.force_error > CLOSE and not self.at_rim)

    def is_found(self, near: float) -> bool:
        """Return whether status is ok and the strongest contact is reported within `near` (length unit) of the true one."""
        return self.status == Status.OK and self.place_error < near

    @property
    def failure(self) -> str:
        """The reason why the frame does not count as reconstructed; empty if it does count."""
        if self.status != Status.OK:
            return Status(self.status).name.lower().replace("_", " ")
        if self.lost > LOST:
            return "markers lost"
        return "" if self.surface_error <= CLOSE else "surface off"


class PairTrial(NamedTuple):
    """A pair of simultaneous contacts.

    Attributes:
        direction: number of the direction in which the pairs lie.
        distance: distance between the centres of the two true contacts.
        told: whether the contacts are resolved: status is ok and a contact is reported within half the distance of each.
    """

    direction: int
    distance: float
    told: bool


class RestTrial(NamedTuple):
    """One frame at rest.

    Attributes:
        surface: rms of the reconstructed displacement in view.
        force: magnitude of the reconstructed force.
        pressure: magnitude of the reconstructed pressure change.
        contacts: number of reported contacts.
        status: a `Status`.
    """

    surface: float
    force: float
    pressure: float
    contacts: int
    status: int


class Effort(NamedTuple):
    """The number of trials.

    Attributes:
        strokes: number of strokes at random places.
        frames: number of frames of each stroke.
        directions: number of directions in which pairs of contacts are tried.
        distances: number of distances between the contacts of a pair, for each direction.
        rest: number of frames at rest.
    """

    strokes: int = 8
    frames: int = 14
    directions: int = 3
    distances: int = 7
    rest: int = 24


class Outcome(NamedTuple):
    """The outcome of one series of trials; `reason` says why it could not be simulated (empty if it could)."""

    rest: Sequence[RestTrial] = ()
    presses: Sequence[PressTrial] = ()
    pairs: Sequence[PairTrial] = ()
    reason: str = ""


class RestFloor(NamedTuple):
    """Spurious results in frames at rest.

    Attributes:
        frames: number of frames.
        not_ok: number of frames with a status other than ok, which are excluded from the following figures.
        touched: number of frames with a reported contact.
        surface: rms displacement.
        force: magnitude of the force.
        pressure: magnitude of the pressure change.
    """

    frames: int
    not_ok: int
    touched: int
    surface: Spread
    force: Spread
    pressure: Spread


class LightestTouch(NamedTuple):
    """The force and depth at which an increasing press is first found.

    Attributes:
        strokes: number of strokes.
        found: number of strokes in which the contact is found in two successive frames.
        force: magnitude of the true force in the first of these frames, force unit: median and 90 % quantile over the strokes.
        depth: depth of the press in the same frame, length unit: likewise.
    """

    strokes: int
    found: int
    force: Spread
    depth: Spread


class Band(NamedTuple):
    """Errors of presses whose true force is above `low` and up to `high`.

    Attributes:
        low: lower bound of the force.
        high: upper bound of the force.
        presses: number of presses.
        relied_on: share of presses with status ok and no contact at the rim; the following figures are for these.
        found: share of these whose contact is found.
        force: relative error of the force.
        depth: error of the depth.
        place: error of the contact's position, if a contact is reported.
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
    """The smallest distance at which two contacts are resolved.

    Attributes:
        directions: number of directions in which pairs were tried.
        told: number of directions in which the widest pair is resolved.
        distance: smallest distance at which this and every wider pair is resolved, over those directions.
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
        depths: for each stroke, depth of the last press before the first failure, counted from the first one found.
        forces: forces of those presses.
        ends: number of strokes by the reason of their end: a status, markers lost, the surface off, or the deepest press tried.
    """

    depths: Sequence[float]
    forces: Sequence[float]
    ends: Mapping[str, int]


class SpecSheet(NamedTuple):
    """The expected accuracy of a sensor.

    Attributes:
        name: name of the sensor.
        length_unit: the sensor's length unit.
        force_unit: "N" | "relative".
        noise: noise of the images, white level over standard deviation, dB.
        seed: seed of presses and noise.
        simulated_on: the simulator's grid.
        reconstructed_on: the sensor's solver grid.
        spacing: spacing of the markers, length unit.
        near: largest position error of a contact that counts as found, length unit.
        left_out: reason for each stroke or direction of pairs that could not be simulated.
        rest: figures of frames at rest.
        lightest: figures of light touches.
        bands: errors by force, the lightest first.
        closest: figures of pairs of contacts.
        deepest: figures of deep presses.
        presses: all presses of the strokes.
        pairs: all pairs.
        range: the range in which presses are accurate; None if there is none.
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
