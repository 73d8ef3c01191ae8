"""Contact patches: where something pushes, the patches' centroids, and what each tells of what touches.

A patch of tractions is what lies around a peak of the smoothed push that stands for itself, however weak it is beside the
others. Every vertex belongs to the patch whose peak is nearest to it on the rest surface, with all of its traction: the
patches' forces add up to the total force, also where the estimate smears a push over the contact's edge.

Where no tractions are known, a contact is a region of the surface that lies inside the rest surface.
"""

from typing import NamedTuple

import torch
from torch import Tensor, nn

from ..machine_code import takes
from ..solve.elimination import solve_dense
from ..solve.stencil import inner, pad_border
from ..surface.membrane import Membrane
from ..surface.tangent import tangent_frame
from .native_contacts import NativePatches
from .regions import persistent_peaks, persistent_regions

CONTACT_POINTS = 4
"""Contacts that are reported at most."""
LEAST = 0.03
"""Smallest peak of the smoothed push that is a patch of its own, over the highest."""
APART = 0.3
"""By how much of itself a peak stands above the pass to a higher one, if it is a patch of its own."""
PUSHED = 0.5
"""Indicator above which a vertex is in contact."""
RIM = 0.1
"""Over the surface's size: a push within it, or within the markers' spacing, of the rim may go on beyond the rim."""
RIM_SHARE = 0.05
"""Share of a patch's push there, above which the patch may reach the rim."""
BESIDE = 0.06
"""Over the surface's size: so near the rim a body that reaches it has moved the surface."""
MOVED = 0.225
"""Displacement there over the largest of all, above which the patch may reach the rim: it does if both say so."""
LEAST_STEPS = 2.0
"""Grid steps that a patch spans at least where curvatures are told."""
LEAST_BULGE = 1e-3
"""Over the surface's size: the smallest displacement into the rest surface that is a contact of its own."""


class Contacts(NamedTuple):
    """Where something touches in a batch, and what that tells: of P = 4 contacts, the strongest first, NaN where there are
    fewer.

    indicator  [B, V]  how surely each vertex is touched, 0..1
    points     [B, P, 3]  centroids of the contacts, length unit
    force      [B, P, 3]  on the membrane; NaN where no tractions are found
    normal     [B, P, 3]  mean outward normal of the membrane there
    area       [B, P]  length^2
    slip       [B, P]  shear force over normal force; NaN where no tractions are found
    curvature  [B, P, 2]  principal curvatures of the surface there, positive where the object bulges into the membrane
    at_rim     [B, P]  1 where the contact reaches the rim, else 0
    """

    indicator: Tensor
    points: Tensor
    force: Tensor
    normal: Tensor
    area: Tensor
    slip: Tensor
    curvature: Tensor
    at_rim: Tensor


def contact_indicator(traction: Tensor, normals: Tensor, reference: float | Tensor) -> Tensor:
    """How surely a vertex is pushed: `s / (s + reference / 2)` of the compressive normal traction `s`.

    A convex rigid body pushes with at least the fluid's pressure: at a contact the indicator is above 2/3, if the reference is
    the rest pressure.

    Args:
        traction: `[B, V, 3]`.
        normals: outward, `[B, V, 3]`.
        reference: force / length^2, a number or `[B, V]`.

    Returns:
        `[B, V]` in 0..1.

    Example:
        >>> outward = torch.tensor([[[0.0, 0.0, 1.0]]])
        >>> contact_indicator(-0.3 * outward, outward, 0.2)
        tensor([[0.7500]])
    """
    inward = (-(traction * normals).sum(-1)).clamp_min(0)
    return inward / (inward + reference / 2)


def contact_points(vertices: Tensor, rest: Tensor, inward_force: Tensor, peaks: Tensor) -> tuple[Tensor, Tensor]:
    """Force-weighted centroids of the contact patches, and whose every vertex is.

    A vertex belongs to the patch whose peak is nearest at rest.

    Args:
        vertices: deformed, `[B, V, 3]`.
        rest: `[V, 3]`.
        inward_force: `[B, V]`.
        peaks: the vertex at which each patch is pushed most, `[B, P]` int64, -1 where there is none.

    Returns:
        `[B, P, 3]`, strongest first, NaN where there is none; and `[B, P, V]`, 1 where of all patches this is the nearest at
        rest, else 0.
    """
    present = peaks >= 0
    distance2 = (rest[peaks.clamp_min(0)][:, :, None] - rest).square().sum(-1)
    nearest = torch.where(present[..., None], distance2, torch.inf).argmin(1, keepdim=True)
    number = torch.arange(peaks.shape[1], device=peaks.device)
    mine = ((nearest == number[:, None]) & present[..., None]).to(inward_force.dtype)
    load = mine * inward_force[:, None]
    order = torch.where(present, load.sum(-1), -1.0).argsort(-1, descending=True)
    present = present.gather(1, order)
    load, mine = (value.gather(1, order[..., None].expand_as(value)) for value in (load, mine))
    points = (load @ vertices) / load.sum(-1, keepdim=True).clamp_min(torch.finfo(load.dtype).tiny)
    return torch.where(present[..., None], points, torch.nan), mine


def bulge_inwards(x: Tensor, normals: Tensor, membrane: Membrane) -> Tensor:
    """How far a surface `x [B, V, 3]` with outward `normals [B, V, 3]` lies inside the rest surface, `[B, V]`, along the mean
    of both normals."""
    normal = torch.nn.functional.normalize(normals + membrane.rest_normals, dim=-1)
    return -((x - membrane.rest) * normal).sum(-1)


def bulge_regions(bulge: Tensor, membrane: Membrane, count: int) -> Tensor:
    """Numbers of the regions `[B, V]`, 0 none, that stand out of `bulge [B, V]`, at most `count`, the strongest first."""
    on_grid = bulge.float().unflatten(-1, membrane.grid)  # which of them is higher: single precision tells
    return persistent_regions(on_grid, count, LEAST_BULGE * membrane.size).flatten(1)


def region_centroids(x: Tensor, region: Tensor, weight: Tensor, membrane: Membrane, count: int) -> Tensor:
    """Centroids `[B, count, 3]` of numbered regions of `x [B, V, 3]`, weighted by `weight [B, V]`; NaN where there is none."""
    weight = weight * membrane.rest_area
    numbers = torch.arange(1, count + 1, device=x.device)
    weight = weight[:, None] * (region[:, None] == numbers[:, None])
    centroids: Tensor = weight @ x / weight.sum(-1, keepdim=True)
    return centroids


class ContactPatches(nn.Module):
    """What contact patches tell of the bodies that touch.

    Args:
        membrane: the rest surface on the solver's grid.
        spacing: spacing of the markers on it, length unit; 0 where it does not limit what is resolved.
    """

    near_rim: Tensor
    beside_rim: Tensor

    def __init__(self, membrane: Membrane, spacing: float = 0.0):
        super().__init__()
        self.membrane, self.native = membrane, NativePatches()
        m, n = membrane.grid
        self.least_span = max(LEAST_STEPS * membrane.size / ((m - 1) * (n - 1)) ** 0.5, spacing)
        from_rim = torch.cdist(membrane.rest, membrane.rest[membrane.fixed]).amin(1)
        beside = BESIDE * membrane.size
        reach = torch.clamp(from_rim[~membrane.fixed].min(), min=beside)  # a coarse grid has no vertex as near
        self.register_buffer("near_rim", (from_rim < max(RIM * membrane.size, spacing)).double())
        self.register_buffer("beside_rim", (from_rim <= reach) * (beside / from_rim.clamp_min(beside)))

    def pushes(self, x: Tensor, normals: Tensor, traction: Tensor, reference: Tensor, surroundings: Tensor) -> Contacts:
        """Where tractions push, and what that tells: a patch around every peak of the push that stands for itself.

        `reference [B, V]` is what tractions are large beside, `surroundings [N, N]` has a mean over those around every inner
        vertex in each column, by which the push is smoothed, twice; the others as below.
        """
        membrane, grid = self.membrane, self.membrane.grid
        if takes(x, normals, traction, reference) and x.dtype == surroundings.dtype == normals.dtype:
            limits = PUSHED, LEAST, APART, RIM_SHARE, MOVED
            return Contacts(*self.native(self, CONTACT_POINTS, limits, surroundings, x, normals, traction, reference))
        indicator = contact_indicator(traction, normals, reference)
        push = (indicator > PUSHED) * (-(traction * normals).sum(-1)).clamp_min(0)
        smooth = inner(push[..., None], grid)[..., 0] @ surroundings @ surroundings
        height = pad_border(smooth[..., None], grid).unflatten(1, grid)[..., 0]
        top, peaks = persistent_peaks(height, CONTACT_POINTS, LEAST, APART)
        peaks = torch.where(top > 0, peaks, -1)
        points, mine = contact_points(x, membrane.rest, push * membrane.rest_area, peaks)
        contacts: Contacts = self(x, normals, traction, indicator, points, mine)
        return contacts

    def bulges(self, x: Tensor, normals: Tensor, traction: Tensor | None = None) -> Contacts:
        """Where a surface `x [B, V, 3]` lies inside the rest surface, with the forces of its `traction [B, V, 3]`, if known."""
        bulge = bulge_inwards(x, normals, self.membrane)
        region = bulge_regions(bulge, self.membrane, CONTACT_POINTS)
        points = region_centroids(x, region, bulge.clamp_min(0), self.membrane, CONTACT_POINTS)
        return self.of_regions(x, normals, region, points, traction)

    def of_regions(
        self, x: Tensor, normals: Tensor, region: Tensor, points: Tensor, traction: Tensor | None = None
    ) -> Contacts:
        """Contacts that are numbered regions `[B, V]` with centroids `points [B, P, 3]`: the indicator is 1 in them, else 0."""
        indicator, numbers = (region > 0).to(x.dtype), torch.arange(1, points.shape[1] + 1, device=x.device)
        mine = (region[:, None] == numbers[:, None]).to(x.dtype)
        even = -normals if traction is None else traction  # as if pushed evenly
        contacts: Contacts = self(x, normals, even, indicator, points, mine)
        if traction is not None:
            return contacts
        return contacts._replace(force=torch.nan * contacts.force, slip=torch.nan * contacts.slip)

    def forward(
        self, x: Tensor, normals: Tensor, traction: Tensor, indicator: Tensor, points: Tensor, mine: Tensor
    ) -> Contacts:
        """Force, normal, area, slip, curvatures of every patch, and whether it reaches the rim.

        Args:
            x: the surface `[B, V, 3]`.
            normals: its outward normals `[B, V, 3]`.
            traction: contact force per rest area, `[B, V, 3]`.
            indicator: indicator of contact, `[B, V]`.
            points: the patches' centroids `[B, P, 3]`, NaN where there is none.
            mine: `[B, P, V]`, 1 where a vertex is the patch's, else 0.
        """
        here = torch.isfinite(points[..., 0])
        load = traction * self.membrane.rest_area[:, None]
        inward = -(load * normals).sum(-1)
        shear = load + inward[..., None] * normals
        pushed = mine * (indicator > PUSHED).to(mine.dtype)[:, None]
        push = pushed * inward.clamp_min(0)[:, None]
        tiny = torch.finfo(push.dtype).tiny
        area = pushed * self.membrane.vertex_area(x)[:, None]
        strong = push * (push / self.membrane.rest_area)
        strong = strong / strong.sum(-1, keepdim=True).clamp_min(tiny)
        normal = torch.nn.functional.normalize(strong @ normals, dim=-1)
        force, normal_force = mine @ load, (mine @ inward[..., None])[..., 0]
        slip = torch.linalg.vector_norm(mine @ shear, dim=-1) / torch.where(normal_force > 0, normal_force, 1.0)
        moved = torch.linalg.vector_norm(x - self.membrane.rest, dim=-1)[:, None]
        reaches = (mine * moved * self.beside_rim).amax(-1) > MOVED * moved.amax(-1)
        at_rim = (((push @ self.near_rim) > RIM_SHARE * push.sum(-1)) & reaches).to(push.dtype)

        def kept(values: Tensor, where: Tensor = here) -> Tensor:
            return torch.where(where.reshape(*where.shape, *(1,) * (values.ndim - 2)), values, torch.nan)

        curvature, span = self._curvature(x, normal, strong, area / area.sum(-1, keepdim=True).clamp_min(tiny))
        return Contacts(
            indicator=indicator,
            points=points,
            force=kept(force),
            normal=kept(normal),
            area=kept(area.sum(-1)),
            slip=kept(slip, here & (normal_force > 0)),
            curvature=kept(curvature, here & (span >= self.least_span)),
            at_rim=kept(at_rim),
        )

    def _curvature(self, x: Tensor, normal: Tensor, strong: Tensor, share: Tensor) -> tuple[Tensor, Tensor]:
        """Principal curvatures `[B, P, 2]`, the larger first, positive where the surface is hollow seen from outside, and the
        diameter `[B, P]` of a disc that spreads as the patch; weights `strong` and `share [B, P, V]` add up to 1 each.

        A quadratic height over the plane across `normal [B, P, 3]`, by weighted least squares.
        """
        axes = torch.cat([tangent_frame(normal), normal[:, :, None]], 2)
        local = (axes.flatten(1, 2) @ x.mT).unflatten(1, (-1, 3))
        u, v, z = (local - (share[:, :, None] * local).sum(-1, keepdim=True)).unbind(2)
        spread = (share * (u * u + v * v)).sum(-1, keepdim=True).clamp_min((1e-6 * self.membrane.size) ** 2).sqrt()
        u, v = u / spread, v / spread
        terms = torch.stack([torch.ones_like(u), u, v, u * u / 2, u * v, v * v / 2, z / spread], 2)
        gram = (strong[:, :, None] * terms[:, :, :6]) @ terms.mT
        ridge = 1e-6 * torch.eye(6, dtype=x.dtype, device=x.device)
        _, by_u, by_v, uu, uv, vv = solve_dense(gram[..., :6] + ridge, gram[..., 6:])[..., 0].unbind(-1)
        steep = 1 + by_u * by_u + by_v * by_v
        mean = ((1 + by_v * by_v) * uu - 2 * by_u * by_v * uv + (1 + by_u * by_u) * vv) / (2 * steep * steep.sqrt())
        gauss = (uu * vv - uv * uv) / (steep * steep)
        apart = (mean * mean - gauss).clamp_min(1e-12).sqrt()
        return torch.stack([mean + apart, mean - apart], -1) / spread, 8**0.5 * spread[..., 0]
