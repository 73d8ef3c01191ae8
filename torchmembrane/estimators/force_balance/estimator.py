"""Force balance: the surface and the pressure whose residual forces, the contact forces, are sparse and compressive.

Every vertex has three equations of equilibrium and one unobserved depth. With the contact traction

    q_k = (grad_k U(x) - h_k - p grad_k V(x)) / a_k,    s = -q . n / p0 the compressive normal part, q_t the shear,

    min over x, p:  sum_d 1/2 R^2 log(1 + |r_d(x)|^2 / (R sigma)^2)
                    + beta sum_k a_k [f(s_k; S_k) + kappa (sqrt(|q_t|^2 / p0^2 + slip^2) - slip) / (1 + c S_k)]

subject to the cavity's law. `r_d` is the angle between a marker's ray and its modelled position; its Cauchy loss gives little
weight to wrongly matched markers. A convex body without friction pushes with at least the fluid's pressure or not at all, so a
small push (compressive traction) is noise or discretisation error, and a large one a contact. The loss `f` of a push is
therefore quadratic at first and saturates beyond `tau` (Geman-McClure), that of a tensile traction is quadratic, and shear
(pseudo-Huber) weighs less under a push. Because contacts are patches, `S_k` is the rms of `s` over a Gaussian neighbourhood of
radius `reach`, and the weights of the steps are evaluated at `S_k` instead of `s_k`.

The solver is iteratively reweighted least squares (IRLS) with Gauss-Newton steps, while `tau` decreases from where all losses
are quadratic (graduated non-convexity, GNC), starting from the rest surface. A fine grid starts from the solution on every
second line, with an `InitialGuess` in the contacts. Every frame lowers `tau` at its own speed (`schedule`).
"""

from dataclasses import replace
from typing import Any, ClassVar, Self

import torch
from torch import Tensor

from ...control_flow import traced
from ...mechanics.cavity import CavityLaw, rest_balance
from ...mechanics.hyperelastic import ElasticEnergy
from ...sensor.parts import FRICTION
from ...solve.stencil import pad_border
from ...surface.bicubic import Refinement
from ...surface.membrane import Membrane
from ...surface.projection import SurfacePoints
from ...torch_modes import on_cpu, without_autocast
from ..base import Deviations, Equilibrium, Estimator, Observation, Problem, StandardDeviations
from ..contacts import Contacts
from .contact_force import ContactForce
from .gauss_newton import GaussNewton, State
from .kernels.steps import compiled
from .lever_residuals import residuals_of
from .marker_residuals import MarkerResiduals, MeasuredRays, marker_rays, rest_rays, seen_from_origin
from .normal_equations import BalanceEquations
from .pressure_gauge import gauge_reading, refuse_open
from .settings import ForceBalanceSettings
from .starts import InitialGuess
from .traction_loss import TractionLoss
from .uncertainty import depths, gap_around, noise_of_pushes, of_presses, shares_of_deepest, spreads, standard_deviations

AGED = 5e-4
"""Increase of the limit of both reasons for doubt together, per inverse rms displacement: while the surface hardly moves, a
rest image that has aged looks like a skin that is no membrane."""
COARSEST_LINES = 6
"""Smallest number of lines of a coarser grid."""
LOSS_OF_NOISE = 1.0
"""Expected loss of a marker that noise alone moves in the image: half the sum of the squares of two angles of variance 1."""
MIN_RESOLVED_LINES = 17
"""Lines of a grid with a discretisation error below the markers' noise; on coarser ones it grows as the square of the step."""


@on_cpu
class ForceBalance(Estimator):
    """Estimates surface, contact tractions and pressure from marker rays.

    If the grid has an odd number of lines, at least 11, `coarse` is the estimator on every second line. The reference traction
    `p0` is the largest of the rest pressure, tension / size and (C1 + C2) / size.

    Args:
        membrane: the rest surface on the solver's grid.
        elasticity: elastic energy of the membrane.
        markers: the markers as points on the membrane.
        positions: rest positions of the markers, `[D, 3]`.
        noise: angular noise of a marker including the grid's error, radians, for observations without their own.
        filling: filling of the cavity, as for `CavityLaw`.
        gas: absolute pressure and volume of a gas at rest.
        settings: all other settings.
        rest: the markers' rays at rest with their noise; None: rays from the origin, with `noise`.
        views: number of views that see the markers, which are listed once for each view.
        levers: vectors from the markers to their visible tips at rest, `[D, 3]`; None: the markers lie on the surface.
        friction: coefficient of friction between the membrane and what touches it.

    Limitations:
        The tractions of the press must exceed those due to noise. Two contacts within `reach` are not resolved.
    """

    Settings: ClassVar[type[ForceBalanceSettings]] = ForceBalanceSettings
    needs_every_vertex: ClassVar[bool] = False
    finds_tractions: ClassVar[bool] = True
    in_parts: ClassVar[bool] = True
    takes_views: ClassVar[bool] = True
    takes_heights: ClassVar[bool] = True
    settings: ForceBalanceSettings

    def __init__(
        self,
        membrane: Membrane,
        elasticity: ElasticEnergy,
        markers: SurfacePoints,
        positions: Tensor,
        noise: float,
        filling: str = "liquid",
        gas: tuple[float, float] | None = None,
        settings: ForceBalanceSettings | None = None,
        rest: Observation | None = None,
        views: int = 1,
        levers: Tensor | None = None,
        friction: float = FRICTION,
    ):
        settings, spacing = settings or ForceBalanceSettings(), membrane.size / (len(positions) // views) ** 0.5
        super().__init__(membrane, CavityLaw(membrane, rest_balance(membrane, elasticity)[0], filling, gas), settings, spacing)
        self.size, self.coarseness = membrane.size, _coarseness(membrane)
        self._far = settings.far * self.coarseness
        tension, stiffness = float(elasticity.tension), float(elasticity.c1 + elasticity.c2)
        self.reference = max(float(self.rest_pressure), tension / self.size, stiffness / self.size)
        bearings = residuals_of(membrane, markers, positions, noise, rest, views, levers)
        given = dict(rest=rest, filling=filling, gas=gas, views=views, levers=levers)
        self.coarse = self._coarser(elasticity, bearings, friction, **given)
        self.refinement = None if self.coarse is None else Refinement(self.coarse.membrane.grid, membrane.grid)
        loss = TractionLoss(membrane, self.reference, settings, friction)
        self.equations = BalanceEquations(ContactForce(membrane, elasticity), bearings, loss)
        self.gauss_newton = GaussNewton(self.equations, self.cavity, settings)
        self.dent = InitialGuess(self.gauss_newton) if self.coarse is not None and self.coarse.coarse is None else None
        self.steps = settings.steps[0 if self.coarse is None else 2 if self.dent is None else 1]
        self._first_tau = settings.tau[0 if self.coarse is None else 1]
        rest = seen_from_origin(bearings.seen_at_rest) if rest is None else rest
        loss.push_noise = noise_of_pushes(self.equations, self.cavity, rest, settings.camera_motion)

    @classmethod
    def from_problem(cls, problem: Problem, settings: ForceBalanceSettings | None = None) -> Self:
        """Build the estimator for a sensor."""
        rest, noise = rest_rays(problem)
        surface = problem.membrane, problem.elasticity, problem.markers, problem.positions
        sensor = noise, problem.filling, problem.gas
        return cls(*surface, *sensor, settings, rest, problem.views, levers=problem.levers, friction=problem.friction)

    def _coarser(self, elasticity: ElasticEnergy, bearings: MarkerResiduals, friction: float, **others: Any) -> Self | None:
        """Return the estimator on every second line, or None if these are too few.

        Its discretisation error is four times as large, and so is the step with which a frame has settled. Where this error
        exceeds the markers' noise, the scale of the markers' loss grows as the step of the grid, so that no markers are lost to
        the error, and the friction falls as its square, because the error looks like friction.
        """
        membrane, grid, positions = self.membrane, self.membrane.grid, bearings.positions
        if any(count % 2 == 0 or count < 2 * COARSEST_LINES - 1 for count in grid):
            return None
        every_second = Membrane(*(a.unflatten(0, grid)[::2, ::2].numpy() for a in (membrane.rest, membrane.fixed)))
        markers, material = every_second.closest_points(positions.numpy()), elasticity.for_membrane(every_second)
        growth = _coarseness(every_second) / self.coarseness
        given = every_second, material, markers, positions, bearings.noise
        outlier, tol = self.settings.outlier * growth**0.5, 4 * self.settings.settled_step_tol
        settings = replace(self.settings, outlier=outlier, settled_step_tol=tol)
        return type(self)(*given, settings=settings, friction=friction / growth, **others)

    @property
    def must_compile(self) -> bool:
        """Whether the first frame has to wait until machine code is compiled."""
        taken = self.membrane.rest.is_cpu and self.equations.bearings.in_machine_code
        return taken and not compiled.is_compiled(self.membrane.rest.numpy().dtype)

    @property
    def solves_in_double(self) -> bool:
        """Whether the sheet is too slack to be solved in single precision."""
        return self.equations.is_slack

    @property
    def elasticity(self) -> ElasticEnergy:
        """Elastic energy of the membrane."""
        return self.equations.forces.elasticity

    def set_prestretch(self, prestretch: Tensor) -> None:
        """Change the prestretch `[]`, which may require gradients, with rest pressure and rest load but not `reference`."""
        self.elasticity.prestretch = prestretch
        with without_autocast(prestretch.device.type):
            self.cavity.rest_pressure, self.equations.forces.rest_load = rest_balance(self.membrane, self.elasticity)
        if self.coarse is not None:
            self.coarse.set_prestretch(prestretch)

    def prepare(self, camera: Any, pixels: Tensor, confidence: Tensor, covariance: Tensor | None = None) -> Observation:
        """Return the rays of the markers seen at `pixels [B, D, 2]`, each with its own noise if `covariance` is given."""
        if covariance is None:
            origins, directions = camera.pixel_to_ray(pixels)
            return Observation(origins, directions, confidence)
        return marker_rays(camera, pixels, self.equations.bearings.seen_at_rest, confidence, covariance)

    def check_gauge(self) -> None:
        """Refuse a gauge for an open cavity."""
        refuse_open(self.cavity.filling)

    def gauged(self, observation: Observation, pressure: Tensor | float) -> Observation:
        """Add the pressure read by a gauge, `[B]` or `[]`, NaN without a reading, to the observation."""
        self.check_gauge()
        deviation = self.settings.pressure_noise * self.reference
        return observation._replace(gauge=gauge_reading(pressure, self.rest_pressure, deviation, observation.confidence))

    def forward(self, observation: Observation) -> Equilibrium:
        """Reconstruct the surface from the markers' rays."""
        measured = self.equations.bearings.measured(observation)
        with torch.no_grad():
            state, before = self._solve_on_grid(measured)
        return self.equilibrium(*self.gauss_newton.with_gradients(state, measured), before, measured)

    def _solve_on_grid(self, measured: MeasuredRays) -> tuple[State, Tensor]:
        """Return the state after the steps on the coarser grids and this one, and the displacement before the last step."""
        found: tuple[State, Tensor] = self.gauss_newton(self._begun(measured), measured, self._first_tau, self.steps)
        return found

    def _begun(self, measured: MeasuredRays) -> State:
        """Return the rest state on the coarsest grid, and on any other the solution of the coarser one; on the second coarsest
        with a dent where a first step finds pushes."""
        if self.coarse is None:
            return self.at_rest(measured.weight)
        state = State(*self.refined(*self.coarse._solve_on_grid(measured)[0]))
        if self.dent is None:
            return state
        return State(*self.dent(*self.gauss_newton(state, measured, self._first_tau, 1)[0], measured))

    @traced
    def at_rest(self, confidence: Tensor) -> State:
        """Return the rest state, with cameras that have not moved, for every row of `confidence [B, D]`."""
        frames, pressure = confidence.shape[0], self.rest_pressure
        still = (0 * pressure).repeat(frames, 4 * self.equations.bearings.views)
        return State(torch.zeros_like(self.membrane.rest).repeat(frames, 1, 1), pressure.repeat(frames), still)

    @traced
    def coarsened(self, u: Tensor, pressure: Tensor, moved: Tensor) -> State:
        """Restrict a state to the grid of `coarse`, with the same change of pressure from rest."""
        return State(u.unflatten(1, self.membrane.grid)[:, ::2, ::2].flatten(1, 2), pressure - self._above_coarse(), moved)

    @traced
    def refined(self, u: Tensor, pressure: Tensor, moved: Tensor) -> State:
        """Interpolate a state of `coarse` on this grid; the displacement is bicubic, so that it has no kinks at the lines."""
        assert self.refinement is not None  # only called with a solution of the coarser grid
        return State(self.refinement(u) * self.equations.forces.free, pressure + self._above_coarse(), moved)

    def _above_coarse(self) -> Tensor:
        """Return the rest pressure minus that of `coarse`, `[]`; every grid has its own."""
        assert self.coarse is not None
        return self.rest_pressure - self.coarse.rest_pressure

    @traced
    def equilibrium(self, u: Tensor, pressure: Tensor, moved: Tensor, before: Tensor, measured: MeasuredRays) -> Equilibrium:
        """Return the solution of a state; `before` is the displacement one step earlier."""
        membrane, steps, x = self.membrane, self.gauss_newton, self.membrane.rest + u
        if steps.is_native(u, pressure, moved, before, *measured):
            given = self.equations, self.cavity, (u, pressure, moved), before, measured, self._far
            (step, volume, misfit, *reasons), traction, reference = steps.native.solution(*given)
            return Equilibrium(x, pressure, volume, traction, step, reference, misfit, moved, *reasons)
        loss, step = self.equations.loss, (u - before).square().sum(-1).mean(-1).sqrt() / self.size
        (traction, normal), grid = steps.tractions(u, pressure), membrane.grid
        terms, seen = loss(traction, normal, measured.noise_level), measured.weight.sum(-1).clamp_min(1)
        angles = self.equations.bearings.angles(u, measured, moved)[0]
        unexplained = (steps.misfit(angles, pressure, measured) + terms.others) / seen
        objective = unexplained + terms.pushes / seen
        scale = 1 + pad_border(loss.contact_scale(terms, measured.noise_level)[..., None] - 1, grid)[..., 0]
        misfit, shared = self.equations.bearings.misfits(angles, measured, self.settings.outlier, self._far)
        reasons, traction = [objective, unexplained, shared], pad_border(traction.mT, grid)
        return Equilibrium(x, pressure, membrane.volume(x), traction, step, self.reference * scale, misfit, moved, *reasons)

    @traced
    def is_converged(self, found: Equilibrium) -> Tensor:
        """Return where the last step was short and the volume fulfils the cavity's law, `[B]` bool. A step of which only a part
        was taken may be short and leave the law unfulfilled."""
        error, tol = self.cavity.volume_error(found.volume, found.pressure).abs(), self.settings.convergence_tol
        return ~((found.relative_step > tol) | (error > tol))

    def is_explained(self, found: Equilibrium) -> Tensor:
        """Return where a surface of this sensor explains the markers, `[B]` bool: the objective without pushes, the misfit that
        neighbours share, and the sum of both, each relative to its limit, are small."""
        settings, press = self.settings, self._press(found)
        largest = LOSS_OF_NOISE + settings.unexplained_per_displacement * press
        pulls = found.unexplained / largest / self.coarseness**2
        alike = found.shared_misfit / settings.largest_shared_misfit / self.coarseness
        return torch.logical_not((pulls.maximum(alike) > 1) | (pulls + alike > 1 + AGED / press))

    def _press(self, found: Equilibrium) -> Tensor:
        """Return the rms displacement relative to the size, `[B]`."""
        return torch.sqrt((found.vertices - self.membrane.rest).square().sum(-1).mean(-1) / self.size**2)

    def contacts(self, found: Equilibrium, normals: Tensor) -> Contacts:
        """Return the contacts: patches of compressive traction."""
        return self.patches.pushes(found.vertices, normals, found.traction, found.reference, self.equations.loss.surroundings)

    def deviations(self, found: Equilibrium, observation: Observation, contacts: Contacts) -> Deviations:
        """Return the standard deviations of force and depth, computed on the grid of `coarse`: cheaper, and as accurate."""
        u, whole = found.vertices - self.membrane.rest, (found.pressure, found.moved)
        net, state = (self, State(u, *whole)) if self.coarse is None else (self.coarse, self.coarsened(u, *whole))
        force, depth = (found.traction * self.membrane.rest_area[:, None]).sum(1), depths(self.membrane, u)
        with torch.no_grad():
            spread = spreads(net.gauss_newton, self.settings, state, observation)
            gap = gap_around(shares_of_deepest(depth), self.equations.bearings.positions, observation.confidence, self.membrane)
        unseen = self.equations.loss.push_noise.mean() * self.reference * self.size**2
        return of_presses(spread, force, depth.amax(-1), gap, contacts, self.membrane, unseen)

    def standard_deviations(
        self, x: Tensor, pressure: Tensor, moved: Tensor, observation: Observation, marker_noise: float | Tensor
    ) -> StandardDeviations:
        """Return the standard deviations of a solution's surface, total force and pressure due to the markers' noise.

        Limitations:
            They are first order: noise must not change which vertices are pushed, as it does in the shallowest presses and
            where two solutions compete. Errors of the grid and of the material are not included.
        """
        x, pressure, moved = (value.to(self.membrane.rest.dtype) for value in (x, pressure, moved))
        state = State(x - self.membrane.rest, pressure, moved)
        return standard_deviations(self.equations, self.cavity, self.settings, state, observation, marker_noise)


def _coarseness(membrane: Membrane) -> float:
    """Return the discretisation error of a grid relative to that of `MIN_RESOLVED_LINES` lines, at least 1."""
    step: float = (MIN_RESOLVED_LINES - 1) / (min(membrane.grid) - 1)
    return max(1.0, step * step)
