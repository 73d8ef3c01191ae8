"""Segmentation of contacts from the flow or the surface alone (section 5.1): polar-angle change, regions that bulge inwards.

An inward displacement `-s n` of a point at range `t` turns its ray by `-s (n . e) / t`, where `e` is the direction of
increasing polar angle. So `d beta = beta_0 - beta_1` (eq. 29) has the sign of `n . e` where the membrane bulges inwards; the
printed `d beta < 0` holds only for a camera above the surface's centre of curvature.
"""

from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor, nn

from ...camera.model import Rays
from ...control_flow import traced
from ...surface.membrane import Membrane
from ..contacts import (
    CONTACT_POINTS,
    LEAST_BULGE,
    ContactPatches,
    Contacts,
    bulge_inwards,
    bulge_regions,
    region_centroids,
)

DIVERGENT = 0.9  # outward share of the angular flow above which it diverges everywhere, so that the contact is on the axis
ON_AXIS = 0.1  # radius of the region in this case, relative to the surface's size


class ContactRegions(NamedTuple):
    """Contacts of a batch.

    Attributes:
        bulge: inward displacement, length unit, `[B, V]`.
        region: number of the contact, the strongest first, or 0, `[B, V]`.
        points: centroids of the regions, padded with NaN, `[B, P, 3]`.
    """

    bulge: Tensor
    region: Tensor
    points: Tensor


class PolarAngle(nn.Module):
    """Polar-angle change of eq. 29 for points of a rest surface: grid vertices or markers.

    Args:
        points: points at rest, `[N, 3]`.
        normals: outward unit normals at the points, `[N, 3]`.
        origins: origins of their rest rays, `[N, 3]`.
        directions: unit directions of their rest rays, `[N, 3]`.

    Limitations:
        Where the rays are parallel to the normals (a camera near the centre of curvature), an inward displacement does not turn
        them: only the stretch around it is visible.
    """

    range: Tensor
    rest: Tensor
    sign: Tensor

    def __init__(self, points: Tensor, normals: Tensor, origins: Tensor, directions: Tensor):
        super().__init__()
        self.register_buffer("range", ((points - origins) * directions).sum(-1))
        self.register_buffer("rest", polar_angle(directions))
        self.register_buffer("sign", torch.sign((normals * growing_polar_angle(directions)).sum(-1)))

    def change(self, directions: Tensor) -> Tensor:
        """Return `d beta = beta_0 - beta_1`, radians, for the measured unit directions `[..., N, 3]`."""
        return self.rest - polar_angle(directions)

    def bulge(self, directions: Tensor) -> Tensor:
        """Return the change of the polar angle times the range, positive where the membrane bulges inwards, `[..., N]`."""
        return self.sign * self.range * self.change(directions)


def polar_angle(directions: Tensor) -> Tensor:
    """Return the angle between `directions [..., 3]` and the optical axis, radians (eq. 29:
    `arccos f / sqrt(u^2 + v^2 + f^2)`)."""
    return torch.atan2(torch.linalg.vector_norm(directions[..., :2], dim=-1), directions[..., 2])


def growing_polar_angle(directions: Tensor) -> Tensor:
    """Return the unit vector of increasing polar angle, orthogonal to each unit direction, `[..., 3]`; zero on the axis."""
    across, along = (directions[..., 2:] * directions).split([2, 1], -1)
    return torch.nn.functional.normalize(torch.cat([across, along - 1], -1), dim=-1)


class Segmentation(nn.Module):
    """Segments contacts of a membrane, from the rays of its grid vertices or from its surface.

    Args:
        membrane: the rest surface on the solver's grid.
        rest_rays: origins and unit directions of the vertices' rest rays, `[V, 3]` each.
        count: largest number of contacts that are reported.
        patches: contact patches of the membrane, if they exist already.

    Limitations:
        Contacts closer than about a fifth of the surface's size are not resolved. A contact on the axis that turns all rays
        outwards is reported as a disc with a radius of a tenth of this size, whatever its true size.
    """

    rest_origins: Tensor
    rest_directions: Tensor
    axis_region: Tensor

    def __init__(
        self,
        membrane: Membrane,
        rest_rays: Rays | tuple[Tensor, Tensor],
        count: int = CONTACT_POINTS,
        patches: ContactPatches | None = None,
    ):
        super().__init__()
        self.membrane, self.count = membrane, count
        self.polar = PolarAngle(membrane.rest, membrane.rest_normals, *rest_rays)
        self.register_buffer("rest_origins", rest_rays[0])
        self.register_buffer("rest_directions", rest_rays[1])
        self.register_buffer("axis_region", _axis_region(membrane))
        self.patches = ContactPatches(membrane) if patches is None else patches
        self.axis_in_view = bool((self.axis_region > 0).any())

    @traced
    def by_polar_angle(self, directions: Tensor) -> ContactRegions:
        """Return the contacts by eq. 29 alone, on the rest surface, for rays `[B, V, 3]`."""
        bulge = self.polar.bulge(directions) * ~self.membrane.fixed
        return self._where(self.membrane.rest.expand(bulge.shape[0], -1, -1), bulge, directions)

    @traced
    def by_normals(self, x: Tensor) -> ContactRegions:
        """Return the contacts of a surface `[B, V, 3]`: the regions inside the rest surface, along the mean of both normals.

        If all rays turn outwards, the contact is on the axis: a camera that looks along the normals cannot see the dent itself.
        """
        return self._inside(x, self.membrane.normals(x))

    @traced
    def moved(self, before: Tensor, after: Tensor) -> Tensor:
        """Return the largest distance between points `[B, P, 3]` before and after, relative to the surface's size, `[B]`.

        It is infinite if a point appeared or disappeared.
        """
        distance = torch.linalg.vector_norm(after - before, dim=-1).nan_to_num().amax(-1)
        same = (after.isnan() == before.isnan()).flatten(1).all(1)
        return torch.where(same, distance / self.membrane.size, torch.inf)

    @traced
    def in_contact(self, region: Tensor) -> Tensor:
        """Return which vertices are in contact, `[B, V]` bool, from the numbers of regions."""
        return region > 0

    def contacts(self, x: Tensor, normals: Tensor) -> Contacts:
        """Return the contacts of `by_normals` in the form of the results, given the surface's `normals [B, V, 3]`."""
        regions = self._inside(x, normals)
        return self.patches.of_regions(x, normals, regions.region, regions.points)

    def divergence(self, directions: Tensor) -> Tensor:
        """Return the outward share of the angular flow, `[B]`: 1 if all rays turn away from the axis, -1 if all turn to it."""
        turned = torch.linalg.vector_norm(directions - self.rest_directions, dim=-1)
        reach: Tensor = self.polar.range * ~self.membrane.fixed
        least = LEAST_BULGE * self.membrane.size
        outward: Tensor = -(reach * self.polar.change(directions)).sum(-1) / (reach * turned).sum(-1).clamp_min(least)
        return outward

    def _inside(self, x: Tensor, normals: Tensor) -> ContactRegions:
        bulge = bulge_inwards(x, normals, self.membrane)
        return self._where(x, bulge, torch.nn.functional.normalize(x - self.rest_origins, dim=-1))

    def _where(self, x: Tensor, bulge: Tensor, directions: Tensor) -> ContactRegions:
        """Return the regions of `bulge [B, V]` on `x [B, V, 3]`, or the region on the axis if the flow diverges everywhere."""
        divergent = (self.divergence(directions) > DIVERGENT)[:, None] & self.axis_in_view
        region = torch.where(divergent, self.axis_region, bulge_regions(bulge, self.membrane, self.count))
        weight = torch.where(divergent, torch.ones_like(bulge), bulge.clamp_min(0))
        return ContactRegions(bulge, region, region_centroids(x, region, weight, self.membrane, self.count))


def _axis_region(membrane: Membrane) -> Tensor:
    """Return 1 for the vertices around the point where the optical axis meets the rest surface, else 0, `[V]`."""
    hit = membrane.ray_points(np.zeros((1, 3)), np.array([[0.0, 0.0, 1.0]]))
    if not np.isfinite(hit.distance[0]):
        return torch.zeros(len(membrane.rest), dtype=torch.long)
    centre = membrane.rest.new_tensor([0.0, 0.0, float(hit.distance[0])])
    near: Tensor = torch.linalg.vector_norm(membrane.rest - centre, dim=-1) < ON_AXIS * membrane.size
    return near.long()
