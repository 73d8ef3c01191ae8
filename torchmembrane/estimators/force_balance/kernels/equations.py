"""The equations of one force-balance step for one frame, as machine code: weights, loads and matrix.

The formulas repeat those of `contact_force`, `traction_loss`, `marker_residuals` and `normal_equations`, where they are
explained; a test compares the numbers. Vertices are numbered `k = i n + j` on the whole grid, except in arrays of length `N`,
which have the inner vertices only.
"""

from typing import Any, NamedTuple

import numpy as np

from ....machine_code import aligned, compiled
from ....mechanics.native_membrane import CELLS, STENCIL, Surface, places
from ....solve.band import RIDGES
from ....solve.native_envelope import COLUMNS, first_column, matrix
from ....solve.native_rows import sum_rows
from ....solve.stencil_layouts import OFFSETS
from ....vectors import BYTES, load, store
from ..robust import geman_mcclure_curvature, geman_mcclure_weight
from ..traction_loss import LEAST_SCALE, POWER, TINY
from .layout import Layout, layout_of

curvature_of_push, weight_of_push = compiled(geman_mcclure_curvature), compiled(geman_mcclure_weight)
BETWEEN = tuple(tuple(OFFSETS.index((b[0] - a[0], b[1] - a[1])) if b >= a else -1 for b in STENCIL) for a in STENCIL)
"""Of two vertices of a stencil, the offset from one to a later one."""
VOLUME, FORCES, FLUID, CAMERA, WANTED = 0, 1, 2, 3, 7
"""Loads: of the volume, the forces, the fluid, the camera's four motions, and in `spread` of four wanted numbers."""
LOADS = WANTED + 4
NOTHING = 1e-18
"""Of a vertex in a mean that does not count below `(far_share / scale_share)^(2 POWER)`, some 1e-5."""


class Constants(NamedTuple):
    """Constants of an estimator on one grid."""

    surface: Surface
    area: Any
    """`[N]`, of the inner vertices."""
    surroundings: Any
    """`[N, N]`, column k the mean around vertex k; as `wider`."""
    surroundings_within: Any
    """`[N, 2]`: where row i begins and ends to be more than zero."""
    wider: Any
    wider_within: Any
    push_noise: Any
    """`[N]`"""
    inwards: Any
    """`[N, 3]`, at rest."""
    positions: Any
    """`[D, 3]`, of the markers at rest."""
    smooth: tuple[Any, Any]
    """Numbers of inner vertices and their shares in the markers' displacement, `[D, K]` each."""
    corners: tuple[Any, Any]
    """The same in what markers pull, `[D, 3]`."""
    nearest: Any
    """`[D, K]`, the markers next to each."""
    numbers: "Numbers"


class Numbers(NamedTuple):
    """Settings and other scalars of an estimator."""

    reference: float
    size: float
    shear: float
    slip: float
    cone: float
    sparsity: float
    floor: float
    last_tau: float
    first_tau: float
    scale_share: float
    far_share: float
    noise_share: float
    camera_motion: float
    settled_step_tol: float
    largest_stretch: float
    contact_noise: float
    outlier: float
    rest_pressure: float
    rest_volume: float
    is_open: bool
    is_gas: bool
    absolute: float
    gas_volume: float


class Workspace(NamedTuple):
    """Arrays of one step. They are allocated once, because allocating them takes longer than filling them."""

    force: Any
    """`[m, n, 3]`; as `volume`, the volume's gradient."""
    volume: Any
    A: Any
    """`[3, 21, P]`, the tangent stiffness, at the `places` of the vertices; as `weighted`."""
    x: Any
    """`[3, P]`, and `cells [CELLS, P]`, the working memory of `linearise`."""
    cells: Any
    weighted: Any
    W: Any
    """`[3, 3, P]`"""
    of_loads: Any
    """`[3, 2, P]`, forces and the fluid's, weighted."""
    sums: Any
    """`[90, P]`, blocks of the matrix."""
    normal: Any
    """`[N, 3]`"""
    fields: Any
    """`[5, N]`"""
    blocks: Any
    """`[D, 3, 3]`, of the markers; their bearing Jacobians, weighted, `jacobians [D, 2, 3]`, and `marker_weights [D]`."""
    jacobians: Any
    marker_weights: Any
    U: Any
    """The matrix as `native_envelope` stores it, and `inverse [3 N]` and its `scale [3 N]`. Unknowns are in the order of their
    elimination in these, in `y` and in `half_solved [3 N]`; elsewhere they are in that of the vertices."""
    inverse: Any
    scale: Any
    loads: Any
    """`[11, 3 N]`"""
    y: Any
    """`[3 N x COLUMNS]`, the loads `b`, and then `U^-T b`."""
    half_solved: Any
    solved: Any
    """`[3 N]`, the solution for a sum of the loads; `move [3 N]`, the negative step."""
    move: Any
    ridges: Any
    """`band.RIDGES`: a loop over an array is compiled once, over a tuple once for each of its numbers."""
    layout: Layout


def workspace(grid: tuple[int, int], markers: int, dtype: Any) -> Workspace:
    """Return the arrays for a grid and a number of markers."""
    m, n = grid
    N, P = (m - 2) * (n - 2), places(m, n)
    layout = layout_of(m - 2, n - 2)
    size = len(layout.places.begins)
    shapes = dict(force=(m, n, 3), volume=(m, n, 3), A=(3, 21, P), x=(3, P), cells=(CELLS, P), W=(3, 3, P))
    shapes |= dict(weighted=(3, 21, P), of_loads=(3, 2, P))
    shapes |= dict(sums=(90, P), normal=(N, 3), fields=(5, N), blocks=(markers, 3, 3), jacobians=(markers, 2, 3))
    shapes |= dict(marker_weights=(markers,), inverse=(size,), scale=(size,), loads=(LOADS, size))
    shapes |= dict(half_solved=(size,), solved=(size,), move=(size,))
    arrays = {name: np.zeros(shape, dtype) for name, shape in shapes.items()}
    arrays |= dict(U=matrix(layout.places, dtype), y=aligned(size * COLUMNS, dtype), ridges=np.array(RIDGES, dtype))
    return Workspace(layout=layout, **arrays)


@compiled
def scaled(c, work, noise_level, tau):
    """Apply `TractionLoss.parts` and `scale2`: fill `work.fields` with the normal part and the squared shear of the tractions
    relative to the reference, `S^2` and `rho^2`, and `work.normal` with the normals."""
    k, N, n = c.numbers, len(c.area), c.surface.free.shape[1]
    q_n, shear2, push2, around, shares = work.fields
    for i in range(N):
        p, q = i // (n - 2) + 1, i % (n - 2) + 1
        square, along, across2 = work.volume[p, q, 0] ** 2 + work.volume[p, q, 1] ** 2 + work.volume[p, q, 2] ** 2, 0.0, 0.0
        inverse = 1 / np.sqrt(square)
        for a in range(3):
            work.normal[i, a] = work.volume[p, q, a] * inverse
            along += work.force[p, q, a] * work.normal[i, a]
        for a in range(3):
            across2 += (work.force[p, q, a] - along * work.normal[i, a]) ** 2
        unit = 1 / (c.area[i] * k.reference)
        q_n[i], shear2[i] = along * unit, across2 * unit**2
        shares[i] = 0.0 if q_n[i] >= 0 else q_n[i] ** 2
    sum_rows(push2, c.surroundings, c.surroundings_within, shares)
    top = TINY
    for i in range(N):
        top = max(top, push2[i])
    for i in range(N):
        share = (push2[i] / top) ** POWER
        shares[i] = 0.0 if share < NOTHING else share
    sum_rows(around, c.wider, c.wider_within, shares)
    least = min(max(tau / k.last_tau - 1, LEAST_SCALE), 1.0) ** 2
    for i in range(N):
        expected = top * np.sqrt(np.sqrt(max(around[i], TINY))) * k.scale_share**2  # the root of POWER 4
        expected = max(expected, top * k.far_share**2, (k.noise_share * noise_level * c.push_noise[i]) ** 2)
        around[i] = min(max(expected / k.last_tau**2, least), 1.0)


@compiled
def weigh(c, work, noise_level, tau, curvature):
    """Apply `TractionLoss.weights`: compute `W`; `curvature`: use the curvature of a push's loss in place of its weight."""
    k, n = c.numbers, c.surface.free.shape[1]
    scaled(c, work, noise_level, tau)
    for i in range(len(c.area)):
        q_n, shear2, rho2 = work.fields[0, i], work.fields[1, i], work.fields[3, i]
        at = (i // (n - 2) + 1) * n + i % (n - 2) + 1
        pushed = work.fields[2, i] / rho2
        ratio = pushed / tau**2
        of_push = max(curvature_of_push(ratio), 0.0) if curvature else weight_of_push(ratio)
        w_n = k.floor + (of_push if q_n < 0 else 1.0)
        w_t = weight_of_shear(k, pushed) / np.sqrt(shear2 / rho2 + k.slip**2)
        scale = k.sparsity / (k.reference * k.size) ** 2 / c.area[i] / rho2
        for a in range(3):
            for b in range(3):
                work.W[a, b, at] = scale * (w_n - w_t) * work.normal[i, a] * work.normal[i, b]
            work.W[a, a, at] += scale * w_t


@compiled
def weight_of_shear(k, push2):
    """Return `TractionLoss.shear_weight`."""
    return k.shear / (1 + k.cone * np.sqrt(push2 + k.slip**4))


@compiled
def load_forces(c, work):
    """Add the forces to the loads as `BalanceEquations.loads` does; return `f W v` and `v W v`."""
    m, n = c.surface.free.shape
    loads, of_loads, vWv = work.loads, work.of_loads, 0.0
    loads[:], of_loads[:] = 0, 0
    for i in range(1, m - 1):
        for j in range(1, n - 1):
            if c.surface.free[i, j]:
                k, at = (i - 1) * (n - 2) + j - 1, i * n + j
                for a in range(3):
                    for b in range(3):
                        of_loads[a, 1, at] -= work.W[a, b, at] * work.volume[i, j, b]
                    vWv -= of_loads[a, 1, at] * work.volume[i, j, a]
                    loads[VOLUME, 3 * k + a] = work.volume[i, j, a]
    fWv = load_weighted_forces(c, work)
    for k in range((m - 2) * (n - 2)):
        for d in range(3):
            loads[FLUID, 3 * k + d] = work.sums[3 + d, (k // (n - 2) + 1) * n + k % (n - 2) + 1]
    return fWv, vWv


@compiled
def load_weighted_forces(c, work):
    """Write `A^T W f` of the forces to their load; return `f W v`."""
    (m, n), of_loads, fWv = c.surface.free.shape, work.of_loads, 0.0
    for k in range((m - 2) * (n - 2)):
        i, j = k // (n - 2) + 1, k % (n - 2) + 1
        at = i * n + j
        for a in range(3):
            of_loads[a, 0, at] = 0
            for b in range(3 if c.surface.free[i, j] else 0):
                of_loads[a, 0, at] += work.W[a, b, at] * work.force[i, j, b]
            fWv += of_loads[a, 0, at] * work.volume[i, j, a]
    stiffness_change(work, m, n)
    for k in range((m - 2) * (n - 2)):
        for d in range(3):
            work.loads[FORCES, 3 * k + d] = work.sums[d, (k // (n - 2) + 1) * n + k % (n - 2) + 1]
    return fWv


@compiled
def stiffness_change(work, m, n):
    """Write the products of the symmetric stiffness `A` with both fields `of_loads` to the first six rows of `sums`."""
    A, sums, of_loads, P = work.A, work.sums, work.of_loads, work.A.shape[2]
    for k in range(n + 1, m * n - n - 1, BYTES // A.itemsize):
        for d in range(3):
            of_first = of_second = load(A, k) * 0.0
            for s in range(7):
                at = k - STENCIL[s][0] * n - STENCIL[s][1]
                a0, a1, a2 = _three(A, (3 * s + d) * P + at, 21 * P)
                b0, b1, b2 = _three(of_loads, at, 2 * P)
                c0, c1, c2 = _three(of_loads, P + at, 2 * P)
                of_first = of_first + (a0 * b0 + a1 * b1 + a2 * b2)
                of_second = of_second + (a0 * c0 + a1 * c1 + a2 * c2)
            store(sums, d * P + k, of_first)
            store(sums, (3 + d) * P + k, of_second)


@compiled
def _three(array, at, stride):
    """Return three vectors of an array."""
    return load(array, at), load(array, at + stride), load(array, at + 2 * stride)


@compiled
def sum_blocks(c, work):
    """Sum `A^T W A` and the markers' blocks in `sums [10 3 3, P]`: the blocks between the vertices and those at `OFFSETS`."""
    (m, n), (corners, pulls) = c.surface.free.shape, c.corners
    V, P, sums, A, WA, W = m * n, work.A.shape[2], work.sums, work.A, work.weighted, work.W
    sums[:] = 0
    for k in range(0, V, BYTES // A.itemsize):
        for t in range(21):
            a0, a1, a2 = _three(A, t * P + k, 21 * P)
            for a in range(3):
                w0, w1, w2 = _three(W, 3 * a * P + k, P)
                store(WA, (21 * a + t) * P + k, w0 * a0 + w1 * a1 + w2 * a2)
    for k in range(n + 1, V - n - 1, BYTES // A.itemsize):
        for s in range(7):
            at = k - STENCIL[s][0] * n - STENCIL[s][1]
            own = 3 * s * P + at
            of_s = _three(A, own, 21 * P), _three(A, own + P, 21 * P), _three(A, own + 2 * P, 21 * P)
            for other in range(s, 7):
                for b in range(3):
                    b0, b1, b2 = _three(WA, (3 * other + b) * P + at, 21 * P)
                    block = (9 * BETWEEN[s][other] + b) * P + k
                    for a in range(3):
                        a0, a1, a2 = of_s[a]
                        store(sums, block + 3 * a * P, load(sums, block + 3 * a * P) + a0 * b0 + a1 * b1 + a2 * b2)
    for d in range(len(work.blocks)):
        for s in range(3):
            for other in range(3):
                share, k, further = pulls[d, s] * pulls[d, other], corners[d, s], corners[d, other] - corners[d, s]
                if share != 0 and further >= 0:
                    block = 9 * (further if further < 2 else further - (n - 2) + 2)
                    at = (k // (n - 2) + 1) * n + k % (n - 2) + 1
                    for a in range(3):
                        for b in range(3):
                            sums[block + 3 * a + b, at] += share * work.blocks[d, a, b]


@compiled
def scale_rows(c, work, damping):
    """Compute the `scale` that makes the matrix's diagonal 1."""
    n, sums, scale, order = c.surface.free.shape[1], work.sums, work.scale, work.layout.order
    scale[:] = 1
    for k in range(len(order)):
        at = (order[k] // (n - 2) + 1) * n + order[k] % (n - 2) + 1
        for a in range(3):
            if sums[4 * a, at] > 0:
                scale[3 * k + a] = 1 / np.sqrt(sums[4 * a, at] * (1 + damping))


@compiled
def write_vertices(work, first, end, ridge, used):
    """Write the rows of the vertices from `first` up to `end`, in the order of elimination: those of the matrix of the blocks
    to `U`, and those of the first `used` loads to `y`. They are scaled by `scale`, and the ridge is added to the diagonal. The
    rows behind those of the last vertex are zero but on the diagonal."""
    U, sums, scale, layout, y = work.U, work.sums, work.scale, work.layout, work.y
    N, begins, ends = len(layout.order), layout.places.begins, layout.places.ends
    for k in range(first, end):
        row = 3 * k
        for r in range(row, min(row + 3, len(scale))):
            U[begins[r] + first_column(r) : begins[r] + ends[r]] = 0
            y[r * COLUMNS : (r + 1) * COLUMNS] = 0
        for block in range(layout.columns.shape[1] if k < N else 0):
            column, at, source = layout.columns[k, block], layout.owners[k, block], 9 * layout.sources[k, block]
            by_row, by_column = (1, 3) if layout.is_turned[k, block] else (3, 1)
            for a in range(3 if column >= 0 else 0):
                start = begins[row + a] + column
                for b in range(a if column == row else 0, 3):  # what lies before the diagonal has no room
                    U[start + b] = sums[source + by_row * a + by_column * b, at] * scale[row + a] * scale[column + b]
        for r in range(row, min(row + 3, len(scale))):
            U[begins[r] + r] = 1 + ridge
            for of_load in range(used if k < N else 0):
                y[r * COLUMNS + of_load] = work.loads[of_load, 3 * layout.order[k] + r - row] * scale[r]
