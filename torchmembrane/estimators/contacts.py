"""Contact patches: their location, force, normal, area, slip ratio and curvature.

A patch is the surroundings of a persistent peak of the smoothed compressive traction, called the push. Every vertex belongs,
with all of its traction, to the patch whose peak is nearest on the rest surface. So the forces of the patches add up to the
total force, even where the estimate smears a push over the edge of the contact.

If no tractions are known, a contact is a region of the surface that lies inside the rest surface.
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
"""Largest number of contacts that are reported."""
LEAST = 0.03
"""Smallest peak of the smoothed push that forms its own patch, relative to the highest peak."""
APART = 0.3
"""Smallest prominence of a peak that forms its own patch, relative to its height: its height above the pass to a higher
peak."""
PUSHED = 0.5
"""Indicator above which a vertex is in contact."""
RIM = 0.1
"""Relative to the surface's size: a push closer to the rim than this, or than the markers' spacing, may continue beyond it."""
RIM_SHARE = 0.05
"""Share of a patch's push so close to the rim, above which the patch may reach the rim."""
BESIDE = 0.06
"""Relative to the surface's size: distance from the rim within which a body that reaches the rim has displaced the surface."""
MOVED = 0.225
"""Displacement at this distance, relative to the largest of all, above which the patch may reach the rim. A patch reaches the
rim if both this and `RIM_SHARE` are exceeded."""
LEAST_STEPS = 2.0
"""Smallest diameter of a patch whose curvatures are reported, in grid steps."""
LEAST_BULGE = 1e-3
"""Smallest displacement into the rest surface that forms its own contact, relative to the surface's size."""


class Contacts(NamedTuple):
    """Contacts of a batch: P = 4 for each frame, the strongest first, NaN if there are fewer.

    indicator  [B, V]  contact indicator of each vertex, 0..1
    points     [B, P, 3]  centroids of the contacts, length unit
    force      [B, P, 3]  forces on the membrane; NaN if no tractions are found
    normal     [B, P, 3]  mean outward normals of the membrane in the contacts
    area       [B, P]  areas of the contacts, length^2
    slip       [B, P]  ratio of shear force to normal force; NaN if no tractions are found
    curvature  [B, P, 2]  principal curvatures of the surface, positive where the object bulges into the membrane
    at_rim     [B, P]  1 if the contact reaches the rim, else 0
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
    """Return the contact indicator `s / (s + reference / 2)` of the compressive normal traction `s`.

    A convex rigid body pushes with at least the fluid's pressure. If the reference is the rest pressure, the indicator at a
    contact is therefore above 2/3.

    Args:
        traction: contact tractions, `[B, V, 3]`.
        normals: outward normals, `[B, V, 3]`.
        reference: reference traction, force / length^2, a number or `[B, V]`.

    Returns:
        The indicator `[B, V]`, in 0..1.

    Example:
        >>> outward = torch.tensor([[[0.0, 0.0, 1.0]]])
        >>> contact_indicator(-0.3 * outward, outward, 0.2)
        tensor([[0.7500]])
    """
    inward = (-(traction * normals).sum(-1)).clamp_min(0)
    return inward / (inward + reference / 2)


def contact_points(vertices: Tensor, rest: Tensor, inward_force: Tensor, peaks: Tensor) -> tuple[Tensor, Tensor]:
    """Return the force-weighted centroids of the contact patches, and which vertices belong to each.

    A vertex belongs to the patch whose peak is nearest at rest.

    Args:
        vertices: deformed vertices, `[B, V, 3]`.
        rest: rest vertices, `[V, 3]`.
        inward_force: inward normal force at each vertex, `[B, V]`.
        peaks: vertex with the peak push of each patch, `[B, P]` int64, -1 if there is none.

    Returns:
        Centroids `[B, P, 3]`, the strongest patch first, NaN if there is none; and `[B, P, V]`, 1 where a vertex belongs to the
        patch, else 0.
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
    """Return the depth `[B, V]` of a surface `x [B, V, 3]` with outward `normals [B, V, 3]` inside the rest surface, measured
    along the mean of both normals."""
    normal = torch.nn.functional.normalize(normals + membrane.rest_normals, dim=-1)
    return -((x - membrane.rest) * normal).sum(-1)


def bulge_regions(bulge: Tensor, membrane: Membrane, count: int) -> Tensor:
    """Return the region number of each vertex, `[B, V]`, from `bulge [B, V]`; it is 0 outside the `count` strongest regions."""
    on_grid = bulge.float().unflatten(-1, membrane.grid)  # single precision is enough to compare heights
    return persistent_regions(on_grid, count, LEAST_BULGE * membrane.size).flatten(1)


def region_centroids(x: Tensor, region: Tensor, weight: Tensor, membrane: Membrane, count: int) -> Tensor:
    """Return the centroids `[B, count, 3]` of numbered regions of `x [B, V, 3]`, weighted by `weight [B, V]`; NaN if none."""
    weight = weight * membrane.rest_area
    numbers = torch.arange(1, count + 1, device=x.device)
    weight = weight[:, None] * (region[:, None] == numbers[:, None])
    centroids: Tensor = weight @ x / weight.sum(-1, keepdim=True)
    return centroids


class ContactPatches(nn.Module):
    """Computes the contact patches of a membrane, with their forces and geometry.

    Args:
        membrane: the rest surface on the solver's grid.
        spacing: spacing of the markers on the surface, length unit; 0 if it does not limit the resolution.
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
        reach = torch.clamp(from_rim[~membrane.fixed].min(), min=beside)  # on a coarse grid all vertices are farther away
        self.register_buffer("near_rim", (from_rim < max(RIM * membrane.size, spacing)).double())
        self.register_buffer("beside_rim", (from_rim <= reach) * (beside / from_rim.clamp_min(beside)))

    def pushes(self, x: Tensor, normals: Tensor, traction: Tensor, reference: Tensor, surroundings: Tensor) -> Contacts:
        """Return the contacts of a field of tractions: a patch around every persistent peak of the push.

        Args:
            x: the surface, `[B, V, 3]`.
            normals: outward normals, `[B, V, 3]`.
            traction: contact force per rest area, `[B, V, 3]`.
            reference: reference traction of the contact indicator, `[B, V]`.
            surroundings: smoothing matrix of the push, which is applied twice, `[N, N]`; each column has the weights of a mean
                around an inner vertex.
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
        """Return the regions where a surface `x [B, V, 3]` lies inside the rest surface as contacts; their forces follow from
        the `traction [B, V, 3]`, if known."""
        bulge = bulge_inwards(x, normals, self.membrane)
        region = bulge_regions(bulge, self.membrane, CONTACT_POINTS)
        points = region_centroids(x, region, bulge.clamp_min(0), self.membrane, CONTACT_POINTS)
        return self.of_regions(x, normals, region, points, traction)

    def of_regions(
        self, x: Tensor, normals: Tensor, region: Tensor, points: Tensor, traction: Tensor | None = None
    ) -> Contacts:
        """Return numbered regions `[B, V]` with centroids `points [B, P, 3]` as contacts; the indicator is 1 inside, else 0."""
        indicator, numbers = (region > 0).to(x.dtype), torch.arange(1, points.shape[1] + 1, device=x.device)
        mine = (region[:, None] == numbers[:, None]).to(x.dtype)
        even = -normals if traction is None else traction  # a uniform push
        contacts: Contacts = self(x, normals, even, indicator, points, mine)
        if traction is not None:
            return contacts
        return contacts._replace(force=torch.nan * contacts.force, slip=torch.nan * contacts.slip)

    def forward(
        self, x: Tensor, normals: Tensor, traction: Tensor, indicator: Tensor, points: Tensor, mine: Tensor
    ) -> Contacts:
        """Compute force, normal, area, slip ratio and curvatures of every patch, and whether it reaches the rim.

        Args:
            x: the surface, `[B, V, 3]`.
            normals: outward normals of the surface, `[B, V, 3]`.
            traction: contact force per rest area, `[B, V, 3]`.
            indicator: contact indicator, `[B, V]`.
            points: centroids of the patches, `[B, P, 3]`, NaN if there is none.
            mine: 1 where a vertex belongs to the patch, else 0, `[B, P, V]`.
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
        """Return the principal curvatures `[B, P, 2]` of the patches and the diameters `[B, P]` of discs with the same spread.

        The larger curvature comes first; it is positive where the surface is hollow seen from outside. It is the curvature of a
        quadratic height function over the plane orthogonal to `normal [B, P, 3]`, fitted by least squares.

        Args:
            x: the surface, `[B, V, 3]`.
            normal: mean normals of the patches, `[B, P, 3]`.
            strong: weights of the fit, `[B, P, V]`; they add up to 1.
            share: weights for centre and spread of a patch, `[B, P, V]`; they add up to 1.
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
