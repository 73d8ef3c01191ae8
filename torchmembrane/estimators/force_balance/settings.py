"""Settings of force balance: immutable and checked at construction."""

from dataclasses import dataclass
from functools import wraps
from typing import Any, TypeVar

from ...errors import MembraneError

S = TypeVar("S")
OLD_NAMES = {
    "misfit_of_press": "misfit_per_displacement",
    "settled_step": "settled_step_tol",
    "unexplained_of_press": "unexplained_per_displacement",
}
"""Names of settings before 0.2.0, which are still accepted, and their present names."""


def accepts_old_names(settings: type[S]) -> type[S]:
    """Make the constructor of a settings class accept `OLD_NAMES` too, and return the class."""
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
        steps: largest number of steps on the coarsest grid, the next one, and any finer one; fewer where a frame settles.
        tau: first and last scale of the loss of compressive traction, from rest.
        fine_tau: first scale on all grids but the coarsest.
        settled_step_tol: largest `schedule.scaled_step` at the last scale with which a solution has settled.
        camera_motion: scale of the prior of the camera's motion relative to the rim at the last tau, px: smaller motions are
            ignored, larger ones are barely penalised further.
        sparsity: twice the loss of the uniform compressive traction p0 on the whole surface, while the loss is quadratic.
        scale_reach: radius of the neighbourhood whose largest push (compressive traction) sets a vertex's scale of tractions.
        scale_share: share of that push below which a push is small.
        far_share: the same as a share of the largest push on the whole surface.
        noise_share: the same as a share of the push caused by the markers' noise alone, while all losses are quadratic.
        contact_noise: smallest ratio of a contact's push to the push due to noise; it must be large for its neighbourhood too.
        evidence: smallest decrease of the objective from the surface at rest for a solution to have contacts, relative to the
            mean decrease due to the markers' noise alone.
        friction: weight of the loss of shear traction, relative to that of compressive traction.
        slip: scale of the loss of shear traction, above which it is linear.
        cone: how much a push reduces the weight of shear.
        coarse_cone: the same on the coarsest grid, whose discretisation error looks like friction under a contact.
        reach: radius of the neighbourhood that determines whether a vertex is pushed.
        floor: smallest weight of a compressive traction. Without it, the position of a vertex under a contact is undetermined.
        outlier: scale of the markers' loss, relative to their noise.
        coarse_outlier: the same on coarser grids, which must not reject markers because of their discretisation error.
        pressure_noise: standard deviation of a measured pressure, relative to the reference traction (mostly the rest
            pressure). Use this value for better gauges as well.
        largest_stretch: largest relative change of an edge of the grid in one step.
        damping: relative increase of the diagonal of a step's matrix at the last tau; it is proportional to the square of tau.
        settling_damping: the same in the last steps of frames that have not settled (`schedule.SETTLING_STEPS`).
        coarsest: smallest number of lines of a coarser grid.
        largest_relative_step: largest rms of the last step of a converged solution.
        largest_volume_error: largest volume error of a converged solution, relative to the rest volume.
        largest_misfit: largest rms of the angles between markers and rays, in standard deviations, that a surface of this
            sensor explains; it is larger on grids of fewer than `force_balance.MIN_RESOLVED_LINES` lines.
        misfit_per_displacement: increase of this limit per displacement (rms), because the grid's error grows with the press.
        largest_unexplained: largest objective without the normal-compression term, per marker seen, that a surface of this
            sensor explains; it is larger on coarse grids, as above.
        unexplained_per_displacement: increase of this limit per displacement (rms).
        largest_shared_misfit: largest misfit that neighbouring markers have in common, in standard deviations, that a surface
            explains. A torn or sheared image moves neighbours alike, which no surface does.
        largest_doubt: largest sum of the quantities that `largest_unexplained` and `largest_shared_misfit` limit, each relative
            to its limit, because a skin that is not a membrane has some of both; then the increase of this sum per inverse
            displacement (rms), because rest-image drift looks the same while the surface hardly moves.
        largest_pushed: largest share of the surface in contact. If all of it is pushed, the fluid's pressure cannot be
            distinguished from that of a contact.

    Example:
        >>> ForceBalanceSettings(steps=(40, 20, 10)).far
        10.0
    """

    steps: tuple[int, int, int] = (64, 32, 16)
    tau: tuple[float, float] = (4.0, 0.4)
    fine_tau: float = 0.8
    settled_step_tol: float = 1e-4
    camera_motion: float = 0.005
    sparsity: float = 9000.0
    scale_reach: float = 0.08
    scale_share: float = 0.2
    far_share: float = 0.05
    noise_share: float = 0.6
    contact_noise: float = 3.2
    evidence: float = 0.35
    friction: float = 3.75
    slip: float = 0.05
    cone: float = 23.0
    coarse_cone: float = 5.0
    reach: float = 0.04
    floor: float = 1e-3
    outlier: float = 2.5
    coarse_outlier: float = 5.0
    pressure_noise: float = 0.01
    largest_stretch: float = 0.3
    damping: float = 3e-7
    settling_damping: float = 1e-3
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

    def __post_init__(self) -> None:
        if not isinstance(self.steps, tuple) or len(self.steps) != 3 or min(self.steps) < 2:
            raise MembraneError(f"ForceBalanceSettings: steps = {self.steps}; expected three numbers of at least 2")
        if not self.pressure_noise > 0:
            raise MembraneError(f"ForceBalanceSettings: pressure_noise = {self.pressure_noise}; expected more than 0")

    @property
    def far(self) -> float:
        """Angle between a marker and its ray, relative to its noise, beyond which its size carries no information."""
        return 4 * self.outlier
