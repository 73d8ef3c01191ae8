"""Initial guesses: a dent in the middle of every contact, from which the steps start.

One camera sees of a narrow contact hardly more than how its markers moved across the rays. A dent and a low mound ringed by
pushes look alike in this. From a smooth surface, found on a grid too coarse for the dent, the steps find the mound: a minimum
whose tractions cost several times those of the dent. From a dent they find the dent; where there is none, it fills.
"""

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from ...control_flow import stacked, traced, where_rows
from ...solve.stencil import inner, pad_border
from ...surface.membrane import Membrane
from ..base import Equilibrium
from ..precision import rounded_to_float32
from .gauss_newton import GaussNewton, State
from .marker_residuals import MeasuredRays
from .traction_loss import is_significant

DEPTH = 0.05  # over the surface's size
WIDTH = 0.1  # standard deviation, over the size
DEEP_DENT, WIDE_DENT = (0.16, 0.08), (0.25, 0.15)  # depth and width of dents for presses that the first dent does not find
REACH = 0.25  # of the surroundings whose pushes have one middle, over the size
FAINT_PUSH = 1.0  # over the push that the markers' noise makes: a fainter push hardly dents the surface
CENTRE_RADIUS = 0.04  # of the middle of a contact, over the size
RING_SHARE = 0.1  # push in the middle over the largest push, below which a contact is ring-shaped
ACCEPTANCE_RATIO = 0.9  # objective of another solution over the one that is kept, below which it is taken
TINY = 1e-12  # of a push over the reference traction, squared: keeps the middle finite where nothing pushes

Schedule = list[tuple[float, float]]
Found = tuple[State, Tensor]
Stepped = Sequence[Tensor]
"""A `State`, and the displacement a step before."""


class InitialGuess(nn.Module):
    """Surfaces that are dented where something pushes.

    Args:
        gauss_newton: Gauss-Newton steps of the grid, which knows the pushes.
    """

    around: Tensor
    area: Tensor
    free: Tensor

    def __init__(self, gauss_newton: GaussNewton):
        super().__init__()
        self.gauss_newton, self.membrane = gauss_newton, gauss_newton.membrane
        rest, size = self.membrane.rest, self.membrane.size
        self.register_buffer(
            "around", rounded_to_float32(torch.exp(-(torch.cdist(rest, rest) ** 2) / (2 * (REACH * size) ** 2)))
        )
        self.register_buffer("area", self.membrane.rest_area / size**2)
        self.register_buffer("free", (~self.membrane.fixed).double())

    @traced
    def forward(self, u: Tensor, pressure: Tensor, moved: Tensor, measured: MeasuredRays) -> State:
        """The state, its surface dented where the middle of the pushes around, weighted by their squares, is near."""
        return self._dented(u, pressure, moved, measured, DEPTH, WIDTH)

    @traced
    def deep(self, u: Tensor, pressure: Tensor, moved: Tensor, measured: MeasuredRays) -> State:
        """The state, dented deeper."""
        return self._dented(u, pressure, moved, measured, *DEEP_DENT)

    @traced
    def wide(self, u: Tensor, pressure: Tensor, moved: Tensor, measured: MeasuredRays) -> State:
        """The state, dented deeper and wider."""
        return self._dented(u, pressure, moved, measured, *WIDE_DENT)

    def _dented(self, u: Tensor, pressure: Tensor, moved: Tensor, measured: MeasuredRays, depth: float, width: float) -> State:
        membrane, loss = self.membrane, self.gauss_newton.equations.loss
        normals = membrane.normals(membrane.rest + u)
        q_n = (self.gauss_newton.traction(State(u, pressure, moved), measured) * normals).sum(-1, keepdim=True)
        compression2 = loss.compression2(inner(q_n, membrane.grid)[..., 0])
        weight = (pad_border(compression2[..., None], membrane.grid)[..., 0] + TINY) * self.area
        middle = (weight[..., None] * membrane.rest).mT @ self.around / (weight @ self.around)[:, None]
        off2 = (middle.mT - membrane.rest).square().sum(-1) / membrane.size**2
        faint2 = (FAINT_PUSH * measured.noise_level[:, None] * loss.push_noise).square().mean(-1) + TINY
        share = (compression2.amax(-1) / (compression2.amax(-1) + faint2))[:, None]
        inwards = depth * membrane.size * share * torch.exp(-off2 / (2 * width**2)) * self.free
        return State(u - inwards[..., None] * normals, pressure, moved)

    def is_ring_shaped(self, found: Equilibrium, membrane: Membrane) -> Tensor:
        """`[B]` bool: hardly anything pushes in the middle of a contact, as where a mound ringed by pushes is found in place of
        a dent, or where two contacts are close; `membrane`: of the finer grid on which the solution was found."""
        p0 = self.gauss_newton.equations.loss.reference
        pushes = (-(found.traction * membrane.normals(found.vertices)).sum(-1) / p0).clamp_min(0)
        pushes = torch.where(is_significant(found.reference / p0), pushes, 0.0)
        lines = (membrane.grid[0] - 1) // (self.membrane.grid[0] - 1)
        pushes = pushes.unflatten(1, membrane.grid)[:, ::lines, ::lines].flatten(1) + TINY
        rest, size = self.membrane.rest, self.membrane.size
        around = pushes * self.area * self.around[pushes.argmax(-1)]
        middle = around @ rest / around.sum(-1, keepdim=True)
        off2 = (rest - middle[:, None]).square().sum(-1) / size**2
        near = torch.exp(-off2 / (2 * CENTRE_RADIUS**2)) * self.area
        return torch.lt((near * pushes).sum(-1) / near.sum(-1), RING_SHARE * pushes.amax(-1))

    def best_of_starts(self, state: State, measured: MeasuredRays, schedule: Schedule) -> Found:
        """The best of the solutions found from three different dents of a state, and the displacement a step before it.

        Of solutions that are about as good, the first is taken, so that answers do not jump between them.
        """
        starts = [dented(*state, measured) for dented in (self, self.deep, self.wide)]

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
        is_lower = of_other < torch.where(of_kept.isnan(), torch.inf, ACCEPTANCE_RATIO * of_kept)
        u, pressure, moved, before = where_rows(is_lower, other, kept)
        return u, pressure, moved, before
