"""Residuals of markers that stand off the surface: the angles of their tips, which turn with the surface under them.

A tip `x + h n` follows three fields of the surface's displacement: the displacement itself and its derivatives along the grid's
two directions, which turn the tangents. With the dual basis `a*, b*` of these and the Jacobian `J` of the angles in a place

    dr = J dx - h (J a*) (n . da) - h (J b*) (n . db),

so each marker has three Jacobians, `J`, `-h (J a*) n^T` and `-h (J b*) n^T`, one after the other on an axis of `3 D`. In the
residuals both derivatives are of the bicubic displacement. In the equations they are of the quadratic that the seven vertices
around the nearest one determine: of these, no two are farther apart than two vertices of a force's stencil, so that the matrix
stays as sparse as it is without levers.
"""

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from ...solve.stencil import STENCIL
from ...solve.stencil_layouts import OFFSETS, Inner
from ...solve.stencil_system import PAIRS
from ...surface.bicubic import grid_coordinates, triangle_slopes
from ...surface.levers import Levers
from ...surface.membrane import Membrane
from ...surface.projection import SurfacePoints
from ..base import Observation
from .marker_residuals import MarkerResiduals, MeasuredRays

FIELDS = 3
"""Number of fields that a tip follows: displacement, and its two derivatives."""
QUADRATIC = 0.5 * np.array(
    [
        [[0, 1, 0, 0, -1, 0, 0], [-4, 2, 0, 0, 2, 0, 0], [2, -1, 1, -1, -1, 1, -1]],
        [[0, 0, 0, 1, 0, 0, -1], [2, -1, 1, -1, -1, 1, -1], [-4, 0, 0, 2, 0, 0, 2]],
    ]
)
"""`[2, 3, 7]`: from a field at the vertices of `STENCIL` its two derivatives, and theirs in both directions."""


class LeverResiduals(MarkerResiduals):
    """The tips of markers that stand off a surface, and how they are seen off their measured rays.

    Args:
        membrane: the rest surface on the solver's grid.
        markers: the markers' feet as points of it.
        positions: `[D, 3]` their rest positions.
        noise: as of `MarkerResiduals`.
        rest: the tips' rays at rest; None: from the origin, with that noise.
        views: as of `MarkerResiduals`.
        levers: `[D, 3]`, from feet to tips at rest.
    """

    tips_at_rest: Tensor
    ring_shares: Tensor
    sources: Tensor
    first: Tensor
    second: Tensor

    def __init__(
        self,
        membrane: Membrane,
        markers: SurfacePoints,
        positions: Tensor,
        noise: float,
        rest: Observation | None,
        views: int,
        levers: Tensor,
    ):
        super().__init__(membrane, markers, positions, noise, rest, views)
        self.levers = Levers(membrane, markers, levers)
        self.register_buffer("tips_at_rest", self.positions + levers.double())
        del self.pair_shares
        vertices, shares = _ring_shares(membrane, markers)
        self.register_buffer("ring_shares", torch.from_numpy(shares))
        whole = torch.zeros(FIELDS, len(vertices), self.vertex_shares.shape[1] + 1, dtype=torch.float64)
        index = torch.from_numpy(vertices).expand(FIELDS, -1, -1)
        whole.scatter_add_(2, torch.where(index < 0, whole.shape[2] - 1, index), self.ring_shares)
        self.register_buffer("vertex_shares", whole[:, :, :-1].flatten(0, 1).contiguous())
        self.register_buffer("sources", torch.from_numpy(_sources(vertices, self.vertex_shares.shape[1])))
        for name, slots in zip(("first", "second"), np.array(PAIRS).T, strict=True):
            self.register_buffer(name, torch.from_numpy(slots.astype(np.int32)))

    @property
    def in_machine_code(self) -> bool:
        """No step is."""
        return False

    @property
    def seen_at_rest(self) -> Tensor:
        """The tips at rest, `[D, 3]`."""
        return self.tips_at_rest

    def angles(self, u: Tensor, measured: MeasuredRays, moved: Tensor) -> tuple[Tensor, Tensor]:
        """Angles of the tips across the measured rays, `[B, 2, D]`, and their Jacobians `[B, 2, 3, 3 D]`."""
        levers, normal, dual = self.levers(u)
        angle, jacobian = self._seen(self.markers(u) + levers, measured, moved)
        lengths = -self.levers.heights * (jacobian[:, :, None] * dual.mT[:, None]).sum(3)  # [B, 2, 2, D]
        of_slopes = lengths[:, :, :, None] * normal.mT[:, None, None]
        return angle, torch.cat([jacobian, *of_slopes.unbind(2)], -1)

    def repeated(self, values: Tensor) -> Tensor:
        """Values `[..., D]` of the markers for each of the three fields, `[..., 3 D]`."""
        return torch.cat([values] * FIELDS, -1)

    def joined(self, values: Tensor) -> Tensor:
        """The sum `[..., D]` over the three fields."""
        joined: Tensor = values.unflatten(-1, (FIELDS, -1)).sum(-2)
        return joined

    def blocks(self, jacobian: Tensor, weighted: Tensor) -> Tensor:
        """The markers' blocks `[B, 3, 3, 28 D]` between the pairs of the seven vertices around each."""
        here, there = (
            (each.unflatten(-1, (FIELDS, -1))[..., None] * self.ring_shares).sum(3).index_select(4, slots)
            for each, slots in ((jacobian, self.first), (weighted, self.second))
        )
        blocks: Tensor = (here[:, :, :, None] * there[:, :, None]).sum(1).flatten(3)
        return blocks

    def near(self, blocks: Tensor) -> Tensor:
        """As of `MarkerResiduals`, at all `OFFSETS`."""
        zero = torch.zeros_like(blocks[..., :1])
        each = torch.cat([blocks, zero], -1).index_select(3, self.sources.flatten())
        near: Tensor = each.unflatten(3, self.sources.shape).sum(-1).unflatten(3, (len(OFFSETS), -1))
        return near

    def diagonal(self, blocks: Tensor) -> Tensor:
        """As of `MarkerResiduals`."""
        return self.near(blocks)[:, :, :, 0].diagonal(dim1=1, dim2=2).mT

    def product(self, blocks: Tensor, u: Tensor) -> Tensor:
        """As of `MarkerResiduals`: by the blocks at the `OFFSETS`, and by their transposes the other way."""
        grid = self.grid[0] - 2, self.grid[1] - 2
        near, field, parts = self.near(blocks).unflatten(-1, grid), u.unflatten(-1, grid), []
        for k, (i, j) in enumerate(OFFSETS):
            here, there = _overlap(i, j, *grid)
            block = near[:, None, :, :, k, *here]
            parts.append(_placed((block * field[:, :, None, :, *there]).sum(3), here, grid))
            if (i, j) != (0, 0):
                parts.append(_placed((block * field[:, :, :, None, *here]).sum(2), there, grid))
        return torch.stack(parts).sum(0).flatten(-2)

    def loads_alone(self, turned: Tensor, weighted: Tensor) -> Tensor:
        """As of `MarkerResiduals`."""
        weighted, shares = (each.unflatten(axis, (FIELDS, -1)) for each, axis in ((weighted, -1), (self.vertex_shares, 0)))
        return torch.einsum("bdra,bacpd,pdn->bdrcn", turned, weighted, shares)


def residuals_of(
    membrane: Membrane,
    markers: SurfacePoints,
    positions: Tensor,
    noise: float,
    rest: Observation | None,
    views: int,
    levers: Tensor | None,
) -> MarkerResiduals:
    """The residuals of markers on a surface, or of tips where there are `levers`; arguments as of `LeverResiduals`."""
    given = membrane, markers, positions, noise, rest, views
    return MarkerResiduals(*given) if levers is None else LeverResiduals(*given, levers)


def _ring_shares(membrane: Membrane, markers: SurfacePoints) -> tuple[np.ndarray, np.ndarray]:
    """The inner vertices `[D, 7]` of the stencil around the one nearest to each marker, -1 beside them, and their shares in the
    three fields, `[3, D, 7]`; where one of them is fixed a field may have a kink, and is linear in the marker's triangle."""
    m, n = membrane.grid
    corners = np.stack(np.divmod(markers.vertices, n), -1)
    is_inner = ((corners > 0) & (corners < [m - 1, n - 1])).all(-1)
    nearest = np.where(is_inner, markers.weights, -1.0).argmax(1)
    centre = corners[np.arange(len(corners)), nearest].clip(1, [m - 2, n - 2])
    ring = centre[:, None] + STENCIL
    vertices = Inner.from_size((m - 2, n - 2)).at(*(ring - 1).T).T
    is_corner = (ring[:, :, None] == corners[:, None]).all(-1)
    values = (is_corner * markers.weights[:, None]).sum(-1)
    flat = (is_corner * triangle_slopes(markers, membrane.grid)[:, :, None]).sum(-1)
    off = grid_coordinates(markers, membrane.grid) - centre
    smooth = np.einsum("kps,dp->kds", QUADRATIC, np.concatenate([np.ones_like(off[:, :1]), off], 1))
    fixed = membrane.fixed.numpy().reshape(m, n)[ring[..., 0], ring[..., 1]]
    slopes = np.where((fixed & (vertices >= 0)).any(1)[:, None], flat, smooth)
    return vertices, np.concatenate([values[None], slopes]) * ~fixed


def _sources(vertices: np.ndarray, count: int) -> np.ndarray:
    """Of the blocks between `count` vertices and those at the `OFFSETS`, the pairs `[10 N, K]` among the `28 D` of the markers'
    `vertices [D, 7]` that add to each, then `28 D`, which stands for none."""
    pairs = np.array(PAIRS)
    offsets = [OFFSETS.index((STENCIL[b][0] - STENCIL[a][0], STENCIL[b][1] - STENCIL[a][1])) for a, b in PAIRS]
    here, there = (vertices[:, slots].ravel() for slots in pairs.T)
    pair = np.flatnonzero((here >= 0) & (there >= 0))
    target = (np.tile(offsets, len(vertices)) * count + here)[pair]
    order = target.argsort(kind="stable")
    target, pair = target[order], pair[order]
    rank = np.arange(len(target)) - np.searchsorted(target, target)
    sources = np.full((len(OFFSETS) * count, int(rank.max(initial=0)) + 1), len(here))
    sources[target, rank] = pair
    return sources.astype(np.int32)


def _overlap(i: int, j: int, m: int, n: int) -> tuple[tuple[slice, slice], tuple[slice, slice]]:
    """Rows and columns of a grid's vertices that have one at the offset `i, j` from them, and of these."""
    here = slice(max(0, -i), m - max(0, i)), slice(max(0, -j), n - max(0, j))
    return here, (slice(here[0].start + i, here[0].stop + i), slice(here[1].start + j, here[1].stop + j))


def _placed(part: Tensor, at: tuple[slice, slice], grid: tuple[int, int]) -> Tensor:
    """Fields of a grid that are zero but `at` some of its rows and columns."""
    rows, columns = at
    return F.pad(part, (columns.start, grid[1] - columns.stop, rows.start, grid[0] - rows.stop))
