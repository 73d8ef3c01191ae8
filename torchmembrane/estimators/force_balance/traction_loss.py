"""The loss of contact tractions, which favours few, large and compressive tractions.

A traction `q` of a vertex has the normal part `q_n` (positive outwards: tensile) and the shear part `q_t`. With
`s = -q_n / p0`,

    loss / area = sparsity / size^2 [ f(s) + kappa (sqrt(|q_t|^2 / p0^2 + slip^2) - slip) ],

where `f` is Geman-McClure's loss of scale `tau` for a push (compressive traction), `s^2 / 2` for a tensile traction, and
`kappa = shear / (1 + 2 mu shear S / tau^2)` with the coefficient of friction `mu`. It is smaller on coarser grids of few lines,
because their discretisation error looks like friction. Shear is expensive where nothing pushes. Under a large push the shear
`mu S` of a sliding contact costs `tau^2 / 2`, as much as the push itself. Because contacts are patches, the weights depend on
the neighbourhood: `S` is the rms push over a Gaussian neighbourhood.

A light touch, smeared over many vertices, pushes with far less than `p0`. Every traction is therefore measured relative to
`rho p0` instead of `p0`, with

    rho = min(1, max(c M, c_far max S, z sigma) / tau_last),

the largest push `M` in a wider neighbourhood (a power mean of `S`), and the push `sigma` there due to the markers' noise alone.
The loss is evaluated at `q / rho`, so that it is the same for light and strong touches, and noise below `z sigma` is never
taken for a touch. (Likewise, iterative reweighting for sparse recovery ties its epsilon to the largest entries: Daubechies et
al. 2010.)
"""

from typing import NamedTuple

import torch
from torch import Tensor, nn

from ...solve.stencil import inner
from ...surface.membrane import Membrane
from ..precision import rounded_to_float32
from .robust import GemanMcClure, PseudoHuber
from .settings import ForceBalanceSettings

POWER = 4  # exponent of the power mean of squared pushes, which approximates their maximum
NO_CONTACT_SCALE = 1e6  # relative to p0; far above any push
NEGLIGIBLE = 1e-6  # weight of a distant vertex relative to that of the centre, below which it is zero
WIDER = 2  # radius of the wider neighbourhood, relative to `reach`
LEAST_SCALE = 0.02  # relative to p0; single precision rounds the tractions of a slack sheet by up to a fifth of this
TINY = 1e-12  # keeps roots and quotients of zeros finite


class LossTerms(NamedTuple):
    """Loss of tractions at the last scale.

    Attributes:
        compression2: squared push of the neighbourhood, `S^2 [B, N]`.
        scale2: squared scale, `rho^2 [B, N]`.
        pushes: loss of compressive tractions, `[B]`.
        others: loss of tensile and shear tractions, `[B]`.
    """

    compression2: Tensor
    scale2: Tensor
    pushes: Tensor
    others: Tensor


class TractionLoss(nn.Module):
    """The loss of contact tractions, and its weights for iteratively reweighted least squares.

    Args:
        membrane: the rest surface on the solver's grid.
        reference: reference traction `p0`.
        settings: settings of the estimator.
        friction: coefficient of friction `mu` between the membrane and what touches it.
    """

    area: Tensor
    surroundings: Tensor
    wider: Tensor
    push_noise: Tensor

    def __init__(self, membrane: Membrane, reference: float, settings: ForceBalanceSettings, friction: float):
        super().__init__()
        self.reference, self.size, self.settings, self.friction = reference, membrane.size, settings, friction
        self.shear = PseudoHuber(settings.slip)

        def within(field: Tensor) -> Tensor:
            return inner(field, membrane.grid)

        self.register_buffer("area", within(membrane.rest_area[:, None]).squeeze(-1))
        surroundings = _gaussian_mean(membrane, settings.reach * self.size)
        self.register_buffer("surroundings", rounded_to_float32(within(within(surroundings).mT).mT))
        wider = within(within(_gaussian_mean(membrane, WIDER * settings.reach * self.size)).mT).mT
        self.register_buffer("wider", rounded_to_float32(wider / wider.sum(0)))
        self.register_buffer("push_noise", torch.zeros_like(self.area))

    def parts(self, traction: Tensor, normal: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return normal traction over `p0`, squared shear over `p0^2` and the mean squared push `S^2`, `[B, N]` each.

        Args:
            traction: tractions, `[B, 3, N]`.
            normal: outward unit normals, `[B, 3, N]`.
        """
        p0 = self.reference
        q_n = (traction * normal).sum(1)
        q_t = traction - q_n[:, None] * normal
        return q_n / p0, q_t.square().sum(1) / p0**2, self.compression2(q_n)

    def compression2(self, q_n: Tensor) -> Tensor:
        """Return the mean squared push `S^2` of every neighbourhood, `[B, N]`, from the normal tractions `q_n [B, N]`."""
        compression2: Tensor = (-q_n / self.reference).clamp_min(0) ** 2 @ self.surroundings
        return compression2

    @property
    def cone(self) -> float:
        """How much a push reduces the weight of shear, `2 mu shear / tau^2`."""
        return 2 * self.friction * self.settings.shear / self.settings.tau[-1] ** 2

    def shear_weight(self, compression2: Tensor) -> Tensor:
        """Return `kappa [B, N]` for squared pushes `S^2 [B, N]`."""
        settings = self.settings
        return settings.shear / (1 + self.cone * (compression2 + settings.slip**4).sqrt())

    def scale2(self, compression2: Tensor, noise_level: Tensor, tau: Tensor) -> Tensor:
        """Return `rho^2 [B, N]` from `S^2 [B, N]` and the frames' noise relative to that at rest, `[B]`.

        A lower bound depends on the scale `tau [B]` of the step, so that `rho` starts at 1 from rest, where nothing pushes yet.
        At the last `tau` it is `LEAST_SCALE`.
        """
        settings, last = self.settings, self.settings.tau[-1]
        top = compression2.amax(-1, keepdim=True).clamp_min(TINY)
        around = top * (((compression2 / top) ** POWER) @ self.wider).clamp_min(TINY) ** (1 / POWER)
        noise2 = (settings.noise_share * noise_level[:, None] * self.push_noise).square()
        expected = torch.maximum((settings.scale_share**2 * around).maximum(settings.far_share**2 * top), noise2)
        least = (tau / last - 1).clamp(LEAST_SCALE, 1.0)[:, None]
        return (expected / last**2).maximum(least**2).clamp_max(1.0)

    def contact_scale(self, terms: LossTerms, noise_level: Tensor) -> Tensor:
        """Return the scale with which pushes are compared in the search for contacts, relative to `p0`, `[B, N]`.

        It is `rho`, or `NO_CONTACT_SCALE` where noise explains the push.

        Args:
            terms: loss of the tractions of a solution.
            noise_level: noise of the frames relative to that at rest, `[B]`.
        """
        above = terms.compression2 > (self.settings.contact_noise * noise_level[:, None] * self.push_noise).square()
        return torch.where(above, terms.scale2.sqrt(), NO_CONTACT_SCALE)

    def weights(
        self,
        normal: Tensor,
        force: Tensor,
        noise_level: Tensor,
        tau: Tensor,
        curvature: bool = False,
    ) -> Tensor:
        """Return the weights of the contact forces, whose parabolas touch the loss.

        Args:
            normal: outward unit normals at the inner vertices, `[B, 3, N]`.
            force: contact forces, `[B, 3, N]`.
            noise_level: noise of the frames relative to that at rest, `[B]`.
            tau: scale of the loss of compressive traction, `[B]`.
            curvature: whether to use the curvature of a push's loss, zero where it is negative, instead of its weight.

        Returns:
            `W_k = (w_n n n^T + w_t (I - n n^T)) / a_k`, `[B, 3, 3, N]`.
        """
        q_n, shear2, compression2 = self.parts(force / self.area, normal)
        rho2 = self.scale2(compression2, noise_level, tau)
        shear2, compression2 = shear2 / rho2, compression2 / rho2
        compressive = GemanMcClure(tau[:, None])
        pushed = compressive.curvature(compression2) if curvature else compressive.weight(compression2)
        w_n = self.settings.floor + torch.where(q_n < 0, pushed, 1.0)
        w_t = self.shear_weight(compression2) * self.shear.weight(shear2)
        scale = self.settings.sparsity / (self.reference * self.size) ** 2 / self.area / rho2
        one = torch.eye(3, dtype=force.dtype, device=force.device)[..., None]
        along = (scale * (w_n - w_t))[:, None] * normal
        return along[:, :, None] * normal[..., None, :, :] + (scale * w_t)[:, None, None] * one

    def forward(self, traction: Tensor, normal: Tensor, noise_level: Tensor) -> LossTerms:
        """Return the loss of tractions `[B, 3, N]` at the last scale `tau`, evaluated at each vertex's own push."""
        q_n, shear2, compression2 = self.parts(traction, normal)
        rho2 = self.scale2(compression2, noise_level, torch.full_like(noise_level, self.settings.tau[-1]))
        q_n, shear2 = q_n / rho2.sqrt(), shear2 / rho2
        pushes = GemanMcClure(self.settings.tau[-1]).loss((-q_n).clamp_min(0) ** 2)
        others = q_n.clamp_min(0) ** 2 / 2 + self.shear_weight(compression2 / rho2) * self.shear.loss(shear2)
        unit = self.settings.sparsity / self.size**2 * self.area
        return LossTerms(compression2, rho2, pushes @ unit, others @ unit)


def is_significant(scale: Tensor) -> Tensor:
    """Return where noise does not explain a push, bool, from the result of `contact_scale`."""
    return scale < NO_CONTACT_SCALE / 2


def _gaussian_mean(membrane: Membrane, reach: float) -> Tensor:
    """Return the weights `[V, V]` of Gaussian means over the rest surface; column k is the mean around vertex k."""
    weight = torch.exp(-(torch.cdist(membrane.rest, membrane.rest) ** 2) / (2 * reach**2))
    weight = membrane.rest_area[:, None] * torch.where(weight < NEGLIGIBLE, 0.0, weight)
    return weight / weight.sum(0)
