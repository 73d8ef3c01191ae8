"""The forces of a membrane and its fluid, and their tangent stiffness, as machine code: many triangles at once.

The formulas repeat those of `hyperelastic` and of `Membrane.volume` for one surface, without gradients. The tensor version has
a few operations over all triangles, but a grid has so few triangles that the calls themselves dominate its time.

Quadrilaterals (cells) have the numbers of their first vertices, `k = i n + j` on a grid of `m` by `n` vertices, so that vectors
of cells run across the ends of lines. Cells behind the end of a line have no area, and their vertices do not move. The first
triangle of a cell has the vertices k, k + n and k + n + 1, the second one k, k + n + 1 and k + 1.
"""

from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from ..machine_code import compiled
from ..surface.membrane import Membrane
from ..vectors import BYTES, load, store
from .hyperelastic import ElasticEnergy

STENCIL = ((-1, -1), (-1, 0), (0, -1), (0, 0), (0, 1), (1, 0), (1, 1))
"""A vertex and its six neighbours, in the order of the vertices: the blocks of `A`. Opposite ones add up to `LAST`."""
OWN, NEXT, BELOW, LAST = 3, 4, 5, 6
SPARE = 16
"""Places behind those of the vertices: a vector reads no further."""
OF_BELOW, OF_NEXT, PULLS, SPINS, TOTALS, CELLS = 0, 9, 18, 27, 33, 39
"""Places in `cells`: blocks of `A` between a cell's last vertex and the one below or next to its first; forces on all vertices
but the first; a sixth of the cross product of edges, for both triangles; forces and gradients of the volume at vertices."""


class Surface(NamedTuple):
    """Constants of a membrane, those of cells at `P` places."""

    rest: Any
    """`[m, n, 3]`"""
    free: Any
    """`[m, n]` bool"""
    load: Any
    """`[m, n, 3]`, the rest load."""
    edges: Any
    """`[3, 2, 2, P]`, at rest: components, the two from the first vertex, triangles."""
    inverse: Any
    """`[3, 2, P]`, of their metric: 11, 12, 22."""
    det: Any
    """`[2, P]`"""
    area: Any
    """`[2, P]`"""
    sixth: Any
    """`[P]`, with the sign of the outward normal."""
    law: Any
    """`[4]`: `c1 l^2, c1 / l^4, c2 / l^2, c2 l^4`, the second zero where the energy is harmonic."""


def places(m: int, n: int) -> int:
    """Return the number of places for what the vertices or cells of a grid have."""
    return -(-m * n // SPARE) * SPARE + SPARE


def surface_of(membrane: Membrane, elasticity: ElasticEnergy, load: Tensor, dtype: np.dtype) -> Surface:
    """Return the constants of a membrane and its material in a precision; `load`: the rest load `[V, 3]`."""
    m, n = membrane.grid
    l2, c1, c2 = (float(value) for value in (elasticity.prestretch**2, elasticity.c1, elasticity.c2))
    law = [c1 * l2, 0.0 if elasticity.model == "harmonic" else c1 / l2**2, c2 / l2, c2 * l2**2]

    def array(values: Tensor, *shape: int) -> np.ndarray:
        return np.ascontiguousarray(values.numpy().reshape(shape), dtype)

    def of_cells(values: Tensor, *shape: int, elsewhere: float | None = None) -> np.ndarray:
        """Return what cells have at their places; there are no others, which get `elsewhere`, or what the last cell has."""
        given = array(values, *shape, m - 1, n - 1)
        placed = np.empty((*shape, places(m, n)), dtype)
        placed[:] = given[..., -1, -1:] if elsewhere is None else elsewhere
        placed[..., : m * n].reshape(*shape, m, n)[..., :-1, :-1] = given
        return placed

    return Surface(
        array(membrane.rest, m, n, 3),
        ~membrane.fixed.numpy().reshape(m, n),
        array(load, m, n, 3),
        of_cells(elasticity.rest_edges, 3, 2, 2),
        of_cells(elasticity.inverse_metric, 3, 2),
        of_cells(elasticity.det, 2),
        of_cells(elasticity.area, 2, elsewhere=0.0),
        of_cells(torch.full((m - 1, n - 1), membrane.outward / 6, dtype=torch.float64, device="cpu"), elsewhere=0.0),
        np.array(law, dtype),
    )


@compiled
def linearise(surface, u, pressure, x, cells, force, A, volume):
    """The contact force, its tangent stiffness and the gradient of the volume, at the inner vertices; the volume.

    `u [m, n, 3]` the displacement, `pressure [1]`; `force [m, n, 3]`, `A [3, 21, P]` (of a component, in the components of the
    stencil's vertices) and `volume [m, n, 3]` are filled at inner vertices; `x [3, P]` and `cells [CELLS, P]` are
    working memory. At vertices that are not free the force is zero, as are all entries of `A` in their rows and columns.
    """
    (m, n), enclosed = surface.free.shape, 0.0
    for i in range(m):
        for j in range(n):
            for c in range(3):
                x[c, i * n + j] = u[i, j, c]
    for k in range(0, (m - 1) * n, BYTES // u.itemsize):
        _work_out(surface, n, k, pressure[0], x, cells, A)
    for i in range(m - 1):
        for j in range(n - 1):
            k = i * n + j
            for c in range(3):
                enclosed += (surface.rest[i, j, c] + u[i, j, c]) * (cells[SPINS + c, k] + cells[SPINS + 3 + c, k])
    _sum_cells(surface, pressure[0], cells, force, volume)
    _complete(surface.free, cells, force, A)
    return enclosed


@compiled
def _work_out(surface, n, k, pressure, x, cells, A):
    """Work out a vector of cells from cell k on: write to `cells`, and to `A` the blocks of the first vertices with others."""
    below, last, beside = _edge(surface, x, 0, 0, k, n), _edge(surface, x, 1, 0, k, n + 1), _edge(surface, x, 1, 1, k, 1)
    pull, pull_last, to_below, to_last, between = _of_energy(surface, 0, k, below, last)
    pull_last_2, pull_beside, to_last_2, to_beside, between_2 = _of_energy(surface, 1, k, last, beside)
    sixth = load(surface.sixth, k)
    across_below, across_last = _times(sixth * pressure, below), _times(sixth * pressure, last)
    across_beside = _times(sixth * pressure, beside)
    P = A.shape[2]
    _write_block(A, 3 * BELOW * P + k, 21 * P, P, _plus_cross(to_below, across_last))
    _write_block(A, 3 * NEXT * P + k, 21 * P, P, _plus_cross(to_beside, _times(-1.0, across_last)))
    of_both = _plus_cross(_plus(to_last, to_last_2), _minus(across_beside, across_below))
    _write_block(A, 3 * LAST * P + k, 21 * P, P, of_both)
    _write_block(cells, OF_BELOW * P + k, 3 * P, P, _plus_cross(between, _times(-1.0, across_below)))
    _write_block(cells, OF_NEXT * P + k, 3 * P, P, _plus_cross(_transposed(between_2), across_beside))
    _write(cells, PULLS * P + k, P, pull)
    _write(cells, (PULLS + 3) * P + k, P, _add(pull_last, pull_last_2))
    _write(cells, (PULLS + 6) * P + k, P, pull_beside)
    _write(cells, SPINS * P + k, P, _times(sixth, _cross(below, last)))
    _write(cells, (SPINS + 3) * P + k, P, _times(sixth, _cross(last, beside)))


@compiled
def _edge(surface, x, edge, t, k, further):
    """The edges of a vector of triangles, as three vectors of components."""
    P = x.shape[1]
    at = (2 * edge + t) * P + k
    e_0 = load(surface.edges, at) + (load(x, k + further) - load(x, k))
    e_1 = load(surface.edges, at + 4 * P) + (load(x, P + k + further) - load(x, P + k))
    e_2 = load(surface.edges, at + 8 * P) + (load(x, 2 * P + k + further) - load(x, 2 * P + k))
    return e_0, e_1, e_2


@compiled
def _of_energy(surface, t, k, a, b):
    """For triangles with the edges a and b to their second and third vertices: the forces on these two, and the second
    derivatives of the energy in the first and second vertex, the first and third, the second and third, in rows of nine.

    The stress `S` makes the force on edge a, `sum_b S_ab b`."""
    P = surface.area.shape[1]
    area, det, i11 = load(surface.area, t * P + k), load(surface.det, t * P + k), load(surface.inverse, t * P + k)
    i12, i22 = load(surface.inverse, (2 + t) * P + k), load(surface.inverse, (4 + t) * P + k)
    g11, g12, g22 = _dot(a, a), _dot(a, b), _dot(b, b)
    I, inverse = i11 * g11 + (i12 * g12 + i12 * g12) + i22 * g22, det / (g11 * g22 - g12 * g12)  # noqa: E741
    linear, thickness, mixed, quadratic = surface.law[0], surface.law[1], surface.law[2], surface.law[3]
    twice, square, four = area + area, inverse * inverse, 4.0 * area
    w_ID = -mixed * square
    w_D = quadratic + (w_ID * I - thickness * square)
    w_DD = 2.0 * (thickness + mixed * I) * square * inverse
    by_I, by_D, w_ID, w_DD = twice * (linear + mixed * inverse), twice / det * w_D, four * w_ID, four * w_DD
    I_a, I_b = _mixed(i11, a, i12, b), _mixed(i12, a, i22, b)  # halves of the derivatives of I and of D in the edges
    D_a, D_b = _mixed(g22 / det, a, -1.0 * g12 / det, b), _mixed(-1.0 * g12 / det, a, g11 / det, b)
    s11, s12, s22 = by_I * i11 + by_D * g22, by_I * i12 - by_D * g12, by_I * i22 + by_D * g11
    ID_a, ID_b, DI_a = _mixed(w_ID, I_a, w_DD, D_a), _mixed(w_ID, I_b, w_DD, D_b), _times(w_ID, D_a)
    of_a, of_b = _times(-1.0 * by_D, a), _times(-1.0 * by_D, b)
    h11 = _on_diagonal(s11, _plus(_plus(_outer(ID_a, D_a), _outer(DI_a, I_a)), _outer(of_b, b)))
    h22 = _on_diagonal(s22, _plus(_plus(_outer(ID_b, D_b), _outer(_times(w_ID, D_b), I_b)), _outer(of_a, a)))
    of_areas = _plus(_outer(of_b, a), _outer(_times(-2.0, of_a), b))
    h12 = _on_diagonal(s12, _plus(_plus(_outer(ID_a, D_b), _outer(DI_a, I_b)), of_areas))
    first_second, first_third = _minus_sum(h11, _transposed(h12)), _minus_sum(h12, h22)
    return _mixed(s11, a, s12, b), _mixed(s12, a, s22, b), first_second, first_third, h12


@compiled
def _sum_cells(surface, pressure, cells, force, volume):
    """Sum the forces and the gradients of the volume that cells have at the inner vertices."""
    (m, n), P = surface.free.shape, cells.shape[1]
    for c in range(3):
        below, last, beside = (PULLS + c) * P, (PULLS + 3 + c) * P, (PULLS + 6 + c) * P
        spin, spin_2 = (SPINS + c) * P, (SPINS + 3 + c) * P
        for k in range(n + 1, m * n - n - 1, BYTES // cells.itemsize):
            others = load(cells, below + k) + load(cells, last + k) + load(cells, beside + k)
            pull = load(cells, below + k - n) + load(cells, last + k - n - 1) + load(cells, beside + k - 1) - others
            first = load(cells, spin + k) + load(cells, spin_2 + k) + load(cells, spin + k - n)
            around = first + load(cells, spin + k - n - 1) + load(cells, spin_2 + k - n - 1) + load(cells, spin_2 + k - 1)
            store(cells, (TOTALS + c) * P + k, pull - pressure * around)
            store(cells, (TOTALS + 3 + c) * P + k, around)
    for i in range(1, m - 1):
        for j in range(1, n - 1):
            for c in range(3):
                force[i, j, c] = cells[TOTALS + c, i * n + j] - surface.load[i, j, c]
                volume[i, j, c] = cells[TOTALS + 3 + c, i * n + j]


@compiled
def _complete(free, cells, force, A):
    """Add the blocks between a cell's other vertices to `A`, fill its entries for earlier vertices by transposition, and the
    diagonal ones as minus the sum of the others; then set the entries of fixed vertices to zero."""
    m, n = free.shape
    first, last = n + 1, m * n - n - 1
    for c in range(3):
        for d in range(3):
            beside, below = A[c, 3 * NEXT + d], A[c, 3 * BELOW + d]
            of_beside, of_below = cells[OF_BELOW + 3 * c + d], cells[OF_NEXT + 3 * c + d]
            for k in range(n, last + n):
                beside[k] += of_beside[k - n]
            for k in range(1, last + n):
                below[k] += of_below[k - 1]
    for c in range(3):
        for d in range(3):
            own = A[c, 3 * OWN + d]
            own[:] = 0
            for s in range(OWN):
                entry, transposed, shift = A[c, 3 * s + d], A[d, 3 * (LAST - s) + c], STENCIL[s][0] * n + STENCIL[s][1]
                other = A[c, 3 * (LAST - s) + d]
                for k in range(first, last):
                    entry[k] = transposed[k + shift]
                    own[k] -= entry[k] + other[k]
    for i in range(m):
        for j in range(n):
            if not (0 < i < m - 1 and 0 < j < n - 1 and free[i, j]):
                A[:, :, i * n + j] = 0
                force[i, j] = 0
            elif not _surrounded(free, i, j):
                for s in range(LAST + 1):
                    if not free[i + STENCIL[s][0], j + STENCIL[s][1]]:
                        A[:, 3 * s : 3 * s + 3, i * n + j] = 0


@compiled
def _surrounded(free, i, j):
    """Whether all vertices around this one are free."""
    for s in range(LAST + 1):
        if not free[i + STENCIL[s][0], j + STENCIL[s][1]]:
            return False
    return True


@compiled
def _dot(a, b):
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@compiled
def _cross(a, b):
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


@compiled
def _times(f, a):
    return f * a[0], f * a[1], f * a[2]


@compiled
def _add(a, b):
    return a[0] + b[0], a[1] + b[1], a[2] + b[2]


@compiled
def _minus(a, b):
    return a[0] - b[0], a[1] - b[1], a[2] - b[2]


@compiled
def _mixed(f, a, g, b):
    """`f a + g b`"""
    return f * a[0] + g * b[0], f * a[1] + g * b[1], f * a[2] + g * b[2]


@compiled
def _outer(a, b):
    a0, a1, a2 = a
    return a0 * b[0], a0 * b[1], a0 * b[2], a1 * b[0], a1 * b[1], a1 * b[2], a2 * b[0], a2 * b[1], a2 * b[2]


@compiled
def _plus(A, B):
    a0, a1, a2, a3, a4, a5, a6, a7, a8 = A
    return a0 + B[0], a1 + B[1], a2 + B[2], a3 + B[3], a4 + B[4], a5 + B[5], a6 + B[6], a7 + B[7], a8 + B[8]


@compiled
def _minus_sum(A, B):
    """`-A - B`"""
    a0, a1, a2, a3, a4, a5, a6, a7, a8 = _plus(A, B)
    return -1.0 * a0, -1.0 * a1, -1.0 * a2, -1.0 * a3, -1.0 * a4, -1.0 * a5, -1.0 * a6, -1.0 * a7, -1.0 * a8


@compiled
def _transposed(A):
    return A[0], A[3], A[6], A[1], A[4], A[7], A[2], A[5], A[8]


@compiled
def _on_diagonal(f, A):
    """`f 1 + A`"""
    return A[0] + f, A[1], A[2], A[3], A[4] + f, A[5], A[6], A[7], A[8] + f


@compiled
def _plus_cross(A, b):
    """`A` and the matrix of the cross product with b"""
    return A[0], A[1] - b[2], A[2] + b[1], A[3] + b[2], A[4], A[5] - b[0], A[6] - b[1], A[7] + b[0], A[8]


@compiled
def _write(array, at, stride, a):
    store(array, at, a[0])
    store(array, at + stride, a[1])
    store(array, at + 2 * stride, a[2])


@compiled
def _write_block(array, at, by_row, stride, A):
    _write(array, at, stride, (A[0], A[1], A[2]))
    _write(array, at + by_row, stride, (A[3], A[4], A[5]))
    _write(array, at + 2 * by_row, stride, (A[6], A[7], A[8]))
