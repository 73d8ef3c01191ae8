"""A dent in the middle of every contact, for the steps to start from.

One camera sees hardly more of a narrow contact than how its markers moved across the rays. A pit, and a low mound ringed by
pushes, show them alike. From a smooth surface, found on a grid too coarse for the pit, the steps find the mound: a minimum,
whose tractions cost several times those of the pit. From a dent they find the pit; where there is none it fills.
"""

import torch
from torch import Tensor, nn

from ..pieces import piece
from ..surface.stencil import pad_border
from .bearings import Bearings
from .descent import Descent, State

DEPTH = 0.08  # over the surface's size
WIDTH = 0.06  # standard deviation, over the size
REACH = 0.25  # of the surroundings whose pushes have one middle, over the size
FAINT = 1.0  # of the push that the markers' noise makes: less hardly dents
TINY = 1e-12  # of a push over the reference traction, squared: keeps the middle of none finite


class Dent(nn.Module):
    """Dents contacts in.

    Args:
        descent: of the grid, which knows the pushes.
    """

    around: Tensor
    area: Tensor
    free: Tensor

    def __init__(self, descent: Descent):
        super().__init__()
        self.descent, self.membrane = descent, descent.membrane
        rest, size = self.membrane.rest, self.membrane.size
        self.register_buffer("around", torch.exp(-(torch.cdist(rest, rest) ** 2) / (2 * (REACH * size) ** 2)))
        self.register_buffer("area", self.membrane.rest_area / size**2)
        self.register_buffer("free", (~self.membrane.fixed).double())

    @piece
    def forward(self, x: Tensor, pressure: Tensor, moved: Tensor, measured: Bearings) -> State:
        """The state, its surface dented where the middle of the pushes around, weighted by their squares, is near."""
        membrane, loss = self.membrane, self.descent.equations.loss
        push2 = loss.parts(*self.descent.tractions(x, pressure))[2]
        weight = (pad_border(push2[..., None], membrane.grid)[..., 0] + TINY) * self.area
        middle = (weight[..., None] * membrane.rest).mT @ self.around / (weight @ self.around)[:, None]
        off2 = (middle.mT - membrane.rest).square().sum(-1) / membrane.size**2
        faint2 = (FAINT * measured.noise_level[:, None] * loss.push_noise).square().mean(-1) + TINY
        share = (push2.amax(-1) / (push2.amax(-1) + faint2))[:, None]
        depth = DEPTH * membrane.size * share * torch.exp(-off2 / (2 * WIDTH**2)) * self.free
        return State(x - depth[..., None] * membrane.normals(x), pressure, moved)
