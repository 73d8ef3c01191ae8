"""The forces of a membrane and its fluid, and their tangent stiffness, triangle by triangle: machine code made here.

The formulas of `hyperelastic` and of `Membrane.volume` once more, for one surface without gradients: there each is a few tensor
operations over all triangles, of which a grid has too few to make them worth their calls.
"""

from typing import Any, NamedTuple

import numpy as np

from ..solve.native_band import compiled
from ..surface.membrane import Membrane
from .hyperelastic import ElasticEnergy

STENCIL = ((-1, -1), (-1, 0), (0, -1), (0, 0), (0, 1), (1, 0), (1, 1))
"""A vertex and its six neighbours, in the order of the vertices: blocks of `A`."""
OWN = 3
TRIANGLES = (((0, 0), (1, 0), (1, 1)), ((0, 0), (1, 1), (0, 1)))
"""Of a quadrilateral, by the places of their vertices."""
PLACES = tuple(
    tuple(tuple(STENCIL.index((q[0] - p[0], q[1] - p[1])) for q in triangle) for p in triangle) for triangle in TRIANGLES
)
"""Of the third index' vertex in the stencil of the second's, of either triangle."""


class Surface(NamedTuple):
    """What is constant of a membrane."""

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
    law: tuple[float, float, float, float]
    """`c1 l^2, c1 / l^4, c2 / l^2, c2 l^4`, the second zero where the energy is harmonic."""
    outward: float


def surface_of(membrane: Membrane, elasticity: ElasticEnergy, load: Any) -> Surface:
    """Of a membrane and its material; `load`: the rest load `[V, 3]`."""
    m, n = membrane.grid
    l2, c1, c2 = (float(value) for value in (elasticity.prestretch**2, elasticity.c1, elasticity.c2))
    law = c1 * l2, 0.0 if elasticity.model == "harmonic" else c1 / l2**2, c2 / l2, c2 * l2**2
    vertices = (m, n, 3)
    cells = (2, m - 1, n - 1)
    return Surface(
        membrane.rest.numpy().reshape(vertices),
        ~membrane.fixed.numpy().reshape(m, n),
        load.numpy().reshape(vertices),
        elasticity.rest_edges.numpy().reshape(3, 2, *cells),
        elasticity.inverse_metric.numpy().reshape(3, *cells),
        elasticity.det.numpy().reshape(cells),
        elasticity.area.numpy().reshape(cells),
        law,
        float(membrane.outward),
    )


@compiled
def linearise(surface, u, pressure, force, A, volume):
    """The contact force, its tangent stiffness and the gradient of the volume, at the inner vertices; by how much the volume is
    above that at rest.

    `u [m, n, 3]` the displacement; `force [m, n, 3]`, `A [m, n, 3, 21]` (of a component, in the components of the stencil's
    vertices) and `volume [m, n, 3]` are filled, at the border with what is half a sum. `A` is zero in vertices that are not free.
    """
    m, n = surface.free.shape
    sixth = surface.outward / 6
    e, of_I, of_D, spin = np.empty((2, 3), u.dtype), np.empty((2, 3), u.dtype), np.empty((2, 3), u.dtype), np.empty(3, u.dtype)
    H, around = np.empty((3, 3, 3, 3), u.dtype), np.empty((3, 3), u.dtype)
    force[:] = -surface.load
    A[:], volume[:] = 0, 0
    rise = 0.0
    for i in range(m - 1):
        for j in range(n - 1):
            for t in range(2):
                corners, places = TRIANGLES[t], PLACES[t]
                i1, j1, i2, j2 = i + corners[1][0], j + corners[1][1], i + corners[2][0], j + corners[2][1]
                now, rest = 0.0, 0.0
                for c in range(3):
                    e[0, c] = surface.edges[c, 0, t, i, j] + (u[i1, j1, c] - u[i, j, c])
                    e[1, c] = surface.edges[c, 1, t, i, j] + (u[i2, j2, c] - u[i, j, c])
                for c in range(3):
                    p, q = (c + 1) % 3, (c + 2) % 3
                    spin[c] = sixth * (e[0, p] * e[1, q] - e[0, q] * e[1, p])
                    x, y = surface.edges[p, 0, t, i, j], surface.edges[q, 1, t, i, j]
                    z, w = surface.edges[q, 0, t, i, j], surface.edges[p, 1, t, i, j]
                    rest += surface.rest[i, j, c] * sixth * (x * y - z * w)
                    now += (surface.rest[i, j, c] + u[i, j, c]) * spin[c]
                rise += now - rest
                s11, s12, s22 = _second_derivatives(surface, t, i, j, e, of_I, of_D, H)
                _less_fluid(H, e, sixth * pressure)
                for c in range(3):
                    first = s11 * e[0, c] + s12 * e[1, c]
                    other = s12 * e[0, c] + s22 * e[1, c]
                    of_fluid = pressure * spin[c]
                    force[i, j, c] -= first + other + of_fluid
                    force[i1, j1, c] += first - of_fluid
                    force[i2, j2, c] += other - of_fluid
                    volume[i, j, c] += spin[c]
                    volume[i1, j1, c] += spin[c]
                    volume[i2, j2, c] += spin[c]
                for a in range(3):
                    row = A[i + corners[a][0], j + corners[a][1]]
                    for b in range(3):
                        at = 3 * places[a][b]
                        for c in range(3):
                            for d in range(3):
                                row[c, at + d] += H[a, b, c, d]
    for i in range(m):
        for j in range(n):
            for s in range(7):
                p, q = i + STENCIL[s][0], j + STENCIL[s][1]
                if not (surface.free[i, j] and 0 <= p < m and 0 <= q < n and surface.free[p, q]):
                    A[i, j, :, 3 * s : 3 * s + 3] = 0
            if not surface.free[i, j]:
                force[i, j] = 0
    return rise


@compiled
def _second_derivatives(surface, t, i, j, e, of_I, of_D, H):
    """Those of a triangle's energy in its vertices, `H[a, b]`; the stress `S`, force on edge a is `sum_b S_ab e_b`."""
    area, det = surface.area[t, i, j], surface.det[t, i, j]
    i11, i12, i22 = surface.inverse[0, t, i, j], surface.inverse[1, t, i, j], surface.inverse[2, t, i, j]
    g11 = e[0, 0] * e[0, 0] + e[0, 1] * e[0, 1] + e[0, 2] * e[0, 2]
    g12 = e[0, 0] * e[1, 0] + e[0, 1] * e[1, 1] + e[0, 2] * e[1, 2]
    g22 = e[1, 0] * e[1, 0] + e[1, 1] * e[1, 1] + e[1, 2] * e[1, 2]
    I, D = i11 * g11 + 2 * i12 * g12 + i22 * g22, (g11 * g22 - g12 * g12) / det  # noqa: E741
    linear, thickness, mixed, quadratic = surface.law
    w_I = linear + mixed / D
    w_D = -thickness / (D * D) - mixed * I / (D * D) + quadratic
    w_ID, w_DD = -mixed / (D * D), 2 * (thickness + mixed * I) / (D * D * D)
    by_I, by_D = 2 * area * w_I, 2 * area / det * w_D
    s11, s12, s22 = by_I * i11 + by_D * g22, by_I * i12 - by_D * g12, by_I * i22 + by_D * g11
    for c in range(3):
        of_I[0, c], of_I[1, c] = 2 * (i11 * e[0, c] + i12 * e[1, c]), 2 * (i12 * e[0, c] + i22 * e[1, c])
        of_D[0, c], of_D[1, c] = 2 / det * (g22 * e[0, c] - g12 * e[1, c]), 2 / det * (g11 * e[1, c] - g12 * e[0, c])
    for c in range(3):
        for d in range(3):
            one = 1.0 if c == d else 0.0
            x = of_D[0, d] * w_DD + of_I[0, d] * w_ID
            y = of_D[1, d] * w_DD + of_I[1, d] * w_ID
            h11 = area * (of_D[0, c] * x + w_ID * of_I[0, c] * of_D[0, d]) - by_D * e[1, c] * e[1, d] + s11 * one
            h22 = area * (of_D[1, c] * y + w_ID * of_I[1, c] * of_D[1, d]) - by_D * e[0, c] * e[0, d] + s22 * one
            h12 = area * (of_D[0, c] * y + w_ID * of_I[0, c] * of_D[1, d]) + s12 * one
            H[1, 1, c, d], H[2, 2, c, d] = h11, h22
            H[1, 2, c, d] = h12 + by_D * (2 * e[0, c] * e[1, d] - e[1, c] * e[0, d])
    for c in range(3):
        for d in range(3):
            H[2, 1, c, d] = H[1, 2, d, c]
    for c in range(3):
        for d in range(3):
            H[1, 0, c, d] = H[0, 1, d, c] = -(H[1, 1, c, d] + H[1, 2, c, d])
            H[2, 0, c, d] = H[0, 2, d, c] = -(H[2, 1, c, d] + H[2, 2, c, d])
    for c in range(3):
        for d in range(3):
            H[0, 0, c, d] = -(H[0, 1, c, d] + H[0, 2, c, d])
    return s11, s12, s22


@compiled
def _less_fluid(H, e, share):
    """Without the second derivatives of the volume: in vertices a and b `share` times the cross product with an edge, whose sums
    about a vertex, in itself, vanish."""
    for c in range(3):
        p, q = (c + 1) % 3, (c + 2) % 3
        x, y = share * e[0, c], share * e[1, c]
        z = y - x
        # of the products [x]: at row q, column p is x, at row p, column q is -x
        H[0, 1, q, p] += y
        H[0, 1, p, q] -= y
        H[0, 2, q, p] -= x
        H[0, 2, p, q] += x
        H[1, 2, q, p] -= x
        H[1, 2, p, q] += x
        H[1, 0, q, p] -= z
        H[1, 0, p, q] += z
        H[2, 0, q, p] -= z
        H[2, 0, p, q] += z
        H[2, 1, q, p] += y
        H[2, 1, p, q] -= y
