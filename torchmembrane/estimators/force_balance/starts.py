"""Initial guesses: surfaces with a dent in the middle of every contact, from which the steps start.

In a narrow contact one camera sees little more than the motion of the markers across their rays, which is similar for a dent
and for a low mound with pushes around it. Starting from a smooth surface, found on a grid that is too coarse for the dent, the
steps converge to the mound: a local minimum whose tractions cost several times those of the dent. Starting from a dent they
find the dent; if there is none in truth, it disappears.
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

DEPTH = 0.05  # of the dent, relative to the surface's size
WIDTH = 0.1  # of the dent (standard deviation), relative to the size
DEEP_DENT, WIDE_DENT = (0.16, 0.08), (0.25, 0.15)  # depth and width of dents for presses that the first dent does not find
REACH = 0.25  # radius of the neighbourhood whose pushes have a common middle, relative to the size
FAINT_PUSH = 1.0  # relative to the push due to the markers' noise; a fainter push hardly dents the surface
CENTRE_RADIUS = 0.04  # radius of the middle of a contact, relative to the size
RING_SHARE = 0.1  # push in the middle relative to the largest push, below which a contact is ring-shaped
ACCEPTANCE_RATIO = 0.9  # objective of another solution relative to the best so far, below which it is accepted
TINY = 1e-12  # squared push relative to the reference traction; keeps the middle finite without pushes

Schedule = list[tuple[float, float]]
Found = tuple[State, Tensor]
Stepped = Sequence[Tensor]
"""A `State`, and the displacement one step before it."""


class InitialGuess(nn.Module):
    """Adds dents to surfaces in the middle of their contacts.

    Args:
        gauss_newton: Gauss-Newton steps on the same grid, which provide the tractions.
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
        """Return the state with dents near the centroids of the pushes, which are weighted by their squares."""
        return self._dented(u, pressure, moved, measured, DEPTH, WIDTH)

    @traced
    def deep(self, u: Tensor, pressure: Tensor, moved: Tensor, measured: MeasuredRays) -> State:
        """Return the state with deeper dents."""
        return self._dented(u, pressure, moved, measured, *DEEP_DENT)

    @traced
    def wide(self, u: Tensor, pressure: Tensor, moved: Tensor, measured: MeasuredRays) -> State:
        """Return the state with deeper and wider dents."""
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
        """Return where the push in the middle of a contact is small, `[B]` bool.

        This is the case if a mound with pushes around it was found in place of a dent, or if two contacts are close.

        Args:
            found: the solution.
            membrane: the rest surface on the finer grid on which the solution was found.
        """
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
        """Return the best solution from three different dents of a state, and the displacement one step before it.

        Among solutions with a similar objective the first is chosen, so that results do not jump between them.

        Args:
            state: state before the dents.
            measured: the markers' rays.
            schedule: scales of the losses in every step.
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
        """Return `other` in the rows where its objective is clearly lower or that of `kept` is NaN, and `kept` elsewhere."""
        of_kept, of_other = (
            self.gauss_newton.objective(State(*each[:3]), *self.gauss_newton.tractions(*each[:2]), measured)
            for each in (kept, other)
        )
        is_lower = of_other < torch.where(of_kept.isnan(), torch.inf, ACCEPTANCE_RATIO * of_kept)
        u, pressure, moved, before = where_rows(is_lower, other, kept)
        return u, pressure, moved, before
