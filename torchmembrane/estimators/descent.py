"""Gauss-Newton steps of force balance: surface and pressure, the volume linearised."""

import torch
from torch import Tensor, nn

from ..mechanics.cavity import CavityLaw
from ..pieces import piece, repeated
from ..solve.conjugate_gradient import conjugate_gradient
from ..solve.kkt import BorderedStep, solve_bordered
from ..surface.stencil import pad_border
from .bearings import Bearings
from .normal_equations import BalanceEquations
from .settings import ForceBalanceSettings

Factor = tuple[Tensor, ...]


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
        self, x: Tensor, pressure: Tensor, measured: Bearings, schedule: list[tuple[float, float]], one_factor: bool = False
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Surface `[B, V, 3]` and pressure `[B]` after the steps of a schedule, and the surface before the last; `one_factor`:
        all with the factor of the first step."""
        before, factor = x, None
        if one_factor:
            x, pressure, before, factor = self._first(x, pressure, measured, *schedule[0])
            schedule = schedule[1:]
        x, pressure, before = repeated(self._next, schedule, (x, pressure, before), measured, factor)
        return x, pressure, before

    @piece
    def _first(
        self, x: Tensor, pressure: Tensor, measured: Bearings, tau: float, outlier: float
    ) -> tuple[Tensor, Tensor, Tensor, Factor | None]:
        """Surface, pressure and the surface before; the factor of the step's matrix."""
        after, pressure, factor = self._traced_once(x, pressure, measured, tau, outlier, None)
        return after, pressure, x, factor

    @piece
    def _next(
        self, x: Tensor, pressure: Tensor, before: Tensor, measured: Bearings, factor: Factor | None, tau: float, outlier: float
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Surface, pressure and the surface before."""
        after, pressure, _ = self._traced_once(x, pressure, measured, tau, outlier, factor)
        return after, pressure, x

    def _traced_once(
        self, x: Tensor, pressure: Tensor, measured: Bearings, tau: float, outlier: float, factor: Factor | None
    ) -> tuple[Tensor, Tensor, Factor | None]:
        """`step`, which `torch.compile` then traces and compiles once, not once per step; so does the exporter by itself."""
        scales = [torch.as_tensor(scale, dtype=x.dtype, device=x.device) for scale in (tau, outlier)]
        step = self.step if torch.compiler.is_exporting() else self._compiled_once
        taken: tuple[Tensor, Tensor, Factor | None] = step(x, pressure, measured, scales[0], scales[1], factor)
        return taken

    @torch.compiler.nested_compile_region
    def _compiled_once(
        self, x: Tensor, pressure: Tensor, measured: Bearings, tau: Tensor, outlier: Tensor, factor: Factor | None
    ) -> tuple[Tensor, Tensor, Factor | None]:
        return self.step(x, pressure, measured, tau, outlier, factor)

    def step(
        self, x: Tensor, pressure: Tensor, measured: Bearings, tau: Tensor, outlier: Tensor, factor: Factor | None = None
    ) -> tuple[Tensor, Tensor, Factor | None]:
        """One reweighted Gauss-Newton step in surface and pressure, the volume linearised, the longest vertex step capped.

        Also returns the factor of its matrix if it made one: with the `factor` of a step near this one it makes none.
        """
        equations = self.equations
        _, normal, loads, corner = equations.linearised(x, pressure, measured, tau, outlier)
        made = None
        if factor is None:
            made = equations.system.factor(equations.matrix(normal))
            solved = equations.system.substitute(made, loads)
        else:
            known = factor
            solved = conjugate_gradient(
                lambda u: equations.product(normal, u),
                lambda r: equations.system.substitute(known, r),
                loads,
                self.settings.conjugate_steps,
            )
        move, rise = self._bordered_step(x, pressure, loads, solved, corner)
        move = move.unflatten(-1, (3, -1)).mT
        longest = torch.linalg.vector_norm(move, dim=-1).amax(-1)
        cap = self.settings.longest_step * self.membrane.size
        share = (cap / longest.clamp_min(torch.finfo(x.dtype).tiny)).clamp_max(1.0)
        return x + pad_border(share[:, None, None] * move, self.membrane.grid), pressure + share * rise, made

    def _bordered_step(
        self, x: Tensor, pressure: Tensor, loads: Tensor, solved: Tensor, corner: tuple[Tensor, Tensor]
    ) -> BorderedStep:
        """Step `d` and rise of the pressure: `M d + m dp + n lambda = -g` with the rows of the pressure and of the volume."""
        if self.cavity.filling == "open":
            return BorderedStep(-solved[:, 1], torch.zeros_like(pressure))
        fWv, vWv = corner
        target, compliance = self.cavity.condition(self.membrane.volume(x) - self.membrane.rest_volume, pressure)
        return solve_bordered(loads, solved, vWv, fWv, compliance, target)
