"""Where something touches, from the flow alone (section 5.1): polar-angle change, regions that bulge in, the paper's loop.

An inward displacement `-s n` of a point at range `t` turns its ray by `-s (n . e) / t`, where `e` is the direction in which the
polar angle grows. So `d beta = beta_0 - beta_1` (eq. 29) has the sign of `n . e` where the membrane bulges in: the printed
`d beta < 0` holds only for a camera above the surface's centre of curvature.
"""

from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from ..camera.model import Rays
from ..errors import MembraneError
from ..surface.membrane import Membrane
from .base import Equilibrium, Observation
from .minimum_energy import MinimumEnergy

SHARE = 0.5  # of a region's peak: what lies above it, around the peak, is the region
PERSISTENCE = 0.15  # of the highest peak, by which a peak stands above the saddle to a higher one, or it is no contact
LEAST = 1e-3  # smallest peak that is a contact, over the surface's size
DIVERGENT = 0.9  # outward share of the angular flow above which it diverges everywhere: the contact is on the axis
ON_AXIS = 0.1  # radius of the region then, over the surface's size
SETTLED = 2e-3  # move of the contacts, over the surface's size, at which the loop ends


class Contacts(NamedTuple):
    """Contacts of a batch: `bulge [B, V]` (length unit, positive where the membrane bulges in), `region [B, V]` (0 none, else
    the number of the contact, strongest first), `points [B, P, 3]`, the regions' centroids, NaN-padded."""

    bulge: Tensor
    region: Tensor
    points: Tensor


class Segmented(NamedTuple):
    """The loop's outcome: the last surface, its contacts, those of eq. 29 alone, and which frames have settled `[B]`."""

    surface: Equilibrium
    contacts: Contacts
    first: Contacts
    settled: Tensor


class PolarAngle:
    """Eq. 29 for points of a rest surface: grid vertices or markers.

    Args:
        points: `[N, 3]` at rest.
        normals: outward unit normals there, `[N, 3]`.
        origins: of their rest rays, `[N, 3]`.
        directions: unit directions of their rest rays, `[N, 3]`.

    Limitations:
        Where the rays run along the normals (a camera near the centre of curvature) an inward displacement does not turn them:
        only the stretch around it is visible.
    """

    def __init__(self, points: Tensor, normals: Tensor, origins: Tensor, directions: Tensor):
        self.range: Tensor = ((points - origins) * directions).sum(-1)
        self.rest = polar_angle(directions)
        self.sign = torch.sign((normals * growing_polar_angle(directions)).sum(-1))

    def change(self, directions: Tensor) -> Tensor:
        """`d beta = beta_0 - beta_1` in radians, for unit rays `[..., N, 3]` now."""
        return self.rest - polar_angle(directions)

    def bulge(self, directions: Tensor) -> Tensor:
        """The change times the range, positive where the membrane bulges in, `[..., N]`."""
        return self.sign * self.range * self.change(directions)


def polar_angle(directions: Tensor) -> Tensor:
    """Angle between `[..., 3]` and the optical axis, radians (eq. 29: `arccos f / sqrt(u^2 + v^2 + f^2)`)."""
    return torch.atan2(torch.linalg.vector_norm(directions[..., :2], dim=-1), directions[..., 2])


def growing_polar_angle(directions: Tensor) -> Tensor:
    """Unit vector across each unit direction along which the polar angle grows, `[..., 3]`; zero on the axis."""
    axis = directions.new_tensor([0.0, 0.0, 1.0])
    return torch.nn.functional.normalize(directions[..., 2:] * directions - axis, dim=-1)


class Segmentation:
    """Contacts from the rays of a sensor's grid vertices.

    Calling it with the rays now, `[B, V, 3]` each, runs the loop:

        regions that bulge in by eq. 29 (or the axis, where the flow diverges everywhere); then, until they stay,
        reconstruct with the smoother relaxed there, take the displacement along the surface's normals, and from it the regions.

    Args:
        estimator: minimum energy on the sensor's grid.
        rest_rays: the rest rays of its vertices, `origins` and `directions [V, 3]`.
        count: how many contacts are reported.
        rounds: of the loop at most.

    Limitations:
        Contacts closer than about a fifth of the surface's size are one; for the depth see `MinimumEnergy`.
    """

    def __init__(self, estimator: MinimumEnergy, rest_rays: Rays | tuple[Tensor, Tensor], count: int = 4, rounds: int = 8):
        if rounds < 1:
            raise MembraneError(f"Segmentation: rounds = {rounds}; expected at least 1")
        self.estimator, self.membrane, self.count, self.rounds = estimator, estimator.membrane, count, rounds
        self.rest_directions = rest_rays[1]
        self.polar = PolarAngle(self.membrane.rest, self.membrane.rest_normals, *rest_rays)
        self.axis_region = _axis_region(self.membrane)

    def __call__(self, origins: Tensor, directions: Tensor) -> Segmented:
        first = contacts = self.by_polar_angle(directions)
        relaxed, settled = first.region > 0, torch.zeros(len(directions), dtype=torch.bool, device=directions.device)
        observation = Observation(origins, directions, torch.ones_like(directions[..., 0]))
        for _ in range(self.rounds):
            surface = self.estimator(observation, relaxed=relaxed)
            before, contacts = contacts, self.by_normals(surface.vertices)
            moved = (contacts.points - before.points).norm(dim=-1).nan_to_num().amax(-1)
            same = (contacts.points.isnan() == before.points.isnan()).flatten(1).all(1)
            settled = settled | (same & (moved < SETTLED * self.membrane.size))
            relaxed = torch.where(settled[:, None], relaxed, contacts.region > 0)
            if settled.all():
                break
        return Segmented(surface, contacts, first, settled)

    def by_polar_angle(self, directions: Tensor) -> Contacts:
        """Eq. 29 alone: contacts on the rest surface, for rays `[B, V, 3]`."""
        bulge = self.polar.bulge(directions) * ~self.membrane.fixed
        outward = self.divergence(directions)
        region = _regions(bulge, self.membrane, self.count)
        if self.axis_region is not None:
            region = torch.where((outward > DIVERGENT)[:, None], self.axis_region.long(), region)
        weight = torch.where((outward > DIVERGENT)[:, None], torch.ones_like(bulge), bulge.clamp_min(0))
        return Contacts(bulge, region, self._centroids(self.membrane.rest.expand(len(bulge), -1, -1), region, weight))

    def by_normals(self, x: Tensor) -> Contacts:
        """Contacts of a surface `[B, V, 3]`: where it lies inside the rest surface, along the mean of both normals."""
        membrane = self.membrane
        normal = torch.nn.functional.normalize(membrane.normals(x) + membrane.rest_normals, dim=-1)
        bulge = -((x - membrane.rest) * normal).sum(-1)
        region = _regions(bulge, membrane, self.count)
        return Contacts(bulge, region, self._centroids(x, region, bulge.clamp_min(0)))

    def divergence(self, directions: Tensor) -> Tensor:
        """Outward share of the angular flow, `[B]`: 1 where every ray turns away from the axis, -1 where all turn to it."""
        turned = torch.linalg.vector_norm(directions - self.rest_directions, dim=-1)
        reach: Tensor = self.polar.range * ~self.membrane.fixed
        least = LEAST * self.membrane.size
        outward: Tensor = -(reach * self.polar.change(directions)).sum(-1) / (reach * turned).sum(-1).clamp_min(least)
        return outward

    def _centroids(self, x: Tensor, region: Tensor, bulge: Tensor) -> Tensor:
        weight = bulge * self.membrane.rest_area
        numbers = torch.arange(1, self.count + 1)
        weight = weight[:, None] * (region[:, None] == numbers[:, None])
        centroids: Tensor = weight @ x / weight.sum(-1, keepdim=True)
        return centroids


def _axis_region(membrane: Membrane) -> Tensor | None:
    """The vertices `[V]` around the point where the optical axis meets the rest surface, or None where it does not."""
    hit = membrane.ray_points(np.zeros((1, 3)), np.array([[0.0, 0.0, 1.0]]))
    if not np.isfinite(hit.distance[0]):
        return None
    centre = membrane.rest.new_tensor([0.0, 0.0, float(hit.distance[0])])
    near: Tensor = torch.linalg.vector_norm(membrane.rest - centre, dim=-1) < ON_AXIS * membrane.size
    return near


def _regions(bulge: Tensor, membrane: Membrane, count: int) -> Tensor:
    """Numbered regions around the persistent peaks of `bulge [B, V]`, strongest first, `[B, V]`."""
    m, n = membrane.grid
    neighbours: list[list[int]] = [[] for _ in range(m * n)]
    for a, b, c in membrane.triangles.tolist():
        for p, q in ((a, b), (b, c), (c, a)):
            neighbours[p].append(q)
            neighbours[q].append(p)
    least = LEAST * membrane.size
    return torch.from_numpy(np.stack([peaks(row, neighbours, count, least) for row in bulge.detach().cpu().double().numpy()]))


def peaks(height: np.ndarray, neighbours: list[list[int]], count: int, least: float) -> np.ndarray:
    """Which persistent peak each vertex belongs to, `[V]`: 0 none, 1 the highest.

    Vertices join in order of height; where two hills meet, the lower one is part of the higher unless it stands above the
    saddle by `PERSISTENCE` of the highest. A region is what lies above `SHARE` of its own peak.
    """
    hill = np.full(len(height), -1)
    top: dict[int, int] = {}
    highest = height.max()
    for vertex in np.argsort(-height).tolist():
        if height[vertex] < least:
            break
        around = sorted({int(hill[k]) for k in neighbours[vertex] if hill[k] >= 0}, key=lambda h: -height[top[h]])
        if not around:
            hill[vertex], top[vertex] = vertex, vertex
            continue
        hill[vertex] = around[0]
        for lower in around[1:]:
            if height[top[lower]] - height[vertex] < PERSISTENCE * highest:
                hill[hill == lower] = around[0]
    region = np.zeros(len(height), np.int64)
    kept = [h for h in sorted(top, key=lambda h: -height[top[h]]) if (hill == h).any()][:count]
    for number, h in enumerate(kept, 1):
        region[(hill == h) & (height > SHARE * height[top[h]])] = number
    return region
