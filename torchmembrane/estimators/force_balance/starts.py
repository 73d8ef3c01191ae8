"""Initial guesses: surfaces with a dent in the middle of every contact, from which the steps start.

In a narrow contact one camera sees little more than the motion of the markers across their rays, which is similar for a dent
and for a low mound with pushes around it. Starting from a smooth surface, found on a grid that is too coarse for the dent, the
steps converge to the mound: a local minimum whose tractions cost several times those of the dent. Starting from a dent they
find the dent; if there is none in truth, it disappears.
"""

import torch
from torch import Tensor, nn

from ...control_flow import traced
from ...solve.stencil import inner, pad_border
from ..precision import rounded_to_float32
from .gauss_newton import GaussNewton, State
from .marker_residuals import MeasuredRays

DENT = 0.1  # depth of the dent and its width (standard deviation), relative to the surface's size
REACH = 0.25  # radius of the neighbourhood whose pushes have a common middle, relative to the size
TINY = 1e-12  # squared push relative to the reference traction; keeps the middle finite without pushes


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
        """Return the state with a dent in the middle of every contact.

        The middle is the centroid of the neighbourhood, each vertex weighted by its squared push. Pushes that noise alone
        explains cause almost no dent. Pushes and dents are along the normals at rest: along those of a surface that is already
        deeply pressed, a dent could fold it.

        Args:
            u: displacement of the vertices, `[B, V, 3]`, in the unit of length of the sensor.
            pressure: of the fluid, `[B]`.
            moved: motion of the cameras of the W views, `[B, 4 W]`.
            measured: rays of the markers in the image.
        """
        membrane, loss = self.membrane, self.gauss_newton.equations.loss
        traction = self.gauss_newton.traction(State(u, pressure, moved), measured)
        q_n = (traction * membrane.rest_normals).sum(-1, keepdim=True)
        compression2 = loss.compression2(inner(q_n, membrane.grid)[..., 0])
        weight = (pad_border(compression2[..., None], membrane.grid)[..., 0] + TINY) * self.area
        middle = (weight[..., None] * membrane.rest).mT @ self.around / (weight @ self.around)[:, None]
        off2 = (middle.mT - membrane.rest).square().sum(-1) / membrane.size**2
        noise2 = (measured.noise_level[:, None] * loss.push_noise).square().mean(-1) + TINY
        share = (compression2.amax(-1) / (compression2.amax(-1) + noise2))[:, None]
        inwards = DENT * membrane.size * share * torch.exp(-off2 / (2 * DENT**2)) * self.free
        return State(u - inwards[..., None] * membrane.rest_normals, pressure, moved)
