"""Residuals of the markers: the angles between their measured rays and their positions on the surface."""

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
"""Number of a marker's neighbours whose deviations from their rays are compared with its own."""


class MeasuredRays(NamedTuple):
    """Measured marker rays, and the reading of a gauge.

    origins      `[B, 3, D]`, origins of the rays
    across       `[B, 2, 3, D]`, two vectors orthogonal to each ray, along which angles are in standard deviations
    weight       `[B, D]`, confidence of the markers
    noise_level  `[B]`, geometric mean of the markers' standard deviations relative to those at rest
    motion       `[B, 2, 4 W, D]`, derivatives of the angles in the motion of each view's image: du, dv, rotation, scaling (px)
    gauge        `[B, 2]`, as for `Observation`, or None
    """

    origins: Tensor
    across: Tensor
    weight: Tensor
    noise_level: Tensor
    motion: Tensor
    gauge: Tensor | None = None


def marker_rays(camera: Camera | Rig, pixels: Tensor, positions: Tensor, confidence: Tensor, covariance: Tensor) -> Observation:
    """Return the rays of markers, each with its own noise.

    Args:
        camera: camera of the sensor.
        pixels: pixels of the markers, `[B, D, 2]`.
        positions: rest positions of the markers, `[D, 3]`; behind a port the origin of a ray moves with the pixel, which also
            changes the angle at the marker.
        confidence: confidence of the markers, `[B, D]`.
        covariance: covariance of the pixels, `[B, D, 2, 2]` px^2.

    Returns:
        The rays. Angles along `across` have unit covariance: with the derivative `J [3, 2]` of a ray's direction, seen from its
        marker, in the pixel, and the covariance `C = L L^T`, its vectors are the rows of `L^-1 (J^T J)^-1 J^T`. `motion` has
        the derivatives of these angles in the motion of the image relative to the rim, `p -> p + (du, dv) + (rotation x (p - c)
        + growth (p - c)) / R` about the image's centre `c`. All four are in px; `R` is half the image's diagonal.
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
    in_u, in_v = (vv * by_u - uv * by_v) / area2, (uu * by_v - uv * by_u) / area2  # from small rotations to px
    a, b, c = (covariance[..., i, j, None] for i, j in ((0, 0), (0, 1), (1, 1)))
    first = in_u * a.rsqrt()
    second = (in_v - b / a * in_u) * (c - b * b / a).rsqrt()
    across = torch.stack([first, second], 2)
    of_u, of_v = camera.motion_of_pixels(pixels).unbind(-2)
    motion = torch.stack([of_u * a.rsqrt(), (of_v - b / a * of_u) * (c - b * b / a).rsqrt()], 2)
    return Observation(origins[:, 0], directions[:, 0], confidence, across, motion)


def rest_rays(problem: Problem) -> tuple[Observation, float]:
    """Return the rays of a sensor's markers at rest, and their mean noise, radians."""
    noise = float(problem.rest_covariance.diagonal(dim1=-2, dim2=-1).mean().sqrt() / problem.camera.focal.mean())
    counts, seen = problem.rest_confidence, problem.positions
    sure = torch.ones_like(problem.rest_pixels[None, :, 0]) if counts is None else counts[None]
    seen = seen if problem.levers is None else seen + problem.levers
    return marker_rays(problem.camera, problem.rest_pixels[None], seen, sure, problem.rest_covariance[None]), noise


def seen_from_origin(positions: Tensor) -> Observation:
    """Return the rays from the origin to markers at `positions [D, 3]`, as for a camera without ports."""
    directions = F.normalize(positions, dim=-1)[None]
    return Observation(torch.zeros_like(directions), directions, torch.ones_like(directions[..., 0]))


def _spread(across: Tensor) -> Tensor:
    """Return the angular variance `[...]`, the geometric mean of both directions, from the vectors `across [..., 2, 3]`."""
    area: Tensor = torch.linalg.vector_norm(torch.linalg.cross(across[..., 0, :], across[..., 1, :]), dim=-1)
    return 1 / area


class MarkerResiduals(nn.Module):
    """Angles between the markers of a surface and their measured rays, with their derivatives.

    Args:
        membrane: the rest surface on the solver's grid.
        markers: the markers as points on the rest surface.
        positions: rest positions of the markers, `[D, 3]`.
        noise: standard deviation of a marker's angles, radians, for observations without noise of their own.
        rest: the markers' rays at rest; None: rays from the origin, with `noise`.
        views: number of views that see the markers, which are listed once for each view.
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
        """Whether machine code can take the steps: for one view and markers on the surface."""
        return self.views == 1

    @property
    def seen_at_rest(self) -> Tensor:
        """The visible points of the markers at rest, `[D, 3]`."""
        return self.positions

    @traced
    def measured(self, observation: Observation) -> MeasuredRays:
        """Return the markers' rays in the form that `angles` needs."""
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
        """Return the markers' positions `[B, D, 3]` on the surface displaced by `u [B, V, 3]`, by bicubic interpolation.

        The equations use linear interpolation, so that they are sparse. This is accurate enough for steps, which are short and
        smoother than the displacement itself.
        """
        return self.positions + self.smooth_shares @ inner(u, self.grid)

    def angles(self, u: Tensor, measured: MeasuredRays, moved: Tensor) -> tuple[Tensor, Tensor]:
        """Return the angles between markers and measured rays, `[B, 2, D]`, and the bearing Jacobian.

        Args:
            u: displacement of the vertices, `[B, V, 3]`.
            measured: the markers' rays.
            moved: motion of the views' cameras, `[B, 4 W]`.

        Returns:
            The angles, and their derivatives in the markers' positions, `[B, 2, 3, D]`.
        """
        return self._seen(self.markers(u), measured, moved)

    def _seen(self, places: Tensor, measured: MeasuredRays, moved: Tensor) -> tuple[Tensor, Tensor]:
        """Return the same as `angles` for markers at `places [B, D, 3]`."""
        to_marker = places.mT - measured.origins
        distance = torch.linalg.vector_norm(to_marker, dim=1, keepdim=True)
        along = (to_marker / distance)[:, None]
        angle = (measured.across * along).sum(2, keepdim=True)
        jacobian = (measured.across - angle * along) / distance[:, None]
        angle = angle.squeeze(2)
        return angle + (measured.motion * moved[:, None, :, None]).sum(2), jacobian

    def repeated(self, values: Tensor) -> Tensor:
        """Repeat values `[..., D]` of the markers for each field that their positions depend on: here the displacement alone.

        `vertex_shares` has the interpolation weights of all these fields.
        """
        return values

    def joined(self, values: Tensor) -> Tensor:
        """Sum values over these fields, `[..., D]`."""
        return values

    def blocks(self, jacobian: Tensor, weighted: Tensor) -> Tensor:
        """Return the markers' blocks `J^T w J [B, 3, 3, D]`, from `J` and `w J`, `[B, 2, 3, D]` each."""
        return (jacobian[:, :, :, None] * weighted[:, :, None]).sum(1)

    def near(self, blocks: Tensor) -> Tensor:
        """Return the blocks between the inner vertices and their neighbours at the first `K` of `OFFSETS`,
        `[B, 3, 3, K, N]`."""
        near: Tensor = (blocks @ self.pair_shares).unflatten(-1, (len(NEAR), -1))
        return near

    def product(self, blocks: Tensor, u: Tensor) -> Tensor:
        """Return the products of `J^T w J` with fields `u [B, C, 3, N]`, `[B, C, 3, N]`."""
        shares = self.vertex_shares
        return weighed(blocks[:, None], u @ shares.transpose(0, 1)) @ shares

    def loads_alone(self, turned: Tensor, weighted: Tensor) -> Tensor:
        """Return the loads `J^T w e [B, D, 2, 3, N]` of every single marker.

        Args:
            turned: changes of each marker's angles by independent noises, `[B, D, 2, 2]` (noise, angle).
            weighted: weighted Jacobian `w J`, `[B, 2, 3, D]`.
        """
        return torch.einsum("bdra,bacd,dn->bdrcn", turned, weighted, self.vertex_shares)

    def misfits(self, angles: Tensor, measured: MeasuredRays, outlier: float, far: float) -> tuple[Tensor, Tensor]:
        """Return the rms angle of the markers, and the part of it that neighbours have in common, in standard deviations.

        Args:
            angles: angles of the markers, `[B, 2, D]`.
            measured: the markers' rays.
            outlier: limit to which each marker's angle is clipped in the first result.
            far: limit to which each marker's angle is clipped in the second result.

        Returns:
            The rms angle, `[B]`, and the root of the mean product of a marker's angles with those of its nearest neighbours,
            `[B]`, 0 if negative. Noise and wrong matches of neighbours are independent; the misfit of a motion that no surface
            can follow is not.
        """
        weight = measured.weight
        counted = angles.square().mean(1).clamp_max(outlier**2)
        length = angles.square().sum(1, keepdim=True).clamp_min(1e-12).sqrt()
        here = angles * (far / length).clamp_max(1) * weight[:, None]
        beside, seen = (each[..., self.nearest].sum(-1) for each in (here, weight))
        shared = (here * beside).sum((1, 2)) / (weight * seen).sum(-1).clamp_min(1)
        return ((weight * counted).sum(-1) / weight.sum(-1).clamp_min(1)).sqrt(), shared.clamp_min(0).sqrt()


def _shares(membrane: Membrane, markers: SurfacePoints) -> tuple[Tensor, Tensor]:
    """Return the linear interpolation weights of every marker at the inner vertices, `[D, N]`, and their products with the
    weights at the neighbours `NEAR`, `[D, 4 N]`."""
    m, n = membrane.grid
    vertices, weights = torch.as_tensor(markers.vertices).long(), torch.as_tensor(markers.weights, dtype=torch.float64)
    share = torch.zeros(len(vertices), m * n, dtype=torch.float64).scatter_(1, vertices, weights) * ~membrane.fixed
    share = share.unflatten(1, (m, n))
    here = share[:, 1:-1, 1:-1]
    near = [(here * share[:, 1 + i : m - 1 + i, 1 + j : n - 1 + j]).flatten(1) for i, j in NEAR]
    return here.flatten(1), torch.cat(near, 1)


def weighed(blocks: Tensor, field: Tensor) -> Tensor:
    """Multiply blocks `[..., 3, 3, N]` by a field `[..., 3, N]`."""
    return (blocks * field[..., None, :, :]).sum(-2)
