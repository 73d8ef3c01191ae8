"""Gauss-Newton steps of force balance in surface, pressure and camera motion, with linearised volume."""

from functools import partial
from typing import Any, NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from ...control_flow import chunked, repeat_rows, traced
from ...machine_code import takes
from ...mechanics.cavity import CavityLaw
from ...solve.implicit import differentiable, differentiable_fixed_point, refined
from ...solve.kkt import border_unknowns
from ...solve.stencil import inner
from . import schedule
from .kernels.steps import NativeSteps
from .marker_residuals import MeasuredRays
from .normal_equations import BalanceEquations, NormalEquations
from .pressure_gauge import gauge_loss, pulled
from .robust import Cauchy
from .schedule import LEAST_MOVE, RELAXATION, falling, outlier_scale, scaled_step, settling_of, share_of_next
from .settings import ForceBalanceSettings

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


class GaussNewton(nn.Module):
    """Iteratively reweighted Gauss-Newton steps, in which every frame lowers the losses' scales at its own speed.

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

    def forward(self, state: State, measured: MeasuredRays, tau: float, steps: int) -> tuple[State, Tensor]:
        """Return the state in which each frame has settled, and the displacement before the last step.

        A frame has settled when the `scaled_step` at the last `tau` is at most `settled_step_tol`. Shortly before, it takes
        only a part of each step, `share_of_next`. Frames that have not settled when `SETTLING_STEPS` steps are left take at
        most the share `RELAXATION` of each of these.

        Args:
            state: initial state.
            measured: the markers' rays.
            tau: first scale of the loss of compressive traction.
            steps: largest number of steps.
        """
        frames = max(1, VERTICES // self.membrane.rest.shape[0])
        if self.is_native(*state, *measured):
            frames = max(frames, torch.get_num_threads())
        u, pressure, moved, before = chunked(frames, self._run_chunk, (*state, *measured), tau, steps)
        return State(u, pressure, moved), before

    def _run_chunk(self, u: Tensor, pressure: Tensor, moved: Tensor, *given: Any) -> tuple[Tensor, ...]:
        """Return the state after the steps, and the displacement before the last; `given` are the rays, the first `tau` and the
        number of steps."""
        *of_markers, tau, steps = given
        state = State(u, pressure, moved)
        if self.is_native(*state, *of_markers):
            return tuple(self.native.take(*self._given, state, MeasuredRays(*of_markers), tau, steps))
        begun = self._begun(*state, tau, float(steps - settling_of(steps)))
        return tuple(repeat_rows(self._next, steps, begun, of_markers)[1:5])

    def with_gradients(self, state: State, measured: MeasuredRays) -> State:
        """Return a state in which all frames have settled, with the gradients of the fixed point of the steps."""
        if not torch.is_grad_enabled() or self.is_native(*state, *measured):
            return state
        sizes = [state.u.shape[1:].numel(), 1, state.moved.shape[1]]
        tau, whole = (torch.full_like(state.pressure, value) for value in (self.settings.tau[1], 1.0))

        def stepped(unknowns: Tensor) -> Tensor:
            u, pressure, moved = unknowns.split(sizes, 1)
            u = u.unflatten(1, (-1, 3)) * self.equations.forces.free  # what no step changes is no unknown
            p = self.cavity.rest_pressure.expand_as(tau) if self.cavity.filling == "open" else pressure[:, 0]
            after = self.step(State(u, p, moved), measured, tau, whole)
            return torch.cat([after.u.flatten(1), after.pressure[:, None], after.moved], 1)

        unknowns = torch.cat([state.u.flatten(1), state.pressure[:, None], state.moved], 1)
        u, pressure, moved = differentiable_fixed_point(stepped, unknowns).split(sizes, 1)
        return State(u.unflatten(1, (-1, 3)), pressure[:, 0], moved)

    def is_native(self, *values: Any) -> bool:
        """Return whether machine code, instead of tensor operations, can compute the steps for these tensors."""
        return self.equations.bearings.in_machine_code and takes(*values, self.equations.forces.elasticity.prestretch)

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
    def _begun(self, u: Tensor, pressure: Tensor, moved: Tensor, tau: float, left: float) -> tuple[Tensor, ...]:
        """Return the arguments of `_next` that it changes, before its first step."""
        done = torch.zeros_like(pressure, dtype=torch.bool)
        return done, u, pressure, moved, u, *(torch.full_like(pressure, value) for value in (tau, 1.0, left))

    @traced
    def _next(
        self,
        done: Tensor,
        u: Tensor,
        pressure: Tensor,
        moved: Tensor,
        before: Tensor,
        tau: Tensor,
        share: Tensor,
        left: Tensor,
        *of_markers: Any,
    ) -> tuple[Tensor, ...]:
        """Take a step in every frame; return whether it has settled, the state, the displacement before, and the next `tau`,
        `share` and `left`.

        Args:
            done: whether a frame has settled, `[B]`.
            u: current displacement, `[B, V, 3]`.
            pressure: current pressure, `[B]`.
            moved: current camera motion, `[B, 4 W]`.
            before: displacement before the last step, `[B, V, 3]`.
            tau: scale of the loss of compressive traction, `[B]`.
            share: share of the step that is taken, `[B]`.
            left: number of steps left before the relaxed ones, `[B]`. Relaxed steps have the last `tau`.
            of_markers: the measured rays.
        """
        last, is_whole = self.settings.tau[1], left > 0
        tau, share = torch.where(is_whole, tau, last), torch.where(is_whole, share, share.clamp_max(RELAXATION))
        state = self._compiled_step(State(u, pressure, moved), MeasuredRays(*of_markers), tau, share)
        step = self._scaled_step(u, state.u)
        tol, is_last = self.settings.settled_step_tol, ~(tau > last)
        share = torch.where(is_last, share_of_next(step, tol).clamp(0, 1), 1.0)
        tau, settled = (tau * falling(step.clamp_min(LEAST_MOVE))).clamp_min(last), is_last & ~(step > tol)
        return settled, *state, u, tau, share, left - 1

    def _scaled_step(self, u: Tensor, after: Tensor) -> Tensor:
        """Return the `scaled_step` between the displacements `u` and `after`, `[B, V, 3]` each, `[B]`."""
        moved, displacement = ((field.square().sum(-1).mean(-1).sqrt() / self.membrane.size) for field in (after - u, after))
        return scaled_step(moved, displacement)

    def _compiled_step(self, state: State, measured: MeasuredRays, tau: Tensor, share: Tensor) -> State:
        """Take `step` as a region that `torch.compile` traces and compiles only once; the exporter does the same by itself.

        With gradients every step is traced: the gradients of a nested region have strides that torch 2.13 does not handle.
        """
        if torch.compiler.is_exporting() or torch.is_grad_enabled():
            return self.step(state, measured, tau, share)
        return State(*self._nested_step(state, measured, tau, share))

    @torch.compiler.nested_compile_region
    def _nested_step(self, state: State, measured: MeasuredRays, tau: Tensor, share: Tensor) -> tuple[Tensor, ...]:
        """Return the tensors of `step` in a plain tuple: torch 2.13 traces a region that returns named tuples at every call."""
        return tuple(self.step(state, measured, tau, share))

    def step(self, state: State, measured: MeasuredRays, tau: Tensor, share: Tensor) -> State:
        """Take one reweighted Gauss-Newton step with linearised volume, limiting the stretch of an edge.

        Args:
            state: state before the step.
            measured: the markers' rays.
            tau: scale of the loss of compressive traction, `[B]`, on which the other scales depend.
            share: share of the step that is taken, `[B]`.

        Returns:
            The state after the step.
        """
        settings, equations, (u, pressure, moved) = self.settings, self.equations, state
        first, last = settings.tau
        blunt = (tau.clamp_max(first) / last) ** 2  # 1 at the last tau
        outlier = outlier_scale(torch.full_like(tau, settings.outlier), tau / last)
        _, normal, loads, corner, motion = equations.linearised(*state, measured, tau, outlier)
        loads = torch.cat([loads, motion.coupling], 1)
        solved = self._solved(normal, loads)
        motion = motion.with_prior(moved, settings.camera_motion * blunt[:, None])
        products, following = motion.eliminated(loads @ solved.mT)
        corner = pulled(corner, measured.gauge, pressure - self.cavity.rest_pressure)
        shares = self._shares(u, pressure, products, corner)
        turn = (following @ shares[..., None])[..., 0]
        move = F.pad(-(torch.cat([shares, turn], 1)[:, None] @ solved).unflatten(-1, (3, *self.inner_grid))[:, 0], (1, 1, 1, 1))
        share = share * self._share(u, move)
        u = u + share[:, None, None] * move.flatten(2).mT
        return State(u, pressure + share * shares[:, 2], moved + share[:, None] * turn)

    def _solved(self, normal: NormalEquations, loads: Tensor) -> Tensor:
        """Return the solutions `[B, C, 3 N]` of the equations, refined once; gradients are those of the exact solution."""
        system, product = self.equations.system, partial(self.equations.product, normal)
        if torch.compiler.is_compiling():
            return refined(partial(system.substitute, system.factor(self.equations.matrix(normal))), product, loads)
        with torch.no_grad():
            substitute = partial(system.substitute, system.factor(self.equations.matrix(normal)))
        return differentiable(partial(refined, substitute, product), product, loads)

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
        """Return the factor `[B]` that scales a step `move [B, 3, m, n]`, to limit the stretch of the grid's edges."""
        tiny = torch.finfo(u.dtype).tiny
        both = torch.stack([move, (self.membrane.rest + u).mT.unflatten(-1, self.membrane.grid)], 1)
        changes = [both.diff(dim=axis).square().sum(2).flatten(2).unbind(1) for axis in (-2, -1)]
        stretch2 = torch.cat([change2 / edge2.clamp_min(tiny) for change2, edge2 in changes], 1).amax(-1)
        share: Tensor = (stretch2 / schedule.LARGEST_STRETCH**2).clamp_min(1.0).rsqrt()
        return share
