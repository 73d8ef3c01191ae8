"""The forces of a membrane and its fluid, and their tangent stiffness, triangle by triangle, as machine code.

The formulas repeat those of `hyperelastic` and of `Membrane.volume` for one surface, without gradients. The tensor version has
a few operations over all triangles, but a grid has so few triangles that the calls themselves dominate its time.
"""

from typing import Any, NamedTuple

import numpy as np
from torch import Tensor

from ..machine_code import compiled
from ..surface.membrane import Membrane
from .hyperelastic import ElasticEnergy

STENCIL = ((-1, -1), (-1, 0), (0, -1), (0, 0), (0, 1), (1, 0), (1, 1))
"""A vertex and its six neighbours, in the order of the vertices: the blocks of `A`. Opposite ones add up to `LAST`."""
OWN, LAST = 3, 6
TRIANGLES = (((1, 0), (1, 1)), ((1, 1), (0, 1)))
"""Of a quadrilateral: where their second and third vertices are from the first."""
PAIRS = ((5, 6, 4), (6, 4, 5))
"""Of their vertices 1 and 2, 1 and 3, 2 and 3 (in the second 3 and 2): the later one in the stencil of the other."""


class Surface(NamedTuple):
    """Constants of a membrane."""

    rest: Any
    """`[m, n, 3]`"""
    free: Any
    """`[m, n]` bool"""
    load: Any
    """`[m, n, 3]`, the rest load."""
    edges: Any
    """`[3, 2, 2, m-1, n-1]`, at rest: components, the two from the first vertex, triangles."""
    inverse: Any
    """`[3, 2, m-1, n-1]`, of their metric: 11, 12, 22."""
    det: Any
    """`[2, m-1, n-1]`"""
    area: Any
    """`[2, m-1, n-1]`"""
    law: Any
    """`[5]`: `c1 l^2, c1 / l^4, c2 / l^2, c2 l^4`, the second zero where the energy is harmonic; a sixth, the outward sign."""


def surface_of(membrane: Membrane, elasticity: ElasticEnergy, load: Tensor, dtype: np.dtype) -> Surface:
    """Return the constants of a membrane and its material in a precision; `load`: the rest load `[V, 3]`."""
    m, n = membrane.grid
    l2, c1, c2 = (float(value) for value in (elasticity.prestretch**2, elasticity.c1, elasticity.c2))
    law = [c1 * l2, 0.0 if elasticity.model == "harmonic" else c1 / l2**2, c2 / l2, c2 * l2**2, membrane.outward / 6]

    def array(values: Tensor, *shape: int) -> np.ndarray:
        return np.ascontiguousarray(values.numpy().reshape(shape), dtype)

    cells = 2, m - 1, n - 1
    return Surface(
        array(membrane.rest, m, n, 3),
        ~membrane.fixed.numpy().reshape(m, n),
        array(load, m, n, 3),
        array(elasticity.rest_edges, 3, 2, *cells),
        array(elasticity.inverse_metric, 3, *cells),
        array(elasticity.det, *cells),
        array(elasticity.area, *cells),
        np.array(law, dtype),
    )


@compiled
def linearise(surface, u, pressure, force, A, volume):
    """The contact force, its tangent stiffness and the gradient of the volume, at the inner vertices; the volume.

    `u [m, n, 3]` the displacement, `pressure [1]`; `force [m, n, 3]`, `A [3, 21, m, n]` (of a component, in the components of
    the stencil's vertices) and `volume [m, n, 3]` are filled, the last at the border with half a sum. At vertices that are not
    free the force is zero, as are all entries of `A` in their rows and columns.
    """
    m, n = surface.free.shape
    e, spin, by_edge = np.empty((2, 3), u.dtype), np.empty(3, u.dtype), np.empty((4, 3), u.dtype)
    A[:], volume[:] = 0, 0
    for i in range(m):
        for j in range(n):
            for c in range(3):
                force[i, j, c] = -surface.load[i, j, c]
    sixth, enclosed = surface.law[4], 0.0
    for i in range(m - 1):
        for j in range(n - 1):
            for t in range(2):
                (i1, j1), (i2, j2) = TRIANGLES[t]
                corners = (i, j), (i + i1, j + j1), (i + i2, j + j2)
                for c in range(3):
                    for edge in range(2):
                        p, q = corners[1 + edge]
                        e[edge, c] = surface.edges[c, edge, t, i, j] + (u[p, q, c] - u[i, j, c])
                for c in range(3):
                    p, q = (c + 1) % 3, (c + 2) % 3
                    spin[c] = sixth * (e[0, p] * e[1, q] - e[0, q] * e[1, p])
                    enclosed += (surface.rest[i, j, c] + u[i, j, c]) * spin[c]
                s11, s12, s22 = _stiffness(surface, t, i, j, corners[1 + t], e, sixth * pressure[0], by_edge, A)
                for c in range(3):
                    first = s11 * e[0, c] + s12 * e[1, c]
                    other = s12 * e[0, c] + s22 * e[1, c]
                    of_energy = -(first + other), first, other
                    for k in range(3):
                        p, q = corners[k]
                        force[p, q, c] += of_energy[k] - pressure[0] * spin[c]
                        volume[p, q, c] += spin[c]
    _complete(surface.free, force, A)
    return enclosed


@compiled
def _stiffness(surface, t, i, j, later, e, share, by_edge, A):
    """The stress `S` of a triangle: force on edge a is `sum_b S_ab e_b`. The second derivatives of the triangle's energy, minus
    `share` times those of the volume, which are cross products with edges, are added to `A`, for pairs of vertices in ascending
    order only (`later` is the earlier of the second and the third vertex)."""
    s11, s12, s22, by_D, w_ID, w_DD = _of_energy(surface, t, i, j, e, by_edge)
    at_12, at_13, at_23 = 3 * PAIRS[t][0], 3 * PAIRS[t][1], 3 * PAIRS[t][2]
    for c in range(3):
        I1, I2 = w_ID * by_edge[0, c], w_ID * by_edge[1, c]
        D1, D2 = w_DD * by_edge[2, c], w_DD * by_edge[3, c]
        D1_I, D2_I = w_ID * by_edge[2, c], w_ID * by_edge[3, c]
        for d in range(3):
            h11 = I1 * by_edge[2, d] + D1_I * by_edge[0, d] + D1 * by_edge[2, d] - by_D * e[1, c] * e[1, d]
            h22 = I2 * by_edge[3, d] + D2_I * by_edge[1, d] + D2 * by_edge[3, d] - by_D * e[0, c] * e[0, d]
            mixed_12 = I1 * by_edge[3, d] + D1_I * by_edge[1, d] + D1 * by_edge[3, d]
            mixed_21 = I2 * by_edge[2, d] + D2_I * by_edge[0, d] + D2 * by_edge[2, d]
            first_second, second_first = by_D * e[0, c] * e[1, d], by_D * e[1, c] * e[0, d]
            h12 = mixed_12 + (first_second + first_second - second_first)
            h21 = mixed_21 + (second_first + second_first - first_second)
            if c == d:
                h11 += s11
                h12 += s12
                h21 += s12
                h22 += s22
            A[c, at_12 + d, i, j] -= h11 + h21
            A[c, at_13 + d, i, j] -= h12 + h22
            A[c, at_23 + d, later[0], later[1]] += h12 if t == 0 else h21
    for c in range(3):
        p, q = (c + 1) % 3, (c + 2) % 3
        x, y = share * e[0, c], share * e[1, c]
        z = x if t == 0 else -y
        A[q, at_12 + p, i, j] += y
        A[p, at_12 + q, i, j] -= y
        A[q, at_13 + p, i, j] -= x
        A[p, at_13 + q, i, j] += x
        A[q, at_23 + p, later[0], later[1]] -= z
        A[p, at_23 + q, later[0], later[1]] += z
    return s11, s12, s22


@compiled
def _of_energy(surface, t, i, j, e, by_edge):
    """For a triangle: the stress `S`; `2 area dW/dD / det`; 4 area times the second derivatives of `W(I, D)`; in `by_edge [4,
    3]` halves of the derivatives of `I` and of `D` in its two edges."""
    area, det = surface.area[t, i, j], surface.det[t, i, j]
    i11, i12, i22 = surface.inverse[0, t, i, j], surface.inverse[1, t, i, j], surface.inverse[2, t, i, j]
    g11 = e[0, 0] * e[0, 0] + e[0, 1] * e[0, 1] + e[0, 2] * e[0, 2]
    g12 = e[0, 0] * e[1, 0] + e[0, 1] * e[1, 1] + e[0, 2] * e[1, 2]
    g22 = e[1, 0] * e[1, 0] + e[1, 1] * e[1, 1] + e[1, 2] * e[1, 2]
    I, inverse = i11 * g11 + (i12 * g12 + i12 * g12) + i22 * g22, det / (g11 * g22 - g12 * g12)  # noqa: E741
    linear, thickness, mixed, quadratic = surface.law[0], surface.law[1], surface.law[2], surface.law[3]
    twice = area + area
    w_ID = -mixed * inverse * inverse
    w_D = quadratic + (w_ID * I - thickness * inverse * inverse)
    half_w_DD = (thickness + mixed * I) * inverse * inverse * inverse
    by_I, by_D, four = twice * (linear + mixed * inverse), twice / det * w_D, twice + twice
    for c in range(3):
        by_edge[0, c], by_edge[1, c] = i11 * e[0, c] + i12 * e[1, c], i12 * e[0, c] + i22 * e[1, c]
        by_edge[2, c] = (g22 * e[0, c] - g12 * e[1, c]) / det
        by_edge[3, c] = (g11 * e[1, c] - g12 * e[0, c]) / det
    s11, s12, s22 = by_I * i11 + by_D * g22, by_I * i12 - by_D * g12, by_I * i22 + by_D * g11
    return s11, s12, s22, by_D, four * w_ID, four * (half_w_DD + half_w_DD)


@compiled
def _complete(free, force, A):
    """Fill the entries of `A` for earlier vertices by transposition, and the diagonal ones as minus the sum of the others; then
    set the entries of fixed vertices to zero."""
    m, n = free.shape
    V, blocks = m * n, len(A) * A.shape[1]
    planes, first, last = A.reshape((blocks, V)), n + 1, V - n - 1
    for block in range(blocks):
        c, s, d = block // 21, block % 21 // 3, block % 3
        if s < OWN:
            shift, transposed = STENCIL[s][0] * n + STENCIL[s][1], planes[21 * d + 3 * (LAST - s) + c]
            for k in range(first, last):
                planes[block, k] = transposed[k + shift]
        elif s == OWN:
            planes[block] = 0
    for block in range(blocks):
        if block % 21 // 3 != OWN:
            own = planes[block // 21 * 21 + 3 * OWN + block % 3]
            for k in range(V):
                own[k] -= planes[block, k]
    for i in range(m):
        for j in range(n):
            if not (0 < i < m - 1 and 0 < j < n - 1 and free[i, j]):
                A[:, :, i, j] = 0
                force[i, j] = 0
            elif not _surrounded(free, i, j):
                for s in range(LAST + 1):
                    if not free[i + STENCIL[s][0], j + STENCIL[s][1]]:
                        A[:, 3 * s : 3 * s + 3, i, j] = 0


@compiled
def _surrounded(free, i, j):
    """Whether all vertices around this one are free."""
    for s in range(LAST + 1):
        if not free[i + STENCIL[s][0], j + STENCIL[s][1]]:
            return False
    return True
