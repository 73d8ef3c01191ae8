"""The loss of contact tractions: few, large and compressive ones are cheap.

A traction `q` of a vertex has the normal part `q_n` (outward positive: tensile) and the shear part `q_t`. With `s = -q_n / p0`,

    loss / area = sparsity / size^2 [ f(s) + kappa (sqrt(|q_t|^2 / p0^2 + slip^2) - slip) ],

`f` Geman-McClure of scale `tau` where the vertex is pushed, `s^2 / 2` where it is pulled, and `kappa = friction / (1 + cone
S)`. Both ask the vertex's surroundings: `S` is the rms push over a Gaussian neighbourhood, for contacts are patches.

A light touch, smeared over many vertices, pushes with far less than `p0`. So every traction is measured against what can be
expected around it: not `p0` but `rho p0`, with

    rho = min(1, max(c M, c_far max S, z sigma) / tau_last),

`M` the largest push `S` of the vertex's wider surroundings (a power mean), `sigma` the push that the markers' noise alone
makes there. The loss is that of `q / rho`: whatever its scale, a touch looks the same, and noise below `z sigma` never looks
like one. (As iterative reweighting for sparse recovery ties its epsilon to the largest entries: Daubechies et al. 2010.)
"""

from typing import NamedTuple

import torch
from torch import Tensor, nn

from ...solve.stencil import inner
from ...surface.membrane import Membrane
from ..precision import rounded_to_float32
from .robust import GemanMcClure, PseudoHuber
from .settings import ForceBalanceSettings

POWER = 4  # of squared pushes, in the mean that stands for the largest around
NO_CONTACT_SCALE = 1e6  # over p0: no push comes near it
NEGLIGIBLE = 1e-6  # weight of a vertex far away, over that of the one in the middle
TINY = 1e-12  # keeps roots and quotients of what vanishes finite

Memory = tuple[Tensor, Tensor | float]
"""The weights `w_n [B, N]` of the step before, and the share of a step's own in their geometric mean."""


class LossTerms(NamedTuple):
    """Of tractions at the last scale: `compression2` is `S^2 [B, N]`, `scale2` is `rho^2 [B, N]`, and the loss `[B]` has two
    parts: `pushes`, and `others`, which are tension and shear."""

    compression2: Tensor
    scale2: Tensor
    pushes: Tensor
    others: Tensor


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
    wider: Tensor
    push_noise: Tensor
    noise_gain: Tensor

    def __init__(self, membrane: Membrane, reference: float, cone: float, settings: ForceBalanceSettings):
        super().__init__()
        self.reference, self.size, self.cone, self.settings = reference, membrane.size, cone, settings
        self.shear = PseudoHuber(settings.slip)

        def within(field: Tensor) -> Tensor:
            return inner(field, membrane.grid)

        self.register_buffer("area", within(membrane.rest_area[:, None]).squeeze(-1))
        surroundings = _gaussian_mean(membrane, settings.reach * self.size)
        self.register_buffer("surroundings", rounded_to_float32(within(within(surroundings).mT).mT))
        wider = within(within(_gaussian_mean(membrane, settings.scale_reach * self.size)).mT).mT
        self.register_buffer("wider", rounded_to_float32(wider / wider.sum(0)))
        self.register_buffer("push_noise", torch.zeros_like(self.area))
        self.register_buffer("noise_gain", self.area.new_zeros(()))

    def parts(self, traction: Tensor, normal: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Normal part over `p0`, squared shear over `p0^2`, and the mean squared push `S^2` around, each `[B, N]`, of tractions
        `[B, 3, N]`."""
        p0 = self.reference
        q_n = (traction * normal).sum(1)
        q_t = traction - q_n[:, None] * normal
        return q_n / p0, q_t.square().sum(1) / p0**2, self.compression2(q_n)

    def compression2(self, q_n: Tensor) -> Tensor:
        """The mean squared push `S^2` around, `[B, N]`, of the tractions' normal parts `[B, N]`."""
        compression2: Tensor = (-q_n / self.reference).clamp_min(0) ** 2 @ self.surroundings
        return compression2

    def pushed(self, compression2: Tensor) -> Tensor:
        """Share `[B]` of the surface that is pushed more than the last scale `tau`, from `S^2 [B, N]`."""
        return (compression2 > self.settings.tau[-1] ** 2).to(self.area.dtype) @ self.area / self.area.sum()

    def shear_weight(self, compression2: Tensor, cone: float | Tensor | None = None) -> Tensor:
        """`kappa [B, N]`; `cone`: default, that of this loss."""
        settings, cone = self.settings, self.cone if cone is None else cone
        return settings.friction / (1 + cone * (compression2 + settings.slip**4).sqrt())

    def scale2(self, compression2: Tensor, noise_level: Tensor, tau: float | Tensor) -> Tensor:
        """`rho^2 [B, N]`, from `S^2 [B, N]` and the frames' noise over that at rest `[B]`.

        At least as much as the scale `tau` of the step allows: from rest, where nothing pushes yet, it begins at 1.
        """
        settings, last = self.settings, self.settings.tau[-1]
        top = compression2.amax(-1, keepdim=True).clamp_min(TINY)
        around = top * (((compression2 / top) ** POWER) @ self.wider).clamp_min(TINY) ** (1 / POWER)
        noise2 = (settings.noise_share * noise_level[:, None] * self.push_noise).square()
        expected = torch.maximum((settings.scale_share**2 * around).maximum(settings.far_share**2 * top), noise2)
        tau = tau if isinstance(tau, Tensor) else compression2.new_full((), tau)
        least = (settings.decrease * (tau / last - 1) + settings.least_scale).clamp_max(1.0)
        return (expected / last**2).maximum(least**2).clamp_max(1.0)

    def contact_scale(self, terms: LossTerms, noise_level: Tensor, gain: Tensor) -> Tensor:
        """What a push that is a contact is measured against, over `p0`, `[B, N]`: `rho`, or where noise explains it, or
        all that is found, `NO_CONTACT_SCALE`.

        Args:
            terms: the tractions of a solution.
            noise_level: `[B]`, of the frames over that at rest.
            gain: `[B]`, by how much the objective is below that of the surface at rest, over the markers seen.
        """
        above = terms.compression2 > (self.settings.contact_noise * noise_level[:, None] * self.push_noise).square()
        above = above & (gain > self.settings.evidence * self.noise_gain)[:, None]
        return torch.where(above, terms.scale2.sqrt(), NO_CONTACT_SCALE)

    def weights(
        self,
        normal: Tensor,
        force: Tensor,
        noise_level: Tensor,
        tau: float | Tensor,
        cone: float | Tensor | None = None,
        curvature: bool = False,
        memory: Memory | None = None,
    ) -> tuple[Tensor, Tensor]:
        """`W_k = (w_n n n^T + w_t (I - n n^T)) / a_k`, `[B, 3, 3, N]`: the parabolas that touch the loss of a force; and the
        `w_n [B, N]` in it.

        Args:
            normal: `[B, 3, N]` of the inner vertices.
            force: `[B, 3, N]`.
            noise_level: `[B]`, of the frames over that at rest.
            tau: scale of the compressive traction's loss.
            cone: how much less shear weighs where something pushes; default, that of this loss.
            curvature: the curvature of a push's loss instead of its weight, zero where it bends down.
            memory: weights of the step before; `w_n` is then a geometric mean with it.
        """
        q_n, shear2, compression2 = self.parts(force / self.area, normal)
        rho2 = self.scale2(compression2, noise_level, tau)
        shear2, compression2 = shear2 / rho2, compression2 / rho2
        compressive = GemanMcClure(tau)
        pushed = compressive.curvature(compression2) if curvature else compressive.weight(compression2)
        w_n = self.settings.floor + torch.where(q_n < 0, pushed, 1.0)
        if memory is not None:
            before, renewal = memory
            w_n = before * (w_n / before) ** renewal
        w_t = self.shear_weight(compression2, cone) * self.shear.weight(shear2)
        scale = self.settings.sparsity / (self.reference * self.size) ** 2 / self.area / rho2
        one = torch.eye(3, dtype=force.dtype, device=force.device)[..., None]
        along = (scale * (w_n - w_t))[:, None] * normal
        return along[:, :, None] * normal[..., None, :, :] + (scale * w_t)[:, None, None] * one, w_n

    def forward(self, traction: Tensor, normal: Tensor, noise_level: Tensor) -> LossTerms:
        """The loss of tractions `[B, 3, N]` at the last scale `tau`, each push judged by itself."""
        q_n, shear2, compression2 = self.parts(traction, normal)
        rho2 = self.scale2(compression2, noise_level, self.settings.tau[-1])
        q_n, shear2 = q_n / rho2.sqrt(), shear2 / rho2
        pushes = GemanMcClure(self.settings.tau[-1]).loss((-q_n).clamp_min(0) ** 2)
        others = q_n.clamp_min(0) ** 2 / 2 + self.shear_weight(compression2 / rho2) * self.shear.loss(shear2)
        unit = self.settings.sparsity / self.size**2 * self.area
        return LossTerms(compression2, rho2, pushes @ unit, others @ unit)


def is_significant(scale: Tensor) -> Tensor:
    """Bool, of the shape of a `contact_scale`: where noise does not explain a push."""
    return scale < NO_CONTACT_SCALE / 2


def _gaussian_mean(membrane: Membrane, reach: float) -> Tensor:
    """Weights `[V, V]` of a Gaussian mean over the rest surface; column k is that around vertex k."""
    weight = torch.exp(-(torch.cdist(membrane.rest, membrane.rest) ** 2) / (2 * reach**2))
    weight = membrane.rest_area[:, None] * torch.where(weight < NEGLIGIBLE, 0.0, weight)
    return weight / weight.sum(0)
