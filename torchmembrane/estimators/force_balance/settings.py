"""Settings of force balance: immutable, and checked at construction."""

from dataclasses import dataclass
from functools import wraps
from typing import Any, TypeVar

from ...errors import MembraneError

S = TypeVar("S")
OUTLIER_DECAY_POWER = 1.3
"""The scale of the markers' loss falls with this power of tau: it begins at twenty times its last value."""
OLD_NAMES = {
    "decline": "gnc_fraction",
    "largest_outlying": "largest_outlier_share",
    "likely_of_press": "likely_per_displacement",
    "misfit_of_press": "misfit_per_displacement",
    "patience": "retry_steps_factor",
    "patient_damping": "retry_damping",
    "patient_fine_tau": "retry_fine_tau",
    "patient_tau": "retry_tau",
    "settled_step": "settled_step_tol",
    "unexplained_of_press": "unexplained_per_displacement",
    "worse_objective": "retry_acceptance_ratio",
}
"""Names of settings before 0.2.0, which are still accepted, and their names now."""


def accepts_old_names(settings: type[S]) -> type[S]:
    """The class, whose constructor takes `OLD_NAMES` as well."""
    init = settings.__init__

    @wraps(init)
    def with_old_names(self: S, *values: Any, **named: Any) -> None:
        old = {OLD_NAMES[name]: named.pop(name) for name in OLD_NAMES if name in named}
        init(self, *values, **named | old)

    settings.__init__ = with_old_names  # type: ignore[assignment]
    return settings


@accepts_old_names
@dataclass(frozen=True)
class ForceBalanceSettings:
    """Settings of `ForceBalance`. Lengths are relative to the surface's size, tractions to the reference traction `p0`.

    Args:
        steps: number of steps from rest on a grid that has no coarser one.
        coarse_steps: number of steps from rest on a grid that a finer one follows.
        fine_steps: number of steps from the solution of the coarsest grid.
        finer_steps: number of steps from the solution of any other grid.
        tau: first and last scale of the loss of compressive traction, from rest.
        fine_tau: the same from the coarsest grid's solution. Finer grids begin with the last scale, so as to stay in its basin.
        retry_steps_factor: number of steps from rest in a second try, over that in the first.
        retry_tau: `tau` of a second try.
        retry_fine_tau: `fine_tau` of a second try.
        settling_steps: number of further steps of a second try, at its last scale, on grids finer than that of the dents.
        settled_step_tol: rms of the last step below which a solution has settled and is not solved again.
        camera_motion: scale of the prior of the camera's motion against the rim, px, as tau ends: smaller motions are ignored,
            larger ones are barely penalised further.
        gnc_fraction: share of the steps over which tau declines.
        sparsity: twice the loss of the compressive traction p0 on the whole surface, while it is quadratic.
        scale_reach: radius of the surroundings whose largest push sets the scale of a vertex's tractions.
        scale_share: share of that push below which a push is small.
        far_share: the same share of the largest push of the whole surface.
        noise_share: the same share of the push that the markers' noise alone makes, while all losses are quadratic.
        contact_noise: pushes of so many times the noise's push are contacts, if they are large compared with those around them.
        evidence: by how much a solution must be likelier than the surface at rest, over the mean gain of the markers' noise
            alone, for any part of it to be a contact.
        least_scale: smallest scale of tractions, over p0.
        decrease: how fast that scale may fall with tau.
        friction: weight of the loss of shear traction, over that of the compressive one.
        slip: scale of the loss of shear traction, from which on it is linear.
        cone: by how much less shear weighs where something pushes.
        coarse_cone: the same on the coarsest grid, whose own error looks like friction under a contact.
        reach: radius of the surroundings that decide whether a vertex is pushed.
        renewal: share of a step's own weights of normal tractions in their geometric mean with those of the step before. A
            vertex that is pushed after one step and pulled after the next settles in this way.
        floor: smallest weight of a compressive traction. Without it, nothing determines where a vertex under a contact is.
        outlier: scale of the markers' loss, over their noise.
        coarse_outlier: the same on grids that a finer one follows. What these grids cannot follow must not cost them markers.
        pressure_noise: standard deviation of a measured pressure, over the reference traction (mostly the rest pressure). Use
            this value for better gauges as well.
        longest_step: largest step of a vertex.
        largest_stretch: largest relative change of the length of an edge of the grid in one step.
        damping: share of the diagonal of a step's matrix that is added to it as tau ends; it falls with the square of tau.
        settling_damping: the same in the last steps of a schedule, which settle.
        retry_damping: the same in the `settling_steps`.
        coarsest: smallest number of lines of a coarser grid.
        largest_relative_step: largest rms of the last step of a converged solution.
        largest_volume_error: largest volume error of a converged solution, over the rest volume.
        largest_misfit: largest rms of the markers' angles off their rays, over their noise and the model's error, that a
            surface of this sensor explains; more on grids of fewer than `force_balance.MIN_RESOLVED_LINES` lines.
        misfit_per_displacement: what is added to it for a surface that has moved by its size (rms), because the grid's error
            grows with the press.
        largest_unexplained: largest objective without the normal-compression term, per marker seen, that a surface of this
            sensor explains; more on coarse grids, as above.
        unexplained_per_displacement: what is added to it for a surface that has moved by its size (rms).
        largest_shared_misfit: largest misfit that neighbouring markers have in common, in standard deviations, that a surface
            explains. A torn or sheared image moves neighbours alike, as no surface does.
        largest_doubt: largest sum of the shares of `largest_unexplained` and `largest_shared_misfit`, because a skin that is no
            membrane has some of both; and how much larger the sum may be, times the size over the displacement (rms), because
            a rest image that has aged looks the same while the surface hardly moves.
        largest_pushed: largest share of the surface that contacts push. Where all of it is pushed, nothing distinguishes the
            fluid's pressure from that of a contact.
        likely_objective: largest objective, per marker seen, of a solution that is not solved again: of one with a contact
            where nothing moves, of one with any contact, and of one without; more on coarse grids, as above.
        likely_per_displacement: what is added to the first, up to the second, for a surface that has moved by its size (rms).
        retry_acceptance_ratio: objective of a second solution, over that of a converged first one, below which it is taken.
        largest_outlier_share: largest share of the markers that may be `far` off without a second try.

    Example:
        >>> [(tau, round(outlier, 1)) for tau, outlier in ForceBalanceSettings().gnc_schedule(2, (4.0, 0.4))]
        [(4.0, 49.9), (0.4, 2.5)]
    """

    steps: int = 8
    coarse_steps: int = 4
    fine_steps: int = 4
    finer_steps: int = 3
    tau: tuple[float, float] = (4.0, 0.4)
    fine_tau: tuple[float, float] = (0.8, 0.4)
    retry_steps_factor: int = 4
    retry_tau: tuple[float, float] = (16.0, 0.4)
    retry_fine_tau: tuple[float, float] = (2.0, 0.4)
    settling_steps: int = 16
    settled_step_tol: float = 4e-4
    camera_motion: float = 0.005
    gnc_fraction: float = 0.6
    sparsity: float = 9000.0
    scale_reach: float = 0.08
    scale_share: float = 0.3
    far_share: float = 0.1
    noise_share: float = 0.6
    contact_noise: float = 2.7
    evidence: float = 0.35
    least_scale: float = 0.02
    decrease: float = 2.0
    friction: float = 3.75
    slip: float = 0.05
    cone: float = 23.0
    coarse_cone: float = 5.0
    reach: float = 0.04
    renewal: float = 0.25
    floor: float = 1e-3
    outlier: float = 2.5
    coarse_outlier: float = 5.0
    pressure_noise: float = 0.01
    longest_step: float = 0.04
    largest_stretch: float = 0.3
    damping: float = 3e-7
    settling_damping: float = 1e-4
    retry_damping: float = 1e-3
    coarsest: int = 6
    largest_relative_step: float = 2e-3
    largest_volume_error: float = 1e-3
    largest_misfit: float = 1.5
    misfit_per_displacement: float = 2.0
    largest_unexplained: float = 2.0
    unexplained_per_displacement: float = 30.0
    largest_shared_misfit: float = 1.35
    largest_doubt: tuple[float, float] = (1.0, 5e-4)
    largest_pushed: float = 0.55
    likely_objective: tuple[float, float, float] = (0.45, 0.95, 1.8)
    likely_per_displacement: float = 80.0
    retry_acceptance_ratio: float = 0.9
    largest_outlier_share: float = 0.01

    def __post_init__(self) -> None:
        for name in ("steps", "coarse_steps", "fine_steps", "finer_steps"):
            if getattr(self, name) < 2:
                raise MembraneError(f"ForceBalanceSettings: {name} = {getattr(self, name)}; expected at least 2")
        if not self.pressure_noise > 0:
            raise MembraneError(f"ForceBalanceSettings: pressure_noise = {self.pressure_noise}; expected more than 0")

    @property
    def far(self) -> float:
        """Angle of a marker off its ray, over its noise, beyond which its size tells nothing more."""
        return 4 * self.outlier

    def gnc_schedule(self, steps: int, tau: tuple[float, float]) -> list[tuple[float, float]]:
        """Scales of the losses in every step, graduated non-convexity: of compressive tractions (tau), of markers."""
        first, last = tau
        taus = [first * (last / first) ** min(1.0, k / (self.gnc_fraction * (steps - 1))) for k in range(steps)]
        return [(tau, self.outlier * (tau / last) ** OUTLIER_DECAY_POWER) for tau in taus]
