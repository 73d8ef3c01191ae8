"""The contact force that acts on every vertex from outside, and its tangent stiffness.

With the elastic energy `U`, the rest load `h`, the pressure `p` and the volume `V`, it is `grad U - h - p grad V`.
"""

from typing import NamedTuple

import torch
from torch import Tensor, nn

from ...mechanics.cavity import rest_balance
from ...mechanics.hyperelastic import ElasticEnergy
from ...solve.stencil import apply_stencil, inner, one_ring_edges, stencil_kernels
from ...surface.membrane import Membrane


class Linearised(NamedTuple):
    """The contact force linearised at the inner vertices; all but the normal are zero for vertices that are not free.

    Attributes:
        force: contact forces, `[B, 3, N]`.
        stiffness: tangent stiffness, `[B, 3, 3, 7, N]`: derivatives of a force component in the components of the vertices of
            its stencil. It is symmetric, because it is the Hessian of an energy.
        volume: gradient of the volume, `[B, 3, N]`.
        normal: outward unit normals, `[B, 3, N]`.
    """

    force: Tensor
    stiffness: Tensor
    volume: Tensor
    normal: Tensor


class ContactForce(nn.Module):
    """Contact forces of a membrane.

    The rest load makes the rest surface an equilibrium without contact, see `rest_balance`.

    Args:
        membrane: the rest surface on the solver's grid.
        elasticity: elastic energy of the membrane.
    """

    rest_load: Tensor
    free: Tensor
    inner_free: Tensor
    free_neighbours: Tensor
    edges: Tensor
    rest_edges: Tensor
    kernels: Tensor

    def __init__(self, membrane: Membrane, elasticity: ElasticEnergy):
        super().__init__()
        self.membrane, self.elasticity = membrane, elasticity
        self.register_buffer("rest_load", rest_balance(membrane, elasticity)[1])
        self.register_buffer("free", (~membrane.fixed).double()[:, None])
        self.register_buffer("inner_free", inner(self.free, membrane.grid).squeeze(-1))
        self.register_buffer("edges", one_ring_edges())
        self.register_buffer("rest_edges", apply_stencil(membrane.rest, self.edges, membrane.grid, border=False))
        self.register_buffer("kernels", stencil_kernels())
        free_neighbours = apply_stencil(self.free, stencil_kernels()[1:], membrane.grid, border=False)
        self.register_buffer("free_neighbours", free_neighbours.reshape(6, -1))

    def forward(self, u: Tensor, pressure: Tensor) -> Tensor:
        """Return the contact forces `[B, V, 3]`, zero where fixed, of a displacement `u [B, V, 3]` and a pressure `[B]`."""
        of_fluid = pressure[:, None, None] * self.membrane.volume_gradient(self.membrane.rest + u)
        return (self.elasticity.gradient_of_displaced(u) - self.rest_load - of_fluid) * self.free

    def linearised(self, u: Tensor, pressure: Tensor) -> Linearised:
        """Return the force and the derivatives of force and volume at the inner vertices."""
        grid, p = self.membrane.grid, pressure[:, None, None]
        edges, chords = (self.rest_edges + apply_stencil(u, self.edges, grid, border=False)).chunk(2, -1)
        edges, volume_ring = edges.unflatten(-1, (6, -1))[:, None], self.membrane.volume_one_ring(chords)
        gradient = 0.5 * (volume_ring * edges).sum((2, 3))
        stress, elastic_ring = self.elasticity.one_ring(u)
        force = (stress[:, None] * edges[:, 0]).sum(2) - inner(self.rest_load, grid).mT - p * gradient
        beside = self.free_neighbours * torch.addcmul(elastic_ring, volume_ring, p[..., None, None], value=-1)
        stiffness = torch.cat([-elastic_ring.sum(3, keepdim=True), beside], 3) * self.inner_free
        normal = gradient * gradient.square().sum(1, keepdim=True).clamp_min(torch.finfo(u.dtype).tiny).rsqrt()
        return Linearised(force * self.inner_free, stiffness, gradient * self.inner_free, normal)

    def change(self, stiffness: Tensor, step: Tensor) -> Tensor:
        """Return the change `A u` of the forces for steps `u` of the inner vertices, `[B, C, 3, N]` both; `A` is symmetric."""
        m, n = self.membrane.grid
        steps = apply_stencil(step.mT, self.kernels, (m - 2, n - 2))
        steps = steps.unflatten(-1, (len(self.kernels), -1)).flatten(2, 3)
        changed: Tensor = (stiffness.flatten(2, 3)[:, None] * steps[:, :, None]).sum(3)
        return changed
