"""What can be chosen about force balance: frozen, checked at construction."""

from dataclasses import dataclass

from ...errors import MembraneError

OUTLIER_DECAY_POWER = 1.3
"""Power of tau's decline with which that of the markers' scale goes: where tau begins it is twenty times the last."""


@dataclass(frozen=True)
class ForceBalanceSettings:
    """Settings of `ForceBalance`; lengths are over the surface's size, tractions over the reference traction `p0`.

    Args:
        steps: from rest, on a grid that no coarser one goes before.
        coarse_steps: from rest, where a finer grid follows.
        fine_steps: from the coarsest grid's solution.
        finer_steps: from the solution of a grid that is not the coarsest.
        tau: first and last scale of the compressive traction's loss, from rest.
        fine_tau: the same, from the coarsest grid's solution; finer grids begin with the last, not to leave the basin.
        sharp_tau: the same, from rest on the grid of the dents, in a second try.
        patience: so many times the steps, from rest, where these do not settle.
        patient_tau: as `tau`, then.
        patient_fine_tau: as `fine_tau`, then.
        settling_steps: so many more at their last scale, then, on grids finer than that of the dents.
        settled_step: rms of the last step of a solution that is not solved again.
        camera_motion: of the camera against the rim, px: what is less is nothing, what is more costs hardly more; as tau ends.
        decline: share of the steps over which tau declines.
        sparsity: twice the loss of the compressive traction p0 on the whole surface, while it is quadratic.
        scale_reach: radius of the wider surroundings whose largest push says what a vertex's tractions are measured against.
        scale_share: share of that push below which a push is small.
        far_share: the same of the largest push of the whole surface.
        noise_share: the same of the push that the markers' noise alone makes, while all losses are quadratic.
        contact_noise: pushes of so many times the noise's are contacts, if they are large beside those around.
        evidence: by how much what is found is likelier than the surface at rest, over what the markers' noise alone gains in
            the mean, if anything of it is a contact.
        least_scale: least of what tractions are measured against, over p0.
        decrease: how fast that may fall as tau does.
        friction: weight of the shear traction's loss over that of the compressive one.
        slip: scale of the shear traction's loss: where it begins to be linear.
        cone: how much less shear weighs where something pushes.
        coarse_cone: the same on the coarsest grid, whose own error looks like friction under a contact.
        reach: radius of the surroundings that are asked whether a vertex is pushed.
        renewal: share of a step's own weights of normal tractions in their geometric mean with those of the step before: so a
            vertex that is pushed after one step and pulled after the next settles.
        floor: least weight of a compressive traction; without it a vertex under a contact has no place of its own.
        outlier: scale of the markers' loss, over their noise.
        coarse_outlier: the same on grids that a finer one follows: what these cannot follow must not lose them markers.
        pressure_noise: standard deviation of a measured pressure, over the reference traction (mostly the rest pressure); a
            better gauge is best told to be as good as this.
        longest_step: largest step of a vertex.
        largest_stretch: by how much of its length an edge of the grid changes in a step at most.
        damping: share of a step's matrix' diagonal that is added to it as tau ends; it falls with tau's square.
        settling_damping: the same of the last steps of a schedule, which settle.
        patient_damping: the same of the `settling_steps`.
        coarsest: fewest lines of a coarser grid.
        largest_relative_step: rms of the last step of a converged solution.
        largest_volume_error: volume error of a converged solution, over the rest volume.
        largest_misfit: rms of the markers' angles off their rays where a surface of this sensor explains them, over their
            noise and the model's error; on grids of fewer than `force_balance.MIN_RESOLVED_LINES` lines more.
        misfit_of_press: so much more for a surface that has moved by its size (rms): the grid's error grows with the press.
        largest_unexplained: what is minimised but for the loss of pushes, over the markers seen, where a surface of this
            sensor explains them; as before.
        unexplained_of_press: so much more for a surface that has moved by its size (rms), as of the misfit.
        largest_shared_misfit: as much of the misfit as neighbouring markers have in common, of a surface that explains them, in
            standard deviations: a torn or sheared image moves neighbours alike, as no surface follows.
        largest_doubt: sum of the shares in `largest_unexplained` and `largest_shared_misfit`, of a surface that explains the
            markers, for a skin that is no membrane has some of both; and how much larger it may be, times the size over the
            displacement (rms): a rest image that has aged looks the same while the surface hardly moves.
        largest_pushed: share of the surface that contacts push, of a surface that explains the markers: where all is pushed,
            nothing tells the fluid's pressure from a contact's.
        likely_objective: what is minimised, over the markers seen, of a solution that is not solved again: of a contact where
            nothing moves, of any contact, and of none; as before.
        likely_of_press: so much more, up to the second, for a surface that has moved by its size (rms).
        worse_objective: what is minimised, over that of a first solution that has converged, above which a second is not taken.
        largest_outlying: share of the markers that may be `far` off before a second try is made.

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
    sharp_tau: tuple[float, float] = (1.0, 0.4)
    patience: int = 4
    patient_tau: tuple[float, float] = (16.0, 0.4)
    patient_fine_tau: tuple[float, float] = (2.0, 0.4)
    settling_steps: int = 16
    settled_step: float = 4e-4
    camera_motion: float = 0.005
    decline: float = 0.6
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
    patient_damping: float = 1e-3
    coarsest: int = 6
    largest_relative_step: float = 2e-3
    largest_volume_error: float = 1e-3
    largest_misfit: float = 1.5
    misfit_of_press: float = 2.0
    largest_unexplained: float = 2.0
    unexplained_of_press: float = 30.0
    largest_shared_misfit: float = 1.35
    largest_doubt: tuple[float, float] = (1.0, 5e-4)
    largest_pushed: float = 0.55
    likely_objective: tuple[float, float, float] = (0.45, 0.95, 1.8)
    likely_of_press: float = 80.0
    worse_objective: float = 0.9
    largest_outlying: float = 0.01

    def __post_init__(self) -> None:
        for name in ("steps", "coarse_steps", "fine_steps", "finer_steps"):
            if getattr(self, name) < 2:
                raise MembraneError(f"ForceBalanceSettings: {name} = {getattr(self, name)}; expected at least 2")
        if not self.pressure_noise > 0:
            raise MembraneError(f"ForceBalanceSettings: pressure_noise = {self.pressure_noise}; expected more than 0")

    @property
    def far(self) -> float:
        """Of a marker off its ray, over its noise: what no more can be said of than that it is far off."""
        return 4 * self.outlier

    def gnc_schedule(self, steps: int, tau: tuple[float, float]) -> list[tuple[float, float]]:
        """Scales of the losses in every step, graduated non-convexity: of compressive tractions (tau), of markers."""
        first, last = tau
        taus = [first * (last / first) ** min(1.0, k / (self.decline * (steps - 1))) for k in range(steps)]
        return [(tau, self.outlier * (tau / last) ** OUTLIER_DECAY_POWER) for tau in taus]
