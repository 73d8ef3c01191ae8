"""Gauss-Newton steps of force balance in surface, pressure and camera motion, with linearised volume."""

from collections.abc import Sequence
from functools import partial
from typing import Any, NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from ...control_flow import chunked, fori_loop, traced, where_rows
from ...machine_code import takes
from ...mechanics.cavity import CavityLaw
from ...solve.implicit import differentiable
from ...solve.kkt import border_unknowns
from ...solve.stencil import inner
from .kernels.steps import NativeSteps
from .marker_residuals import MeasuredRays
from .normal_equations import BalanceEquations, NormalEquations
from .pressure_gauge import gauge_loss, pulled
from .robust import Cauchy
from .settings import ForceBalanceSettings
from .traction_loss import LossTerms

VERTICES = 9000
"""Number of vertices of a batch that are processed at a time, so that the data of a step stay in the processor's cache; machine
code processes at least one frame per thread."""


class State(NamedTuple):
    """The unknowns of the steps.

    Attributes:
        u: displacement of the surface from rest, `[B, V, 3]`; positions in float32 would lose the strain of a slack sheet.
        pressure: pressure difference across the membrane, `[B]`.
        moved: motion of the cameras of the W views, `[B, 4 W]`.
    """

    u: Tensor
    pressure: Tensor
    moved: Tensor


class Scales(NamedTuple):
    """Parameters of a step, `[]` each.

    Attributes:
        tau: scale of the loss of compressive traction.
        outlier: scale of the markers' loss.
        cone: as for `TractionLoss.weights`.
        renewal: as in the memory of `TractionLoss.weights`.
        damping: relative increase of the matrix's diagonal.
    """

    tau: Tensor
    outlier: Tensor
    cone: Tensor
    renewal: Tensor
    damping: Tensor


class GaussNewton(nn.Module):
    """Iteratively reweighted Gauss-Newton steps with a schedule of the losses' scales.

    Args:
        equations: linearised and weighted equations of force balance.
        cavity: law of the cavity's filling.
        settings: settings of the estimator.
    """

    def __init__(self, equations: BalanceEquations, cavity: CavityLaw, settings: ForceBalanceSettings):
        super().__init__()
        self.equations, self.cavity, self.settings = equations, cavity, settings
        self.membrane = equations.forces.membrane
        self.inner_grid = self.membrane.grid[0] - 2, self.membrane.grid[1] - 2
        self.native, self._given = NativeSteps(), (equations, cavity)

    def forward(
        self,
        state: State,
        measured: MeasuredRays,
        schedule: list[tuple[float, float]],
        settling: int = 1,
        damping: float | None = None,
    ) -> tuple[State, Tensor]:
        """Return the state after the steps of a schedule, and the displacement before the last step.

        Args:
            state: initial state.
            measured: the markers' rays.
            schedule: scales of the losses in every step.
            settling: number of last steps with at least `damping`, so that the solution settles.
            damping: damping of these steps; default `settling_damping`.
        """
        frames = max(1, VERTICES // self.membrane.rest.shape[0])
        if self.is_native(*state, *measured):
            frames = max(frames, torch.get_num_threads())
        damping = self.settings.settling_damping if damping is None else damping
        taus, size = [tau for tau, _ in schedule], len(schedule)
        numbers = [self._numbers(taus[: k + 1], damping if size - k <= settling else 0.0) for k in range(size)]
        rows = [(*scales, self.equations.loss.cone, *others) for scales, others in zip(schedule, numbers, strict=True)]
        u, pressure, moved, before = chunked(frames, self._run_chunk, (*state, *measured), rows, settling)
        return State(u, pressure, moved), before

    def _numbers(self, taus: list[float], least: float) -> tuple[float, float]:
        """Return the renewal and the damping of a step.

        While the scales decrease, the weights of the step before are not used, because the weights would lag behind.

        Args:
            taus: scales `tau` of all steps up to this one.
            least: smallest damping, except in the first step.
        """
        settings, (first, last) = self.settings, self.settings.tau
        *before, tau = taus
        damping = settings.damping * (min(tau, first) / last) ** 2
        if before:
            damping = max(damping, least)
        return settings.renewal if before[-1:] == [tau] else 1.0, damping

    def _run_chunk(self, u: Tensor, pressure: Tensor, moved: Tensor, *given: Any) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Return the state after the steps, and the displacement before the last; `given` are the rays, the parameters of the
        steps, and the number of settling steps."""
        *of_markers, rows, settling = given
        measured, last = MeasuredRays(*of_markers), rows[-settling:] if settling > 1 else []
        state: Sequence[Any] = (u, pressure, moved, u, self._unweighted(u))
        first = rows[: len(rows) - len(last)]
        if self.is_native(*state, *of_markers):
            state = self.native.take(*self._given, State(u, pressure, moved), state[4], measured, first)
        else:
            state = fori_loop(self._next, first, state, measured)
        if last:
            state = fori_loop(self._step_keeping_best, last, (*state, *state[:4], self._none_found(pressure)), measured)[5:]
        u, pressure, moved, before = state[:4]
        return u, pressure, moved, before

    def is_native(self, *values: Any) -> bool:
        """Return whether machine code takes the steps of these tensors."""
        return self.equations.bearings.in_machine_code and takes(*values, self.equations.forces.elasticity.prestretch)

    @traced
    def _unweighted(self, u: Tensor) -> Tensor:
        """Return a placeholder for the weights of a step before the first, `[B, N]`; the first step does not use it."""
        return torch.ones_like(u[:, : self.equations.loss.area.shape[0], 0])

    @traced
    def _none_found(self, pressure: Tensor) -> Tensor:
        """Return the objective of a state that does not exist yet: infinity, `[B]`."""
        return torch.full_like(pressure, torch.inf)

    def objective(self, state: State, traction: Tensor, normal: Tensor, measured: MeasuredRays) -> Tensor:
        """Return the objective of the last steps, `[B]`: the misfit of markers and gauge, and the loss of the tractions."""
        terms: LossTerms = self.equations.loss(traction, normal, measured.noise_level)
        angles = self.equations.bearings.angles(state.u, measured, state.moved)[0]
        return self.misfit(angles, state.pressure, measured) + terms.others + terms.pushes

    def objective_at_rest(self, measured: MeasuredRays) -> Tensor:
        """Return the objective at rest, without camera motion and tractions, `[B]`."""
        still, none = torch.zeros_like(self.membrane.rest[None]), torch.zeros_like(measured.noise_level)
        angles = self.equations.bearings.angles(still, measured, none[:, None].expand(-1, measured.motion.shape[2]))[0]
        return self.misfit(angles, none + self.cavity.rest_pressure, measured)

    def misfit(self, angles: Tensor, pressure: Tensor, measured: MeasuredRays) -> Tensor:
        """Return the part of the objective from markers with `angles [B, 2, D]`, and from a gauge, `[B]`."""
        misfit = measured.weight * angles.square().sum(1)
        of_markers: Tensor = Cauchy(self.settings.outlier).loss(misfit).sum(-1)
        return of_markers + gauge_loss(measured.gauge, pressure - self.cavity.rest_pressure)

    def tractions(self, u: Tensor, pressure: Tensor) -> tuple[Tensor, Tensor]:
        """Return contact tractions and outward normals at the inner vertices, `[B, 3, N]` each."""
        traction = self.equations.forces(u, pressure) / self.membrane.rest_area[:, None]
        normals = self.membrane.normals(self.membrane.rest + u)
        return inner(traction, self.membrane.grid).mT, inner(normals, self.membrane.grid).mT

    def traction(self, state: State, measured: MeasuredRays) -> Tensor:
        """Return the contact tractions `[B, V, 3]`."""
        if self.is_native(*state, *measured):
            return self.native.solution(*self._given, state, state.u, measured, 1.0)[1]
        traction: Tensor = self.equations.forces(state.u, state.pressure) / self.membrane.rest_area[:, None]
        return traction

    @traced
    def _next(
        self,
        u: Tensor,
        pressure: Tensor,
        moved: Tensor,
        before: Tensor,
        weights: Tensor,
        measured: MeasuredRays,
        *scales: float,
    ) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
        """Take a step; return the state, the displacement before it, and the weights of normal tractions."""
        state, weights = self._compiled_step(State(u, pressure, moved), weights, measured, scales)
        return *state, u, weights

    @traced
    def _step_keeping_best(
        self, u: Tensor, pressure: Tensor, moved: Tensor, before: Tensor, weights: Tensor, *given: Any
    ) -> list[Tensor]:
        """Take a step, and keep the state with the lowest objective, with the displacement before it and its objective.

        If a vertex is alternately pushed and pulled, not every step gives a usable solution.

        Args:
            u: current displacement, `[B, V, 3]`.
            pressure: current pressure, `[B]`.
            moved: current camera motion, `[B, 4 W]`.
            before: displacement before the last step, `[B, V, 3]`.
            weights: weights of normal tractions, `[B, N]`.
            given: the best state so far, the measured rays, and the parameters of the step.
        """
        *kept, lowest, measured = given[:6]
        state, weights = self._compiled_step(State(u, pressure, moved), weights, measured, given[6:])
        objective = self.objective(state, *self.tractions(*state[:2]), measured)
        is_lower = objective < lowest
        return [*state, u, weights, *where_rows(is_lower, (*state, u, objective), (*kept, lowest))]

    def _compiled_step(
        self, state: State, weights: Tensor, measured: MeasuredRays, scales: Sequence[float]
    ) -> tuple[State, Tensor]:
        """Take `step` as a region that `torch.compile` traces and compiles only once; the exporter does the same by itself.

        With gradients every step is traced: the gradients of a nested region have strides that torch 2.13 does not handle.
        """
        if self.is_native(*state, weights, *measured):
            *after, _, weights = self.native.take(*self._given, state, weights, measured, [scales])
            return State(*after), weights
        numbers = Scales(*(scale if isinstance(scale, Tensor) else state.u.new_full((), scale) for scale in scales))
        if torch.compiler.is_exporting() or torch.is_grad_enabled():
            return self.step(state, weights, measured, numbers)
        *after, weights = self._nested_step(state, weights, measured, numbers)
        return State(*after), weights

    @torch.compiler.nested_compile_region
    def _nested_step(self, state: State, weights: Tensor, measured: MeasuredRays, scales: Scales) -> tuple[Tensor, ...]:
        """Return the tensors of `step` in a plain tuple: torch 2.13 traces a region that returns named tuples at every call."""
        after, weights = self.step(state, weights, measured, scales)
        return *after, weights

    def step(self, state: State, weights: Tensor, measured: MeasuredRays, scales: Scales) -> tuple[State, Tensor]:
        """Take one reweighted Gauss-Newton step with linearised volume, limiting the longest step of a vertex.

        Args:
            state: state before the step.
            weights: weights of the normal tractions in the step before, `[B, N]`.
            measured: the markers' rays.
            scales: scales of the losses, and the step's other parameters.

        Returns:
            The state and the weights after the step.
        """
        tau, outlier, cone, renewal, damping = scales
        equations, (u, pressure, moved) = self.equations, state
        _, normal, loads, corner, motion, weights = equations.linearised(
            *state, measured, tau, outlier, cone, memory=(weights, renewal)
        )
        loads = torch.cat([loads, motion.coupling], 1)
        first, last = self.settings.tau
        blunt = (tau.clamp_max(first) / last) ** 2  # 1 at the last tau
        solved = self._solved(normal, loads, damping)
        motion = motion.with_prior(moved, self.settings.camera_motion * blunt)
        products, following = motion.eliminated(loads @ solved.mT)
        corner = pulled(corner, measured.gauge, pressure - self.cavity.rest_pressure)
        shares = self._shares(u, pressure, products, corner)
        turn = (following @ shares[..., None])[..., 0]
        move = F.pad(-(torch.cat([shares, turn], 1)[:, None] @ solved).unflatten(-1, (3, *self.inner_grid))[:, 0], (1, 1, 1, 1))
        share = self._share(u, move)
        u = u + share[:, None, None] * move.flatten(2).mT
        return State(u, pressure + share * shares[:, 2], moved + share[:, None] * turn), weights

    def _solved(self, normal: NormalEquations, loads: Tensor, damping: Tensor) -> Tensor:
        """Return the solutions `[B, C, 3 N]` of the damped equations; gradients are those of the exact solution."""
        equations = self.equations
        if torch.compiler.is_compiling():
            return equations.system.substitute(equations.system.factor(equations.matrix(normal, damping)), loads)
        with torch.no_grad():
            substitute = partial(equations.system.substitute, equations.system.factor(equations.matrix(normal, damping)))
        return differentiable(substitute, partial(equations.product, normal, damping=damping), loads)

    def _shares(self, u: Tensor, pressure: Tensor, products: Tensor, corner: tuple[Tensor, Tensor]) -> Tensor:
        """Return the coefficients `[B, 3]` of the three loads' solutions in the negative step: the multiplier of the volume
        constraint, 1, and the increase of the pressure."""
        one = torch.ones_like(pressure)
        if self.cavity.filling == "open":
            return torch.stack([0 * one, one, 0 * one], 1)
        fWv, vWv = corner
        change = self.membrane.volume(self.membrane.rest + u) - self.membrane.rest_volume
        target, compliance = self.cavity.condition(change, pressure)
        multiplier, rise = border_unknowns(products, vWv, fWv, compliance, target)
        return torch.stack([multiplier, one, rise], 1)

    def _share(self, u: Tensor, move: Tensor) -> Tensor:
        """Return the factor `[B]` that scales a step `move [B, 3, m, n]`, to limit the motion of vertices and the stretch of
        the grid's edges."""
        settings, tiny = self.settings, torch.finfo(u.dtype).tiny
        both = torch.stack([move, (self.membrane.rest + u).mT.unflatten(-1, self.membrane.grid)], 1)
        far2 = move.square().sum(1).flatten(1).amax(-1) / (settings.longest_step * self.membrane.size) ** 2
        for axis in (-2, -1):
            change2, edge2 = both.diff(dim=axis).square().sum(2).unbind(1)
            stretch2 = (change2 / edge2.clamp_min(tiny)).flatten(1).amax(-1)
            far2 = torch.maximum(far2, stretch2 / settings.largest_stretch**2)
        share: Tensor = far2.clamp_min(1.0).rsqrt()
        return share
