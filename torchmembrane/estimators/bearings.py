"""Bearings: the angles between the markers' measured rays and where the surface has the markers."""

from typing import NamedTuple

import torch
from torch import Tensor, nn

from ..pieces import piece
from ..solve.stencil_system import NEAR
from ..surface.membrane import Membrane
from ..surface.projection import SurfacePoints
from ..surface.stencil import inner
from ..surface.tangent import tangent_frame
from .base import Observation


class Bearings(NamedTuple):
    """Measured marker rays: `origins [B, 3, D]`, a basis across each ray `[B, 2, 3, D]`, weights over the variance `[B, D]`."""

    origins: Tensor
    across: Tensor
    weight: Tensor


class MarkerBearings(nn.Module):
    """The markers of a surface, and how they are seen off their measured rays.

    Args:
        membrane: the rest surface on the solver's grid.
        markers: the markers as points of it.
        positions: `[D, 3]` their rest positions.
        noise: standard deviation of a marker's angles, radians.
    """

    positions: Tensor
    inner_rest: Tensor
    vertex_shares: Tensor
    pair_shares: Tensor

    def __init__(self, membrane: Membrane, markers: SurfacePoints, positions: Tensor, noise: float):
        super().__init__()
        self.grid, self.noise = membrane.grid, noise
        self.register_buffer("positions", torch.as_tensor(positions, dtype=torch.float64))
        self.register_buffer("inner_rest", inner(membrane.rest, membrane.grid))
        vertex_shares, pair_shares = _shares(membrane, markers)
        self.register_buffer("vertex_shares", vertex_shares)
        self.register_buffer("pair_shares", pair_shares)

    @piece
    def measured(self, observation: Observation) -> Bearings:
        """The markers' rays as `angles` takes them."""
        origins, directions, confidence = observation
        return Bearings(origins.mT, tangent_frame(directions.mT, dim=1), confidence / self.noise**2)

    def markers(self, x: Tensor) -> Tensor:
        """The markers' positions on the surface `x [B, V, 3]`, `[B, D, 3]`."""
        return self.positions + self.vertex_shares @ (inner(x, self.grid) - self.inner_rest)

    def angles(self, x: Tensor, measured: Bearings) -> tuple[Tensor, Tensor]:
        """Angles across the measured rays `[B, 2, D]`, and the bearing Jacobian: their derivatives in the markers' positions,
        `[B, 2, 3, D]`."""
        to_marker = self.markers(x).mT - measured.origins
        distance = torch.linalg.vector_norm(to_marker, dim=1, keepdim=True)
        along = (to_marker / distance)[:, None]
        angle = (measured.across * along).sum(2, keepdim=True)
        return angle.squeeze(2), (measured.across - angle * along) / distance[:, None]


def _shares(membrane: Membrane, markers: SurfacePoints) -> tuple[Tensor, Tensor]:
    """Every marker's share in what is summed at the inner vertices, `[D, N]`, and at them with those at `NEAR`, `[D, 4 N]`."""
    m, n = membrane.grid
    vertices, weights = torch.as_tensor(markers.vertices).long(), torch.as_tensor(markers.weights, dtype=torch.float64)
    share = torch.zeros(len(vertices), m * n, dtype=torch.float64).scatter_(1, vertices, weights) * ~membrane.fixed
    share = share.unflatten(1, (m, n))
    here = share[:, 1:-1, 1:-1]
    near = [(here * share[:, 1 + i : m - 1 + i, 1 + j : n - 1 + j]).flatten(1) for i, j in NEAR]
    return here.flatten(1), torch.cat(near, 1)
