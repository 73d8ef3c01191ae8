"""The loss of contact tractions: few, large and compressive ones are cheap.

A traction `q` of a vertex has the normal part `q_n` (outward positive: tensile) and the shear part `q_t`. With `s = -q_n / p0`,

    loss / area = sparsity / size^2 [ f(s) + kappa (sqrt(|q_t|^2 / p0^2 + slip^2) - slip) ],

`f` Geman-McClure of scale `tau` where the vertex is pushed, `s^2 / 2` where it is pulled, and `kappa = friction / (1 + cone
S)`. Both ask the vertex's surroundings: `S` is the rms push over a Gaussian neighbourhood, for contacts are patches.
"""

import torch
from torch import Tensor, nn

from ..surface.membrane import Membrane
from ..surface.stencil import inner
from .robust import GemanMcClure, PseudoHuber
from .settings import ForceBalanceSettings


class TractionLoss(nn.Module):
    """The loss, and the weights of its reweighted least squares.

    Args:
        membrane: the rest surface on the solver's grid.
        reference: the traction `p0`.
        cone: see `ForceBalanceSettings`.
        settings: the other constants.
    """

    area: Tensor
    surroundings: Tensor

    def __init__(self, membrane: Membrane, reference: float, cone: float, settings: ForceBalanceSettings):
        super().__init__()
        self.reference, self.size, self.cone, self.settings = reference, membrane.size, cone, settings
        self.shear = PseudoHuber(settings.slip)

        def within(field: Tensor) -> Tensor:
            return inner(field, membrane.grid)

        self.register_buffer("area", within(membrane.rest_area[:, None]).squeeze(-1))
        surroundings = _gaussian_mean(membrane, settings.reach * self.size)
        self.register_buffer("surroundings", within(within(surroundings).mT).mT)

    def parts(self, traction: Tensor, normal: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Normal part over `p0`, squared shear over `p0^2`, and the mean squared push `S^2` around, each `[B, N]`, of tractions
        `[B, 3, N]`."""
        p0 = self.reference
        q_n = (traction * normal).sum(1)
        q_t = traction - q_n[:, None] * normal
        push2 = (-q_n / p0).clamp_min(0) ** 2 @ self.surroundings
        return q_n / p0, q_t.square().sum(1) / p0**2, push2

    def shear_weight(self, push2: Tensor) -> Tensor:
        """`kappa [B, N]`."""
        settings = self.settings
        return settings.friction / (1 + self.cone * (push2 + settings.slip**4).sqrt())

    def weights(self, normal: Tensor, force: Tensor, tau: float | Tensor, curvature: bool = False) -> Tensor:
        """`W_k = (w_n n n^T + w_t (I - n n^T)) / a_k`, `[B, 3, 3, N]`: the parabolas that touch the loss of a force.

        Args:
            normal: `[B, 3, N]` of the inner vertices.
            force: `[B, 3, N]`.
            tau: scale of the compressive traction's loss.
            curvature: the curvature of a push's loss instead of its weight, zero where it bends down.
        """
        q_n, shear2, push2 = self.parts(force / self.area, normal)
        compressive = GemanMcClure(tau)
        pushed = compressive.curvature(push2) if curvature else compressive.weight(push2)
        w_n = self.settings.floor + torch.where(q_n < 0, pushed, 1.0)
        w_t = self.shear_weight(push2) * self.shear.weight(shear2)
        scale = self.settings.sparsity / (self.reference * self.size) ** 2 / self.area
        one = torch.eye(3, dtype=force.dtype, device=force.device)[..., None]
        along = (scale * (w_n - w_t))[:, None] * normal
        return along[:, :, None] * normal[..., None, :, :] + (scale * w_t)[:, None, None] * one

    def forward(self, traction: Tensor, normal: Tensor) -> Tensor:
        """The loss `[B]` of tractions `[B, 3, N]` at the last scale `tau`, each push judged by itself."""
        q_n, shear2, push2_around = self.parts(traction, normal)
        push2 = (-q_n).clamp_min(0) ** 2
        loss = GemanMcClure(self.settings.tau[-1]).loss(push2) + q_n.clamp_min(0) ** 2 / 2
        loss = loss + self.shear_weight(push2_around) * self.shear.loss(shear2)
        return self.settings.sparsity / self.size**2 * loss @ self.area


def _gaussian_mean(membrane: Membrane, reach: float) -> Tensor:
    """Weights `[V, V]` of a Gaussian mean over the rest surface; column k is that around vertex k."""
    weight = torch.exp(-(torch.cdist(membrane.rest, membrane.rest) ** 2) / (2 * reach**2))
    weight = membrane.rest_area[:, None] * weight
    return weight / weight.sum(0)
