"""Settings of force balance: immutable and checked at construction."""

from dataclasses import dataclass
from functools import wraps
from typing import Any, TypeVar

from ...errors import MembraneError

S = TypeVar("S")
OLD_NAMES = {
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
        tau: first and last scale of the loss of compressive traction on the coarsest grid; finer ones have the last alone.
        settled_step_tol: largest `schedule.scaled_step` at the last scale with which a solution has settled; on each coarser
            grid four times that of the next finer one.
        camera_motion: scale of the prior of the camera's motion relative to the rim at the last tau, px: smaller motions are
            ignored, larger ones are barely penalised further.
        sparsity: twice the loss of the uniform compressive traction p0 on the whole surface, while the loss is quadratic.
        scale_share: share of the largest push (compressive traction) around a vertex, within `WIDER` times `reach`, below
            which a push is small.
        contact_noise: smallest ratio of a contact's push to the push due to noise; it must be large for its neighbourhood too.
        shear: weight of the loss of shear traction without a push, relative to that of compressive traction.
        reach: radius of the neighbourhood that determines whether a vertex is pushed.
        floor: smallest weight of a compressive traction, between 0 and 1. Without it, the position of a vertex under a contact
            would be undetermined. `noise_share` follows from it.
        outlier: scale of the markers' loss, relative to their noise; larger on coarser grids of few lines.
        pressure_noise: standard deviation of a measured pressure, relative to the reference traction (mostly the rest
            pressure). Use this value for better gauges as well.
        convergence_tol: largest rms of the last step of a converged solution, and largest volume error, relative to the rest
            volume.
        unexplained_per_displacement: largest objective without the normal-compression term, per marker seen, that a surface of
            this sensor explains, above `estimator.LOSS_OF_NOISE` and per rms displacement: the error of grid and material
            grows with the press.
        largest_shared_misfit: largest misfit that neighbouring markers have in common, in standard deviations, that a surface
            explains. A torn or sheared image moves neighbours alike, which no surface does. Relative to their limits, this and
            the unexplained objective may add up to 1, because a skin that is not a membrane has some of both. Both limits are
            larger on grids of fewer than `estimator.MIN_RESOLVED_LINES` lines.

    Example:
        >>> ForceBalanceSettings(steps=(40, 20, 10)).far
        10.0
    """

    steps: tuple[int, int, int] = (64, 32, 8)
    tau: tuple[float, float] = (4.0, 0.4)
    settled_step_tol: float = 7e-5
    camera_motion: float = 0.005
    sparsity: float = 9000.0
    scale_share: float = 0.2
    contact_noise: float = 3.32
    shear: float = 3.75
    reach: float = 0.04
    floor: float = 1e-3
    outlier: float = 2.5
    pressure_noise: float = 0.01
    convergence_tol: float = 1e-3
    unexplained_per_displacement: float = 40.0
    largest_shared_misfit: float = 1.35

    def __post_init__(self) -> None:
        if not isinstance(self.steps, tuple) or len(self.steps) != 3 or min(self.steps) < 2:
            raise MembraneError(f"ForceBalanceSettings: steps = {self.steps}; expected three numbers of at least 2")
        if not self.pressure_noise > 0:
            raise MembraneError(f"ForceBalanceSettings: pressure_noise = {self.pressure_noise}; expected more than 0")

        if not 0 < self.floor < 1:
            raise MembraneError(f"ForceBalanceSettings: floor = {self.floor}; expected more than 0 and less than 1")

    @property
    def slip(self) -> float:
        """Scale of the loss of shear traction, above which it is linear: small compared with the last scale of a push."""
        return self.tau[1] / 8

    @property
    def far_share(self) -> float:
        """Share of the largest push on the whole surface, however far away, below which a push is small."""
        return self.scale_share / 4

    @property
    def noise_share(self) -> float:
        """Share of the push caused by the markers' noise alone, while all losses are quadratic, below which a push is small.

        A push that just counts as a contact, `contact_noise` times this noise, then has the weight `floor`.
        """
        return float(self.contact_noise / (self.floor**-0.5 - 1) ** 0.5)

    @property
    def far(self) -> float:
        """Angle between a marker and its ray, relative to its noise, beyond which its size carries no information."""
        return 4 * self.outlier
