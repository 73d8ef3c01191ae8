"""Gauss-Newton steps of force balance: surface and pressure, the volume linearised."""

from collections.abc import Sequence
from functools import partial
from typing import NamedTuple

import torch
from torch import Tensor, nn

from ..mechanics.cavity import CavityLaw
from ..pieces import piece, repeated
from ..solve.conjugate_gradient import conjugate_gradient
from ..solve.implicit import differentiable
from ..solve.kkt import BorderedStep, solve_bordered
from ..surface.stencil import inner, pad_border
from .bearings import Bearings
from .normal_equations import BalanceEquations, NormalEquations
from .pressure_gauge import gauge_loss, pulled
from .robust import Cauchy
from .settings import ForceBalanceSettings

Factor = tuple[Tensor, ...]


class State(NamedTuple):
    """What the steps change: the surface `x [B, V, 3]`, the `pressure [B]`, and by how much the camera has `moved [B, 4]`."""

    x: Tensor
    pressure: Tensor
    moved: Tensor


class Descent(nn.Module):
    """Reweighted Gauss-Newton steps by a schedule of the losses' scales.

    Args:
        equations: of the force balance, linearised and weighted.
        cavity: its law.
        settings: of the estimator.
    """

    def __init__(self, equations: BalanceEquations, cavity: CavityLaw, settings: ForceBalanceSettings):
        super().__init__()
        self.equations, self.cavity, self.settings = equations, cavity, settings
        self.membrane = equations.forces.membrane

    def forward(
        self,
        state: State,
        measured: Bearings,
        schedule: list[tuple[float, float]],
        one_factor: bool = False,
        cone: float | None = None,
    ) -> tuple[State, Tensor]:
        """The state after the steps of a schedule, and the surface before the last; `one_factor`: all with the factor of the
        first step; `cone`: as for `TractionLoss.weights`."""
        before, factor = state.x, None
        rows = [(*scales, self.equations.loss.cone if cone is None else cone) for scales in schedule]
        if one_factor:
            x, pressure, moved, before, factor = self._first(*state, measured, *rows[0])
            state, rows = State(x, pressure, moved), rows[1:]
        x, pressure, moved, before = repeated(self._next, rows, (*state, before), measured, factor)
        return State(x, pressure, moved), before

    def objective(self, state: State, traction: Tensor, normal: Tensor, measured: Bearings) -> Tensor:
        """What the last steps minimise, `[B]`: the misfit of the markers and of a gauge, and the loss of the tractions."""
        equations, (x, pressure, moved) = self.equations, state
        misfit = measured.weight * equations.bearings.angles(x, measured, moved)[0].square().sum(1)
        of_markers: Tensor = Cauchy(self.settings.outlier).loss(misfit).sum(-1)
        of_tractions: Tensor = equations.loss(traction, normal, measured.noise_level)
        return of_markers + of_tractions + gauge_loss(measured.gauge, pressure - self.cavity.rest_pressure)

    def tractions(self, x: Tensor, pressure: Tensor) -> tuple[Tensor, Tensor]:
        """The contact tractions of the inner vertices and their outward normals, `[B, 3, N]` each."""
        traction = self.equations.forces(x, pressure) / self.membrane.rest_area[:, None]
        return inner(traction, self.membrane.grid).mT, inner(self.membrane.normals(x), self.membrane.grid).mT

    @piece
    def _first(
        self, x: Tensor, pressure: Tensor, moved: Tensor, measured: Bearings, *scales: float
    ) -> tuple[Tensor, Tensor, Tensor, Tensor, Factor | None]:
        """The state, the surface before; the factor of the step's matrix."""
        state, factor = self._traced_once(State(x, pressure, moved), measured, scales, None, keeps=True)
        return *state, x, factor

    @piece
    def _next(
        self,
        x: Tensor,
        pressure: Tensor,
        moved: Tensor,
        before: Tensor,
        measured: Bearings,
        factor: Factor | None,
        *scales: float,
    ) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """The state, and the surface before."""
        state, _ = self._traced_once(State(x, pressure, moved), measured, scales, factor)
        return *state, x

    def _traced_once(
        self, state: State, measured: Bearings, scales: Sequence[float], factor: Factor | None, keeps: bool = False
    ) -> tuple[State, Factor | None]:
        """`step`, which `torch.compile` then traces and compiles once, not once per step; so does the exporter by itself.

        With gradients every step is: those of a nested region come with strides that torch 2.13 does not follow."""
        tau, outlier, cone = (torch.as_tensor(scale, dtype=state.x.dtype, device=state.x.device) for scale in scales)
        unrolled = torch.compiler.is_exporting() or torch.is_grad_enabled()
        step = self.step if unrolled else self._compiled_once
        taken: tuple[State, Factor | None] = step(state, measured, tau, outlier, cone, factor, keeps)
        return taken

    @torch.compiler.nested_compile_region
    def _compiled_once(
        self, state: State, measured: Bearings, tau: Tensor, outlier: Tensor, cone: Tensor, factor: Factor | None, keeps: bool
    ) -> tuple[State, Factor | None]:
        return self.step(state, measured, tau, outlier, cone, factor, keeps)

    def step(
        self,
        state: State,
        measured: Bearings,
        tau: Tensor,
        outlier: Tensor,
        cone: Tensor,
        factor: Factor | None = None,
        keeps: bool = False,
    ) -> tuple[State, Factor | None]:
        """One reweighted Gauss-Newton step, the volume linearised, the longest vertex step capped.

        Also returns the factor of its matrix if it `keeps` it: with the `factor` of a step near this one it makes none.
        """
        equations, (x, pressure, moved) = self.equations, state
        _, normal, loads, corner, motion = equations.linearised(*state, measured, tau, outlier, cone)
        loads = torch.cat([loads, motion.coupling], 1)
        first, last = self.settings.tau
        blunt = (tau.clamp_max(first) / last) ** 2  # 1 as tau ends
        made, solved = self._solved(normal, loads, self.settings.damping * blunt, factor, keeps)
        motion = motion.held(moved, self.settings.camera_motion * blunt)
        loads, solved = motion.eliminated(loads[:, :3], solved[:, :3], solved[:, 3:])
        corner = pulled(corner, measured.gauge, pressure - self.cavity.rest_pressure)
        move, rise = self._bordered_step(x, pressure, loads, solved, corner)
        turn = motion.following(move)
        move = move.unflatten(-1, (3, -1)).mT
        move = pad_border(move, self.membrane.grid)
        share = self._share(x, move)
        x = x + share[:, None, None] * move
        return State(x, pressure + share * rise, moved + share[:, None] * turn), made

    def _solved(
        self, normal: NormalEquations, loads: Tensor, damping: Tensor, factor: Factor | None, keeps: bool
    ) -> tuple[Factor | None, Tensor]:
        """The factor, of what is damped, if it is kept, and the solutions `[B, C, 3 N]`.

        Gradients of a factor that is not kept take what it solves, not how it was made.
        """
        equations = self.equations
        if factor is not None:
            return None, self._conjugated(normal, factor, loads)
        if keeps or torch.compiler.is_compiling():
            kept = self._factor(normal, damping)
            return kept, equations.system.substitute(kept, loads)
        with torch.no_grad():
            substitute = partial(equations.system.substitute, self._factor(normal, damping))
        return None, differentiable(substitute, partial(equations.product, normal, damping=damping), loads)

    def _factor(self, normal: NormalEquations, damping: Tensor) -> Factor:
        return self.equations.system.factor(self.equations.matrix(normal, damping))

    def _conjugated(self, normal: NormalEquations, factor: Factor, loads: Tensor) -> Tensor:
        """Solutions with the factor of equations near these."""
        equations, steps = self.equations, self.settings.conjugate_steps
        product, precondition = partial(equations.product, normal), partial(equations.system.substitute, factor)
        return conjugate_gradient(product, precondition, loads, steps)

    def _share(self, x: Tensor, move: Tensor) -> Tensor:
        """Of a step `move [B, V, 3]`, so that no vertex goes far and no line of the grid is stretched or shrunk by much."""
        settings, tiny = self.settings, torch.finfo(x.dtype).tiny
        far = torch.linalg.vector_norm(move, dim=-1).amax(-1) / (settings.longest_step * self.membrane.size)
        for axis in (1, 2):
            change, edge = (
                torch.linalg.vector_norm(field.unflatten(1, self.membrane.grid).diff(dim=axis), dim=-1) for field in (move, x)
            )
            stretch = (change / edge.clamp_min(tiny)).flatten(1).amax(-1)
            far = torch.maximum(far, stretch / settings.largest_stretch)
        share: Tensor = 1 / far.clamp_min(1.0)
        return share

    def _bordered_step(
        self, x: Tensor, pressure: Tensor, loads: Tensor, solved: Tensor, corner: tuple[Tensor, Tensor]
    ) -> BorderedStep:
        """Step `d` and rise of the pressure: `M d + m dp + n lambda = -g` with the rows of the pressure and of the volume."""
        if self.cavity.filling == "open":
            return BorderedStep(-solved[:, 1], torch.zeros_like(pressure))
        fWv, vWv = corner
        target, compliance = self.cavity.condition(self.membrane.volume(x) - self.membrane.rest_volume, pressure)
        return solve_bordered(loads, solved, vWv, fWv, compliance, target)
