"""Residuals of the markers: the angles between the markers' measured rays and where the surface has the markers."""

from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from ...camera.model import Camera
from ...camera.rig import Rig
from ...control_flow import traced
from ...markers.spacing import neighbours
from ...solve.stencil import inner
from ...solve.stencil_layouts import NEAR
from ...surface.bicubic import bicubic_shares
from ...surface.membrane import Membrane
from ...surface.projection import SurfacePoints
from ...surface.tangent import tangent_frame
from ..base import Observation, Problem

NEIGHBOURS = 4
"""Number of neighbours of a marker that are tested for being off their rays in the same way."""


class MeasuredRays(NamedTuple):
    """Measured marker rays, and what a gauge reads.

    origins      `[B, 3, D]`
    across       `[B, 2, 3, D]`, two vectors across each ray, along which its turns are measured in standard deviations
    weight       `[B, D]`, the markers' confidence
    noise_level  `[B]`, the markers' standard deviations over their own at rest, their geometric mean
    motion       `[B, 2, 4 W, D]`, derivatives of the angles in the motion of each view's image: du, dv, rotation, growth (px)
    gauge        `[B, 2]`, as of `Observation`, or None
    """

    origins: Tensor
    across: Tensor
    weight: Tensor
    noise_level: Tensor
    motion: Tensor
    gauge: Tensor | None = None


def marker_rays(camera: Camera | Rig, pixels: Tensor, positions: Tensor, confidence: Tensor, covariance: Tensor) -> Observation:
    """The rays of markers, each with its own noise.

    Args:
        camera: the sensor's.
        pixels: `[B, D, 2]`.
        positions: `[D, 3]`, the markers' rest positions: behind a port a ray's origin moves too, which turns it about a marker.
        confidence: `[B, D]`.
        covariance: covariance of the pixels, `[B, D, 2, 2]` px^2.

    Returns:
        The rays; along `across` a turn has the covariance 1: with the derivative `J [3, 2]` of a ray in its pixel, as a marker
        sees it, and the covariance `C = L L^T` these are the rows of `L^-1 (J^T J)^-1 J^T`. `motion`: what the image's motion
        against the rim, `p -> p + (du, dv) + (rotation x (p - c) + growth (p - c)) / R` about the image's centre `c`, makes of
        them; all four in px, those of rotation and growth at half the image's diagonal, `R`.
    """
    half = 0.5 * torch.eye(2, dtype=pixels.dtype, device=pixels.device)
    steps = torch.cat([torch.zeros_like(half[:1]), half, -half])[:, None]
    origins, directions = camera.pixel_to_ray(pixels[:, None] + steps)
    direction = directions[:, :1]
    distance = torch.linalg.vector_norm(positions - origins[:, 0], dim=-1)[:, None, :, None]
    turns = (directions[:, 1:3] - directions[:, 3:]) + (origins[:, 1:3] - origins[:, 3:]) / distance
    by_u, by_v = (turns - (turns * direction).sum(-1, keepdim=True) * direction).unbind(1)
    uu, uv, vv = ((a * b).sum(-1, keepdim=True) for a, b in ((by_u, by_u), (by_u, by_v), (by_v, by_v)))
    area2 = uu * vv - uv * uv
    in_u, in_v = (vv * by_u - uv * by_v) / area2, (uu * by_v - uv * by_u) / area2  # px of a small turn
    a, b, c = (covariance[..., i, j, None] for i, j in ((0, 0), (0, 1), (1, 1)))
    first = in_u * a.rsqrt()
    second = (in_v - b / a * in_u) * (c - b * b / a).rsqrt()
    across = torch.stack([first, second], 2)
    of_u, of_v = camera.motion_of_pixels(pixels).unbind(-2)
    motion = torch.stack([of_u * a.rsqrt(), (of_v - b / a * of_u) * (c - b * b / a).rsqrt()], 2)
    return Observation(origins[:, 0], directions[:, 0], confidence, across, motion)


def rest_rays(problem: Problem) -> tuple[Observation, float]:
    """The rays of a sensor's markers at rest, and their noise in the mean, radians."""
    noise = float(problem.rest_covariance.diagonal(dim1=-2, dim2=-1).mean().sqrt() / problem.camera.focal.mean())
    counts, seen = problem.rest_confidence, problem.positions
    sure = torch.ones_like(problem.rest_pixels[None, :, 0]) if counts is None else counts[None]
    seen = seen if problem.levers is None else seen + problem.levers
    return marker_rays(problem.camera, problem.rest_pixels[None], seen, sure, problem.rest_covariance[None]), noise


def seen_from_origin(positions: Tensor) -> Observation:
    """Markers at `positions [D, 3]` as a camera without ports sees them."""
    directions = F.normalize(positions, dim=-1)[None]
    return Observation(torch.zeros_like(directions), directions, torch.ones_like(directions[..., 0]))


def _spread(across: Tensor) -> Tensor:
    """Variance of the turns `[...]` in the geometric mean of both directions, of vectors `[..., 2, 3]` across rays."""
    area: Tensor = torch.linalg.vector_norm(torch.linalg.cross(across[..., 0, :], across[..., 1, :]), dim=-1)
    return 1 / area


class MarkerResiduals(nn.Module):
    """The markers of a surface, and how they are seen off their measured rays.

    Args:
        membrane: the rest surface on the solver's grid.
        markers: the markers as points of it.
        positions: `[D, 3]` their rest positions.
        noise: standard deviation of a marker's angles, radians, where an observation does not give it.
        rest: the markers' rays at rest; None: from the origin, with that noise.
        views: how many views see the markers, which are listed once for each.
    """

    positions: Tensor
    rest_spread: Tensor
    smooth_shares: Tensor
    vertex_shares: Tensor
    pair_shares: Tensor
    nearest: Tensor

    def __init__(
        self,
        membrane: Membrane,
        markers: SurfacePoints,
        positions: Tensor,
        noise: float,
        rest: Observation | None,
        views: int = 1,
    ):
        super().__init__()
        self.grid, self.noise, self.views = membrane.grid, noise, views
        self.register_buffer("positions", torch.as_tensor(positions, dtype=torch.float64))
        count = len(self.positions) // views
        nearest = torch.from_numpy(neighbours(self.positions[:count].numpy(), NEIGHBOURS).copy())
        self.register_buffer("nearest", torch.cat([nearest + view * count for view in range(views)]))
        vertex_shares, pair_shares = _shares(membrane, markers)
        self.register_buffer("vertex_shares", vertex_shares)
        self.register_buffer("pair_shares", pair_shares)
        smooth = torch.from_numpy(bicubic_shares(markers, membrane.grid, membrane.fixed)) * ~membrane.fixed
        self.register_buffer("smooth_shares", inner(smooth.mT, membrane.grid).mT.contiguous())
        across = None if rest is None else rest.across
        spread = torch.full_like(self.positions[:, 0], noise**2) if across is None else _spread(across)[0]
        self.register_buffer("rest_spread", spread)

    @property
    def in_machine_code(self) -> bool:
        """Whether the steps of one view's markers that lie on the surface can be taken by machine code."""
        return self.views == 1

    @property
    def seen_at_rest(self) -> Tensor:
        """What the camera sees of the markers at rest, `[D, 3]`."""
        return self.positions

    @traced
    def measured(self, observation: Observation) -> MeasuredRays:
        """The markers' rays as `angles` takes them."""
        origins, directions, confidence, across, motion, gauge = observation.to(self.positions.dtype)
        if across is None:
            across = tangent_frame(directions) / self.noise
        if motion is None:
            motion = torch.zeros_like(across[..., :1]).expand(-1, -1, -1, 4 * self.views)
        found = (confidence > 0).to(confidence.dtype)
        excess = torch.where(found > 0, _spread(across) / self.rest_spread, 1.0).log()
        noise_level = (excess.sum(-1) / found.sum(-1).clamp_min(1) / 2).exp()
        turned = across.movedim(1, -1).contiguous(), confidence, noise_level, motion.movedim(1, -1).contiguous()
        return MeasuredRays(origins.mT.contiguous(), *turned, gauge)

    def markers(self, u: Tensor) -> Tensor:
        """The markers' positions on the surface displaced by `u [B, V, 3]`, `[B, D, 3]`: their displacement is bicubic between
        the grid's lines. In the equations it is linear, for their sparsity: steps are short, and smooth as the chords' errors
        are not."""
        return self.positions + self.smooth_shares @ inner(u, self.grid)

    def angles(self, u: Tensor, measured: MeasuredRays, moved: Tensor) -> tuple[Tensor, Tensor]:
        """Angles across the measured rays `[B, 2, D]`, and the bearing Jacobian: their derivatives in the markers' positions,
        `[B, 2, 3, D]`; `moved [B, 4 W]`: of the views' cameras."""
        return self._seen(self.markers(u), measured, moved)

    def _seen(self, places: Tensor, measured: MeasuredRays, moved: Tensor) -> tuple[Tensor, Tensor]:
        """As `angles`, of markers at `places [B, D, 3]`."""
        to_marker = places.mT - measured.origins
        distance = torch.linalg.vector_norm(to_marker, dim=1, keepdim=True)
        along = (to_marker / distance)[:, None]
        angle = (measured.across * along).sum(2, keepdim=True)
        jacobian = (measured.across - angle * along) / distance[:, None]
        angle = angle.squeeze(2)
        return angle + (measured.motion * moved[:, None, :, None]).sum(2), jacobian

    def repeated(self, values: Tensor) -> Tensor:
        """Values `[..., D]` of the markers for each of the fields that their places follow, of which `vertex_shares` holds the
        shares, one after the other: here for one, the displacement."""
        return values

    def joined(self, values: Tensor) -> Tensor:
        """The sum `[..., D]` of values for each of these fields."""
        return values

    def blocks(self, jacobian: Tensor, weighted: Tensor) -> Tensor:
        """The markers' blocks `J^T w J [B, 3, 3, D]`, from `J` and `w J`, `[B, 2, 3, D]` each."""
        return (jacobian[:, :, :, None] * weighted[:, :, None]).sum(1)

    def near(self, blocks: Tensor) -> Tensor:
        """The blocks between the inner vertices and those at the first `OFFSETS` from them, `[B, 3, 3, K, N]`."""
        near: Tensor = (blocks @ self.pair_shares).unflatten(-1, (len(NEAR), -1))
        return near

    def diagonal(self, blocks: Tensor) -> Tensor:
        """The diagonals `[B, 3, N]` of the blocks between the inner vertices and themselves."""
        own: Tensor = blocks.diagonal(dim1=1, dim2=2).mT @ self.pair_shares[:, : self.vertex_shares.shape[1]]
        return own

    def product(self, blocks: Tensor, u: Tensor) -> Tensor:
        """What the blocks give, `[B, C, 3, N]`, for `u` of that shape."""
        shares = self.vertex_shares
        return weighed(blocks[:, None], u @ shares.transpose(0, 1)) @ shares

    def loads_alone(self, turned: Tensor, weighted: Tensor) -> Tensor:
        """`J^T w e [B, D, 2, 3, N]` of every marker by itself, its angles turned by `turned [B, D, 2, 2]` (noise, angle)."""
        return torch.einsum("bdra,bacd,dn->bdrcn", turned, weighted, self.vertex_shares)

    def misfits(self, angles: Tensor, measured: MeasuredRays, outlier: float, far: float) -> tuple[Tensor, Tensor]:
        """How far the markers are off their rays, in standard deviations, and as much of it as neighbours have in common.

        Args:
            angles: angles of the markers, `[B, 2, D]`.
            measured: the markers' rays.
            outlier: as what each marker counts at most, in the first.
            far: the same in the second.

        Returns:
            Rms of the angles `[B]`; the root of the mean product `[B]` of a marker's angles with its nearest neighbours', 0
            where it is negative. Noise and a marker's wrong match know nothing of the next; what no surface can follow does.
        """
        weight = measured.weight
        counted = angles.square().mean(1).clamp_max(outlier**2)
        length = angles.square().sum(1, keepdim=True).clamp_min(1e-12).sqrt()
        here = angles * (far / length).clamp_max(1) * weight[:, None]
        beside, seen = (each[..., self.nearest].sum(-1) for each in (here, weight))
        shared = (here * beside).sum((1, 2)) / (weight * seen).sum(-1).clamp_min(1)
        return ((weight * counted).sum(-1) / weight.sum(-1).clamp_min(1)).sqrt(), shared.clamp_min(0).sqrt()

    def outlying(self, u: Tensor, measured: MeasuredRays, moved: Tensor, limit: float) -> Tensor:
        """The share `[B]` of the markers that are seen and more than `limit` standard deviations off their rays."""
        far = self.angles(u, measured, moved)[0].square().sum(1) > limit**2
        return (measured.weight * far).mean(-1)


def _shares(membrane: Membrane, markers: SurfacePoints) -> tuple[Tensor, Tensor]:
    """Every marker's share in what is summed at the inner vertices, `[D, N]`, and at them with those at `NEAR`, `[D, 4 N]`."""
    m, n = membrane.grid
    vertices, weights = torch.as_tensor(markers.vertices).long(), torch.as_tensor(markers.weights, dtype=torch.float64)
    share = torch.zeros(len(vertices), m * n, dtype=torch.float64).scatter_(1, vertices, weights) * ~membrane.fixed
    share = share.unflatten(1, (m, n))
    here = share[:, 1:-1, 1:-1]
    near = [(here * share[:, 1 + i : m - 1 + i, 1 + j : n - 1 + j]).flatten(1) for i, j in NEAR]
    return here.flatten(1), torch.cat(near, 1)


def weighed(blocks: Tensor, field: Tensor) -> Tensor:
    """Blocks `[..., 3, 3, N]` times a field `[..., 3, N]`."""
    return (blocks * field[..., None, :, :]).sum(-2)
