"""A dent in the middle of every contact, for the steps to start from.

One camera sees hardly more of a narrow contact than how its markers moved across the rays. A pit, and a low mound ringed by
pushes, show them alike. From a smooth surface, found on a grid too coarse for the pit, the steps find the mound: a minimum,
whose tractions cost several times those of the pit. From a dent they find the pit; where there is none it fills.
"""

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from ...control_flow import stacked, traced, where_rows
from ...solve.stencil import inner, pad_border
from ...surface.membrane import Membrane
from ..base import Equilibrium
from ..precision import shortened
from .gauss_newton import GaussNewton, State
from .marker_residuals import MeasuredRays
from .traction_loss import is_significant

DEPTH = 0.05  # over the surface's size
WIDTH = 0.1  # standard deviation, over the size
DEEP, WIDE = (0.16, 0.08), (0.25, 0.15)  # depth and width of those for a press that the first does not find
REACH = 0.25  # of the surroundings whose pushes have one middle, over the size
FAINT = 1.0  # of the push that the markers' noise makes: less hardly dents
MIDDLE = 0.04  # radius of the middle of a contact, over the size
HOLLOW = 0.1  # push there over the largest, of which less is hardly any
LOWER = 0.9  # objective over another's of which it is taken
TINY = 1e-12  # of a push over the reference traction, squared: keeps the middle of none finite

Schedule = list[tuple[float, float]]
Found = tuple[State, Tensor]
Stepped = Sequence[Tensor]
"""A `State`, and the displacement a step before."""


class Dent(nn.Module):
    """Dents contacts in.

    Args:
        gauss_newton: of the grid, which knows the pushes.
    """

    around: Tensor
    area: Tensor
    free: Tensor

    def __init__(self, gauss_newton: GaussNewton):
        super().__init__()
        self.gauss_newton, self.membrane = gauss_newton, gauss_newton.membrane
        rest, size = self.membrane.rest, self.membrane.size
        self.register_buffer("around", shortened(torch.exp(-(torch.cdist(rest, rest) ** 2) / (2 * (REACH * size) ** 2))))
        self.register_buffer("area", self.membrane.rest_area / size**2)
        self.register_buffer("free", (~self.membrane.fixed).double())

    @traced
    def forward(self, u: Tensor, pressure: Tensor, moved: Tensor, measured: MeasuredRays) -> State:
        """The state, its surface dented where the middle of the pushes around, weighted by their squares, is near."""
        return self._dented(u, pressure, moved, measured, DEPTH, WIDTH)

    @traced
    def deep(self, u: Tensor, pressure: Tensor, moved: Tensor, measured: MeasuredRays) -> State:
        """The state, dented deeper."""
        return self._dented(u, pressure, moved, measured, *DEEP)

    @traced
    def wide(self, u: Tensor, pressure: Tensor, moved: Tensor, measured: MeasuredRays) -> State:
        """The state, dented deeper and wider."""
        return self._dented(u, pressure, moved, measured, *WIDE)

    def _dented(self, u: Tensor, pressure: Tensor, moved: Tensor, measured: MeasuredRays, depth: float, width: float) -> State:
        membrane, loss = self.membrane, self.gauss_newton.equations.loss
        normals = membrane.normals(membrane.rest + u)
        q_n = (self.gauss_newton.traction(State(u, pressure, moved), measured) * normals).sum(-1, keepdim=True)
        push2 = loss.push2(inner(q_n, membrane.grid)[..., 0])
        weight = (pad_border(push2[..., None], membrane.grid)[..., 0] + TINY) * self.area
        middle = (weight[..., None] * membrane.rest).mT @ self.around / (weight @ self.around)[:, None]
        off2 = (middle.mT - membrane.rest).square().sum(-1) / membrane.size**2
        faint2 = (FAINT * measured.noise_level[:, None] * loss.push_noise).square().mean(-1) + TINY
        share = (push2.amax(-1) / (push2.amax(-1) + faint2))[:, None]
        inwards = depth * membrane.size * share * torch.exp(-off2 / (2 * width**2)) * self.free
        return State(u - inwards[..., None] * normals, pressure, moved)

    def is_ring_shaped(self, found: Equilibrium, membrane: Membrane) -> Tensor:
        """`[B]` bool: hardly anything pushes in the middle of what pushes, as where a mound ringed by pushes stands for a pit,
        or two contacts are close; `membrane`: of the finer grid it is found on."""
        p0 = self.gauss_newton.equations.loss.reference
        pushes = (-(found.traction * membrane.normals(found.vertices)).sum(-1) / p0).clamp_min(0)
        pushes = torch.where(is_significant(found.reference / p0), pushes, 0.0)
        lines = (membrane.grid[0] - 1) // (self.membrane.grid[0] - 1)
        pushes = pushes.unflatten(1, membrane.grid)[:, ::lines, ::lines].flatten(1) + TINY
        rest, size = self.membrane.rest, self.membrane.size
        around = pushes * self.area * self.around[pushes.argmax(-1)]
        middle = around @ rest / around.sum(-1, keepdim=True)
        off2 = (rest - middle[:, None]).square().sum(-1) / size**2
        near = torch.exp(-off2 / (2 * MIDDLE**2)) * self.area
        return torch.lt((near * pushes).sum(-1) / near.sum(-1), HOLLOW * pushes.amax(-1))

    def best_of_starts(self, quick: State, slow: State, rest: State, measured: MeasuredRays, schedule: Schedule) -> Found:
        """The best of what the steps of a schedule make of several dents in two states and of two states found from `rest` on
        this grid, and the displacement a step before; the first of those that are about as good, for answers must not jump
        between them. The two from rest: by a sharp loss from the start, and without a cone, where shear is dear even under a
        push."""
        settings = self.gauss_newton.settings
        steps = 2 * settings.steps
        starts = [
            self(*slow, measured),
            self.deep(*slow, measured),
            self.wide(*slow, measured),
            self.deep(*quick, measured),
            self.gauss_newton(rest, measured, settings.gnc_schedule(steps, settings.sharp_tau))[0],
            self.gauss_newton(rest, measured, settings.gnc_schedule(steps, settings.tau), cone=0.0)[0],
        ]

        def stepped(start: Sequence[Tensor], measured: MeasuredRays) -> Sequence[Tensor]:
            state, before = self.gauss_newton(State(*start), measured, schedule)
            return *state, before

        best, *others = stacked(stepped, starts, measured)
        for other in others:
            best = self.lower(best, other, measured)
        return State(*best[:3]), best[3]

    @traced
    def lower(self, kept: Stepped, other: Stepped, measured: MeasuredRays) -> Stepped:
        """`other` in the rows where its objective is lower than that of `kept`, or `kept` has none."""
        of_kept, of_other = (
            self.gauss_newton.objective(State(*each[:3]), *self.gauss_newton.tractions(*each[:2]), measured)
            for each in (kept, other)
        )
        is_lower = of_other < torch.where(of_kept.isnan(), torch.inf, LOWER * of_kept)
        u, pressure, moved, before = where_rows(is_lower, other, kept)
        return u, pressure, moved, before
