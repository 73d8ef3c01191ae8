"""Residuals of markers at a distance from the surface: the angles of their tips, which turn with the surface under them.

A tip `x + h n` depends on three fields: the displacement of the surface, and its derivatives along the grid's two directions,
which turn the tangents. With the dual basis `a*, b*` of the tangents and the Jacobian `J` of the angles with respect to the
position of the tip, the angles change by

    dr = J dx - h (J a*) (n . da) - h (J b*) (n . db),

so each marker has three Jacobians, `J`, `-h (J a*) n^T` and `-h (J b*) n^T`, concatenated on an axis of length `3 D`. The
residuals use the derivatives of the bicubic displacement. The equations use those of the quadratic through the stencil of seven
vertices around the nearest one. No two of them are farther apart than the vertices of a force's stencil, so the matrix is as
sparse as without levers.
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
"""Number of fields that a tip depends on: the displacement and its two derivatives."""
QUADRATIC = 0.5 * np.array(
    [
        [[0, 1, 0, 0, -1, 0, 0], [-4, 2, 0, 0, 2, 0, 0], [2, -1, 1, -1, -1, 1, -1]],
        [[0, 0, 0, 1, 0, 0, -1], [2, -1, 1, -1, -1, 1, -1], [-4, 0, 0, 2, 0, 0, 2]],
    ]
)
"""Weights `[2, 3, 7]` of a field at the vertices of `STENCIL`. First axis: its derivative along each grid direction. Second
axis: the value of this derivative at the centre, and its own two derivatives."""


class LeverResiduals(MarkerResiduals):
    """Angles between the tips of markers and their measured rays, with their derivatives.

    Args:
        membrane: the rest surface on the solver's grid.
        markers: the markers' feet as points on the rest surface.
        positions: rest positions of the feet, `[D, 3]`.
        noise: as for `MarkerResiduals`.
        rest: the tips' rays at rest; None: rays from the origin, with `noise`.
        views: as for `MarkerResiduals`.
        levers: vectors from feet to tips at rest, `[D, 3]`.
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
        """Whether machine code can take the steps: never."""
        return False

    @property
    def seen_at_rest(self) -> Tensor:
        """Positions of the tips at rest, `[D, 3]`."""
        return self.tips_at_rest

    def angles(self, u: Tensor, measured: MeasuredRays, moved: Tensor) -> tuple[Tensor, Tensor]:
        """Return the angles between tips and measured rays, `[B, 2, D]`, and their Jacobians `[B, 2, 3, 3 D]`."""
        levers, normal, dual = self.levers(u)
        angle, jacobian = self._seen(self.markers(u) + levers, measured, moved)
        lengths = -self.levers.heights * (jacobian[:, :, None] * dual.mT[:, None]).sum(3)  # [B, 2, 2, D]
        of_slopes = lengths[:, :, :, None] * normal.mT[:, None, None]
        return angle, torch.cat([jacobian, *of_slopes.unbind(2)], -1)

    def repeated(self, values: Tensor) -> Tensor:
        """Repeat values `[..., D]` of the markers for each of the three fields, `[..., 3 D]`."""
        return torch.cat([values] * FIELDS, -1)

    def joined(self, values: Tensor) -> Tensor:
        """Sum values over the three fields, `[..., D]`."""
        joined: Tensor = values.unflatten(-1, (FIELDS, -1)).sum(-2)
        return joined

    def blocks(self, jacobian: Tensor, weighted: Tensor) -> Tensor:
        """Return the markers' blocks `[B, 3, 3, 28 D]` for the 28 pairs of the seven vertices around each."""
        here, there = (
            (each.unflatten(-1, (FIELDS, -1))[..., None] * self.ring_shares).sum(3).index_select(4, slots)
            for each, slots in ((jacobian, self.first), (weighted, self.second))
        )
        blocks: Tensor = (here[:, :, :, None] * there[:, :, None]).sum(1).flatten(3)
        return blocks

    def near(self, blocks: Tensor) -> Tensor:
        """Return the blocks between the inner vertices and their neighbours at all `OFFSETS`, `[B, 3, 3, 10, N]`."""
        zero = torch.zeros_like(blocks[..., :1])
        each = torch.cat([blocks, zero], -1).index_select(3, self.sources.flatten())
        near: Tensor = each.unflatten(3, self.sources.shape).sum(-1).unflatten(3, (len(OFFSETS), -1))
        return near

    def product(self, blocks: Tensor, u: Tensor) -> Tensor:
        """Return the products of `J^T w J` with fields `u [B, C, 3, N]`, from the blocks at `OFFSETS` and their transposes."""
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
        """Return the loads `J^T w e [B, D, 2, 3, N]` of every single marker, as `MarkerResiduals.loads_alone` does."""
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
    """Return the residuals of markers on a surface, or of tips if `levers` are given; arguments as for `LeverResiduals`."""
    given = membrane, markers, positions, noise, rest, views
    return MarkerResiduals(*given) if levers is None else LeverResiduals(*given, levers)


def _ring_shares(membrane: Membrane, markers: SurfacePoints) -> tuple[np.ndarray, np.ndarray]:
    """Return the vertices of the stencil around the inner vertex nearest to each marker, and their weights in the three fields.

    If an inner vertex of the stencil is fixed, a field may have a kink there, so it is linear in the marker's triangle.

    Returns:
        Indices of the inner vertices, -1 for others, `[D, 7]`, and weights `[3, D, 7]`.
    """
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
    """Return, for the block between each of `count` vertices and its neighbour at each of `OFFSETS`, the contributing pairs.

    They are indices `[10 N, K]` of the `28 D` vertex pairs of the markers' stencils `vertices [D, 7]`, padded with `28 D`.
    """
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
    """Return rows and columns of the vertices that have a neighbour at the offset `i, j`, and those of the neighbours."""
    here = slice(max(0, -i), m - max(0, i)), slice(max(0, -j), n - max(0, j))
    return here, (slice(here[0].start + i, here[0].stop + i), slice(here[1].start + j, here[1].stop + j))


def _placed(part: Tensor, at: tuple[slice, slice], grid: tuple[int, int]) -> Tensor:
    """Pad a part of a grid's field, `at` some rows and columns, with zeros to the whole grid."""
    rows, columns = at
    return F.pad(part, (columns.start, grid[1] - columns.stop, rows.start, grid[0] - rows.stop))
