"""The normal equations of force balance on one grid: linearised and weighted forces and bearing residuals.

Fields have their components first and the inner vertices, or the markers, last.
"""

from typing import NamedTuple

import torch
from torch import Tensor, nn

from ...solve.stencil_system import Matrix, StencilSystem
from .camera_motion import CameraMotion
from .contact_force import ContactForce, Linearised
from .marker_residuals import MarkerResiduals, MeasuredRays, weighed
from .robust import Cauchy
from .traction_loss import TractionLoss

DAMPING = 1e-6
"""Relative increase of the matrix's diagonal for the standard deviations."""
SLACK = 0.75
"""Rest tension relative to shear modulus x thickness (0.75 at a prestretch of 1.15) below which a sheet is solved in double
precision. It is so compliant between its markers that rounding in float32 displaces it by per cents of a press."""


class NormalEquations(NamedTuple):
    """The matrix `M = A^T W A + J^T w J`; the markers' parts are longer for markers with levers, see `LeverResiduals`.

    Attributes:
        stiffness: tangent stiffness of the forces, `A [B, 3, 3, 7, N]`.
        weights: weights of the forces, `W [B, 3, 3, N]`.
        weighted_jacobian: weighted bearing Jacobian in the markers' positions, `w J [B, 2, 3, D]`.
        marker_blocks: blocks `J^T w J [B, 3, 3, D]` of the markers.
        marker_weights: weights of the markers, `w [B, D]`.
    """

    stiffness: Tensor
    weights: Tensor
    weighted_jacobian: Tensor
    marker_blocks: Tensor
    marker_weights: Tensor


class BalanceEquations(nn.Module):
    """The equations of a Gauss-Newton step for the inner vertices.

    Args:
        forces: contact forces.
        bearings: residuals of the markers.
        loss: loss of the tractions.
    """

    def __init__(self, forces: ContactForce, bearings: MarkerResiduals, loss: TractionLoss):
        super().__init__()
        self.forces, self.bearings, self.loss = forces, bearings, loss
        self.system = StencilSystem(forces.membrane.grid, forces.inner_free > 0)
        elasticity = forces.elasticity
        self.is_slack = bool(elasticity.tension < SLACK * 2 * (elasticity.c1 + elasticity.c2))

    def linearised(
        self,
        u: Tensor,
        pressure: Tensor,
        moved: Tensor,
        measured: MeasuredRays,
        tau: Tensor,
        outlier: Tensor,
        curvature: bool = False,
    ) -> tuple[Linearised, NormalEquations, Tensor, tuple[Tensor, Tensor], CameraMotion]:
        """Linearise the equations at a state; `tau` and `curvature` are as for `TractionLoss.weights`, and `outlier [B]` is
        the scale of the markers' loss.

        Returns:
            The forces, the normal equations, their loads and corner (see `loads`), and the camera's motion.
        """
        at = self.forces.linearised(u, pressure)
        W = self.loss.weights(at.normal, at.force, measured.noise_level, tau, curvature)
        angle, jacobian = self.bearings.angles(u, measured, moved)
        weight = measured.weight * Cauchy(outlier[:, None]).weight(measured.weight * angle.square().sum(1))
        normal = self.normal_equations(at, W, jacobian, weight)
        return at, normal, *self.loads(normal, at, angle), self.motion(normal, measured, angle)

    def normal_equations(self, at: Linearised, W: Tensor, jacobian: Tensor, weight: Tensor) -> NormalEquations:
        """Return the normal equations of forces with weights `W [B, 3, 3, N]` and angles with a `weight [B, D]`."""
        weighted = self.bearings.repeated(weight)[:, None, None] * jacobian
        return NormalEquations(at.stiffness, W, weighted, self.bearings.blocks(jacobian, weighted), weight)

    def loads(self, normal: NormalEquations, at: Linearised, angle: Tensor) -> tuple[Tensor, tuple[Tensor, Tensor]]:
        """Return the loads `v`, `A^T W f + J^T w r` and `-A^T W v`, `[B, 3, 3 N]`, and the corner `f^T W v`, `v^T W v`,
        `[B]`."""
        W, v = normal.weights, at.volume
        weighted = weighed(W[:, None], torch.stack([at.force, -v], 1))
        of_forces, of_fluid = self.forces.change(at.stiffness, weighted).split(1, 1)
        angle = self.bearings.repeated(angle)
        of_markers = (normal.weighted_jacobian * angle[:, :, None]).sum(1) @ self.bearings.vertex_shares
        loads = torch.cat([v[:, None], of_forces + of_markers[:, None], of_fluid], 1).flatten(2)
        of_force, of_volume = (weighted * v[:, None]).sum((2, 3)).unbind(1)
        return loads, (of_force, -of_volume)

    def motion(self, normal: NormalEquations, measured: MeasuredRays, angle: Tensor) -> CameraMotion:
        """Return the camera's part of the equations, from the angles `r [B, 2, D]`."""
        K, w = measured.motion, normal.marker_weights
        of_each = self.bearings.repeated(K)[:, :, :, None] * normal.weighted_jacobian[:, :, None]
        coupling = of_each.sum(1) @ self.bearings.vertex_shares
        weighted = (K * w[:, None, None]).movedim(2, 1).flatten(2)
        own, slope = weighted @ K.movedim(2, 1).flatten(2).mT, (weighted @ angle.flatten(1)[..., None])[..., 0]
        return CameraMotion(coupling.flatten(2), own, slope)

    def matrix(self, normal: NormalEquations, damping: float = 0.0) -> Matrix:
        """Return `M` in the form that `system.factor` needs, with the relative increase `damping` of its diagonal."""
        near = self.bearings.near(normal.marker_blocks)
        return self.system.matrix(normal.stiffness, normal.weights, near, damping)

    def product(self, normal: NormalEquations, u: Tensor) -> Tensor:
        """Return `M u` for `u [B, C, 3 N]` without assembling the matrix."""
        u, change = u.unflatten(-1, (3, -1)), self.forces.change
        of_forces = change(normal.stiffness, weighed(normal.weights[:, None], change(normal.stiffness, u)))
        return (of_forces + self.bearings.product(normal.marker_blocks, u)).flatten(2)
